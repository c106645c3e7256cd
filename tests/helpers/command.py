"""The command line, as tests call it."""

from probewise.cli import main


def run(*words):
    return main([str(word) for word in words])
