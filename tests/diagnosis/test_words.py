"""Names in words."""

from __future__ import annotations

import pytest

from probewise.diagnosis.words import effects_in_words, hypothesis_in_words, join_lists, parameter_in_words


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("interference", "interference~again"), "two waves in the readings"),
        (
            ("lag", "periodic_error:u", "periodic_error:u~again"),
            "a sensor that follows slowly and two periodic errors of u",
        ),
        (
            ("depends:tau_s:at 10:30", "sensitivity:a:b"),
            "tau_s that depends on at 10:30 and readings that depend on a:b",
        ),
        (("flicker", "lag"), "a flickering lamp and a sensor that follows slowly"),
    ],
)
def test_two_of_one_kind_are_one_item(names, said):
    assert hypothesis_in_words(names) == said


def test_what_is_no_plain_noun_is_there_twice():
    assert effects_in_words(["outliers", "outliers~again"]) == ["outlying readings (twice)"]


def test_lists_in_a_list_are_parted_by_semicolons():
    assert join_lists(["a lag", "a jump", "a wave"], "or") == "a lag, a jump or a wave"
    assert join_lists(["a lag and a jump", "a wave"], "or") == "a lag and a jump; or a wave"
    assert join_lists(["a lag"]) == "a lag"


@pytest.mark.parametrize(
    ("effect", "name", "unit", "said"),
    [
        ("steps:tau_s", "a", "s", "jump"),
        ("drag:omega", "a", "1", "size"),
        ("interference~again", "hz", "1/d", "frequency"),
        ("lag", "tau_s", "day", "time constant"),
        ("delay", "tau_s", "s", "delay"),
        ("offset_per_run", "values[3 b]", "V", "run 3 b"),
        ("upper_tank_overflow", "value", "", "upper_tank_overflow"),
        ("edge_misplacement", "offset_mm", "mm", "offset"),
    ],
)
def test_a_parameter_is_called_by_what_it_is(effect, name, unit, said):
    assert parameter_in_words(effect, name, unit) == said
