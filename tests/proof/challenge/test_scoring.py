"""Right or wrong, case by case: worked out by hand from the rules of the target table."""

import pytest

from probewise.proof.tables import (
    count_extra_names,
    is_distinguishable_from_ssf,
    is_leading_name_right,
    is_out_of_vocabulary,
    leading_probability_and_correctness,
    names_match,
    right_names,
    right_names_of_each_effect,
)

from ..conftest import case, hidden, outside, single


def test_what_fewer_than_three_nats_tell_apart_is_the_same():
    """lambda 12: 72 (1 - rho^2) is 2.87 at rho .98 and 4.26 at .97."""
    found = right_names(hidden("lag", 12.0, cosines={"lag": 1.0, "backlash": 0.98, "halo": 0.97}))
    assert found == {"lag", "backlash"}


def test_what_has_no_name_is_unknown_unless_it_is_like_one():
    chirp = outside(cosines={"flicker": 0.89})
    assert is_out_of_vocabulary(chirp)
    assert right_names_of_each_effect(chirp, merged=True) == [{"unknown"}]
    like = outside(cosines={"flicker": 0.9})
    assert not is_out_of_vocabulary(like)
    assert right_names_of_each_effect(like, merged=False) == [{"flicker"}]


def test_one_gaussian_more_is_nothing_to_name():
    assert right_names_of_each_effect(case("ssf_order", 12.0, hides=[hidden("ssf_order", 12.0)]), merged=True) == []


@pytest.mark.parametrize(
    ("names", "right"),
    [(("a", "c"), True), (("c", "b"), True), (("a",), False), (("a", "b"), False), (("a", "c", "d"), False)],
)
def test_names_stand_one_to_one(names, right):
    assert names_match(names, [{"a", "b"}, {"c"}]) is right


@pytest.mark.parametrize(("names", "n"), [((), 0), (("a",), 0), (("a", "b"), 1), (("d", "c"), 1), (("a", "c", "d"), 1)])
def test_a_name_that_stands_for_nothing_is_an_extra(names, n):
    assert count_extra_names(names, [{"a", "b"}, {"c"}]) == n


def test_clean_ahead_of_the_right_name_leaves_it_first_of_the_names():
    assert is_leading_name_right(single(said=[], hypotheses=[[[], 0.7], [["lag"], 0.2], [["halo"], 0.1]]))
    assert not is_leading_name_right(single(said=[], hypotheses=[[[], 0.7], [["halo"], 0.2], [["lag"], 0.1]]))


def test_noise_said_beside_an_effect_on_the_mean_is_left_out():
    both = [[["halo"], 0.4], [["lag"], 0.3], [["lag", "outliers"], 0.3]]
    assert is_leading_name_right(single(hypotheses=both))


def test_an_effect_on_the_noise_has_to_be_named_itself():
    hide = hidden("outliers", cosines={}, on_noise=True)
    assert is_leading_name_right(single("outliers", hide=hide))
    assert not is_leading_name_right(single("outliers", hide=hide, said=["dropouts"]))


def test_a_probability_is_held_against_the_exact_truth():
    alias = hidden("lag", cosines={"lag": 1.0, "backlash": 1.0})
    assert leading_probability_and_correctness(single(hide=alias, p=0.8)) == (0.8, True)
    assert leading_probability_and_correctness(single(hide=alias, said=["backlash"], p=0.8)) == (0.8, False)
    assert leading_probability_and_correctness(case(p=0.6)) == (0.6, True)


def test_what_one_gaussian_more_takes_up_need_not_be_named():
    """A skirt about a Gaussian spot is a second Gaussian: lambda 8, rho .999 leaves .06 nats; .9 leaves six."""
    like, unlike = (hidden("halo", cosines={"halo": 1.0, "ssf_order": rho}) for rho in (0.999, 0.9))
    for hide, free in ((like, True), (unlike, False)):
        found = single("halo", hide=hide)
        assert is_distinguishable_from_ssf(found) != free
        assert names_match((), right_names_of_each_effect(found, merged=True)) == free
        assert names_match(("halo",), right_names_of_each_effect(found, merged=True))
        assert not names_match((), right_names_of_each_effect(found, merged=False))
    # A hundredth for a name behind a clean verdict is no name that comes first, unless a name is due.
    hypotheses = [[[], 0.9], [["lag"], 0.07], [["halo"], 0.03]]
    assert is_leading_name_right(single("halo", hide=like, said=[], hypotheses=hypotheses))
    assert not is_leading_name_right(single("halo", hide=unlike, said=[], hypotheses=hypotheses))
    assert not is_leading_name_right(single("halo", hide=like, said=["lag"], hypotheses=[[["lag"], 0.9], [[], 0.1]]))
    both = case("pair", 12.0, truth=["halo", "lag"], hides=[like, hidden("lag", 12.0)], said=["lag"])
    assert is_leading_name_right(both)
    assert is_distinguishable_from_ssf(both)
    assert not names_match(("halo",), right_names_of_each_effect(both, merged=True))
    assert not names_match(("lag", "glint"), right_names_of_each_effect(both, merged=True))
