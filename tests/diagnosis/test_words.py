"""Names in words."""

import pytest

from probewise.diagnosis.words import join_lists, parameter_in_words


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
