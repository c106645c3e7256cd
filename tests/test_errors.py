"""What messages repeat of a bad value: enough to find it by, in one line."""

import pickle

import pytest

from probewise.errors import FileError, ParameterError, shortened, shown


def test_a_short_value_is_repeated_whole():
    assert str(ParameterError("radius_mm", -3.0, "greater than 0")) == "radius_mm is -3.0; allowed: greater than 0"


@pytest.mark.parametrize("value", ["a" * 100_000, list(range(50_000)), {"k": "x" * 100_000}])
def test_a_long_value_is_cut_and_its_length_told(value):
    message = str(ParameterError("name", value, "a short one"))
    assert len(message) < 200
    assert f"({len(repr(value))} characters)" in message
    assert message.endswith("; allowed: a short one")


def test_a_value_that_python_cannot_write_is_told_by_its_kind():
    nested = []
    for _ in range(5_000):
        nested = [nested]
    assert "a huge int" in str(ParameterError("n", 10**5000, "less"))
    assert "a huge list" in str(ParameterError("n", nested, "less"))
    while nested:  # taken apart by hand: freeing it in one go would recurse as deep
        nested = nested.pop()


def test_every_part_of_a_message_about_a_file_is_cut():
    error = FileError("a.csv", "f" * 10_000, "b" * 10_000, row=3, column="c" * 10_000)
    assert len(str(error)) < 1200
    assert str(error).count("(10000 characters)") == 3
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    assert error.found == "f" * 10_000


def test_what_a_terminal_would_obey_is_escaped():
    assert "\x1b" not in shortened("red \x1b[31m\nline")
    assert shortened("red \x1b[31m\nline") == "red \\x1b[31m\\nline"
    assert shown("\x1b") == "'\\x1b'"
