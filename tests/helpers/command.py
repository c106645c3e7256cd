"""The command line, as tests call it."""

import os
from pathlib import Path

from probewise.cli import main


def run(*words):
    return main([str(word) for word in words])


def content_of(folder):
    """Return what is in a folder, by name, without following a link and without lock files."""
    found = {}
    for at, folders, names in os.walk(folder):
        for path in (Path(at, name) for name in (*folders, *names) if not name.endswith(".lock")):
            name = path.relative_to(folder).as_posix()
            found[name] = os.readlink(path) if path.is_symlink() else path.read_bytes() if path.is_file() else None
    return found


def refused(capsys, folder, *words):
    """Run a command that is refused, which changes nothing in the folder; return the one line that it says."""
    before = content_of(folder)
    capsys.readouterr()
    assert run(*words) == 2
    said = capsys.readouterr()
    assert said.out == "" or "--dry-run" in words
    assert said.err.startswith("probewise")
    assert said.err.count("\n") == 1, said.err
    assert said.err[:-1].isprintable()
    assert len(said.err) < 600 + 2 * max(map(len, map(str, (folder, *words))))
    assert content_of(folder) == before
    return said.err
