"""Effects in words: two of one kind, and lists of lists."""

import pytest

from probewise.diagnosis.effect_words import effects_in_words, hypothesis_in_words, join_lists


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("interference", "interference~again"), "two waves in the readings"),
        (
            ("lag", "periodic_error:u", "periodic_error:u~again"),
            "a sensor that follows slowly and two periodic errors of u",
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
