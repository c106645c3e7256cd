"""Scores by hand: right or wrong, truths beside intervals, cases that changed, and the table's rows."""

import math

import challenges_side_by_side as side_by_side
import numpy as np
import pytest

from probewise.diagnosis import EffectFound, ModelSamples, ParameterFound, Place
from probewise.proof.campaign import Estimate, estimated_statistic
from probewise.proof.challenge import effect_truths_and_intervals, place_overlap, sensor_truths_and_intervals
from probewise.proof.sensors import CovariateRegion
from probewise.proof.tables import (
    ScoreRow,
    calibration_error,
    confusion_counts,
    count_extra_names,
    detected_and_named_by_effect,
    is_confidently_wrong,
    is_distinguishable_from_ssf,
    is_leading_name_right,
    is_out_of_vocabulary,
    leading_probability_and_correctness,
    names_match,
    reliability_bins,
    right_names,
    right_names_of_each_effect,
    score,
)
from probewise.scene import KnownScene
from probewise.sensor import Chain, FreeLevels, FreeMixture
from probewise.world.concealed import flicker
from probewise.world.spots import Blob, gaussian_spot
from probewise.world.world import World

from ..conftest import case, hidden, outside, single

NOISY = {"other_noise": True, "noise_model": "t4", "truth": ["outliers"]}
ALIAS = hidden("lag", cosines={"lag": 1.0, "backlash": 0.99})
STATED = {"lag": {"tau_s": [1.0, 0.5, 1.5], "other": [1.0, 2.0, 3.0]}}  # truth, and the ends of the interval
UNLISTED = "outside the vocabulary: unknown, or a rare effect named right, lambda 12"


def held_out(repaired, right=-90.0):
    scan = {"null": -100.0, "repaired": repaired, "right": right}
    return single(held_out=dict.fromkeys(("angle", "pattern", "direction"), scan))


def pair(*said):
    return case("pair", 12.0, truth=["halo", "lag"], hides=map(hidden, ("lag", "halo")), said=said)


def aliased(verdict, p=0.5, settled=None):
    """Backlash is said of a lag that 1.5 nats in a plan tell from it."""
    hide = hidden("lag", 12.0, cosines={"lag": 1.0, "backlash": 1.0})
    more = {"verdict": verdict, "settled": settled, "p": p, "cosine": math.sqrt(1 - 1 / 48)}
    return case("alias", 12.0, truth=["lag"], hides=[hide], said=["backlash"], **more)


FOUND = {
    "alarms at both levels": (
        [case(p_value=p) for p in (0.5, 0.3, 0.04, 0.005)],
        {"false alarms, clean, alpha .05": 0.5, "false alarms, clean, alpha .01": 0.25},
    ),
    "other noise by itself": (
        [case(), case(p_value=0.01, **NOISY), case(p_value=0.3, **NOISY)],
        {"false alarms, clean, alpha .05": 0.0, "false alarms, other noise, alpha .05": 0.5, "  t4": 0.5},
    ),
    "detection of effects on the mean": (
        [
            *(single(), single(p_value=0.02), single("halo")),
            single("outliers", hide=hidden("outliers", on_noise=True), p_value=0.5),
        ],
        {"detection, alpha .01, lambda 8": 2 / 3, "detection, lambda 8, least of all effects": 0.5},
    ),
    "a set that holds the truth by its label": (
        [
            *(single(credible_set=own) for own in (["halo", "lag"], ["halo"])),
            *(case(credible_set=["clean", "lag", "halo"]), outside(credible_set=["unknown"])),
        ],
        {
            "95 % credible set holds the truth": 0.75,
            "size of the credible set, lambda 8": 1.5,
            "  the truth and its aliases as one, lambda 8": 1.5,
        },
    ),
    "aliases of the truth as one in a set": (
        [single(hide=ALIAS, credible_set=own) for own in (["lag", "backlash", "halo"], ["backlash", "lag"], ["halo"])],
        {"size of the credible set, lambda 8": 2.0, "  the truth and its aliases as one, lambda 8": 4 / 3},
    ),
    "only a name as the wrong name": (
        [single(said=said) for said in (["halo"], [], ["unknown"], ["lag"])],
        {"wrong name stated above .9": 0.25},
    ),
    "the place where there is one": (
        [single(size=12.0, overlap=overlap) for overlap in (1.0, 0.5, None)],
        {"overlap of the place, lambda 12": 0.75},
    ),
    "intervals where the name is right": (
        [single(parameters=STATED), single(said=["halo"], parameters=STATED, sensor={"u_mm": [0, 1, 2]})],
        {"95 % intervals of effect parameters cover": 0.5, "95 % intervals of SSF and levels cover": 1.0},
    ),
    "the held-out gain as a ratio of sums": (
        [held_out(-80.0), held_out(-90.0), held_out(-101.0)],
        {
            "held-out gain, share of the right model's": (20 + 10 - 1) / 30,
            "held-out worse than the null by over 1 nat": 1 / 3,
            "  of the right model, fitted to the same": 0.0,
        },
    ),
    "a right model that is worse": (
        [*(held_out(-90.0) for _ in range(3)), held_out(-100.0, right=-100.5)],
        {"  of the right model, fitted to the same": 0.25},
    ),
    "both of a pair": (
        [pair("halo", "lag"), pair("lag"), pair("glint", "lag"), pair("glint", "halo", "lag")],
        {"two effects: both named": 0.25, "two effects: a false extra": 0.5},
    ),
    "what has no name as unknown, and nothing else": (
        [
            *(outside(), outside(said=["lag"]), outside(cosines={"flicker": 0.95}, said=["flicker"])),
            *(single(said=["unknown"]), single()),
        ],
        {UNLISTED: 0.5, "false unknown": 0.5},
    ),
    "the rare effect that acts alike, and no other": (
        [outside(name="bent_rail", said=[said], p=0.95) for said in ("bent_rails", "unknown", "arm_knock", "lag")],
        {UNLISTED: 0.5},
    ),
    "aliases, told apart by the advised readings": (
        [aliased("cannot_tell", settled={"hypotheses": [[["lag"], 0.99]], "readings": 51}), aliased("named", p=0.95)],
        {
            "aliased pair: cannot tell": 0.5,
            "aliased pair: sure of the wrong name": 0.5,
            "right name after the advised readings": 0.5,
            "  readings advised, of those that repeating the plan needs": 51 / 816,
        },
    ),
}


@pytest.mark.parametrize("what", FOUND)
def test_each_row_counts(what):
    results, expected = FOUND[what]
    found = {row.name: row.found.value for row in score(results)}
    assert {name: found[name] for name in expected} == pytest.approx(expected)


def test_a_bootstrap_of_the_mean_agrees_with_its_standard_error():
    values = np.random.default_rng(1).standard_normal(400)
    found = estimated_statistic(values, lambda v: float(v.mean()))
    assert (found.high - found.low) / 2 == pytest.approx(1.96 * values.std() / 20, rel=0.1)


@pytest.mark.parametrize(
    ("low", "high", "decision"), [(0.95, 0.99, "met"), (0.8, 0.85, "missed"), (0.85, 0.95, "open"), (0.9, 1.0, "met")]
)
def test_a_row_is_decided_only_by_its_whole_interval(low, high, decision):
    assert ScoreRow("x", Estimate(0.9, low, high, 10), least=0.9).decision == decision


def test_shares_of_each_effect_and_what_is_surely_wrong():
    detected, named = detected_and_named_by_effect(FOUND["detection of effects on the mean"][0])["lag"]
    assert (detected.value, named.value) == (0.5, 1.0)
    rare = FOUND["the rare effect that acts alike, and no other"][0]
    assert [is_confidently_wrong(result) for result in rare] == [False, False, True, True]


def test_the_calibration_error_of_hand_made_bins():
    """Half stated .8, one of two right; half stated .95, both right: (.3 + .05) / 2."""
    results = [case(p=0.8), case(p=0.8, said=["lag"]), case(p=0.95), case(p=0.95)]
    assert calibration_error(results).value == pytest.approx(0.175)
    bins = reliability_bins(results)
    assert [(round(stated, 3), right.value, right.n) for stated, right in bins] == [(0.8, 0.5, 2), (0.95, 1.0, 2)]
    assert reliability_bins([]) == []


def test_an_alias_is_no_confusion():
    said = single(hide=ALIAS, said=["backlash"]), single(said=["halo", "glint"])
    truths, answers, counts = confusion_counts([*said, case(said=["outliers"]), outside(said=["halo"])])
    assert truths == ("clean", "lag", "outside")
    assert answers == ("clean", "lag", "halo", "several")
    assert counts.tolist() == [[1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 0]]


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


def place(covariate, start=None, end=None, scan=None):
    none = np.zeros(0)
    return Place(covariate, scan, start, end, 0.01, 4.0, none, none)


@pytest.mark.parametrize(
    ("start", "end", "overlap"), [(0.0, 10.0, 1.0), (5.0, 15.0, 1 / 3), (2.0, 6.0, 0.4), (11.0, 15.0, 0.0)]
)
def test_intersection_over_union(start, end, overlap):
    assert place_overlap(CovariateRegion("time", 0.0, 10.0), [place("time", start, end)]) == pytest.approx(overlap)


def test_only_the_strongest_place_of_that_covariate_counts():
    places = [place("level", 0.0, 1.0), place("time", 0.0, 5.0), place("time", 0.0, 10.0)]
    assert place_overlap(CovariateRegion("time", 0.0, 10.0), places) == 0.5
    assert place_overlap(CovariateRegion("slope", 0.0, 10.0), places) == 0.0


def test_a_scan_overlaps_with_the_scans_of_its_mounting():
    region = CovariateRegion("scan", scans=("a", "b"))
    assert place_overlap(region, [place("scan", scan="a")]) == 0.5
    assert place_overlap(region, [place("scan", scan="c")]) == 0.0
    both = [place("scan", scan="a"), place("scan", scan="b"), place("time", 0.0, 1.0)]
    assert place_overlap(region, both) == 1.0
    weaker = Place("scan", "c", None, None, 0.01, 3.0, *[np.zeros(0)] * 2)
    assert place_overlap(region, [*both, weaker]) == 1.0


def found(*parameters):
    own = tuple(ParameterFound(name, unit, (low + high) / 2, 1.0, (low, high)) for name, unit, low, high in parameters)
    return EffectFound("x", 0.9, 8.0, "", own)


def test_an_angle_counts_by_its_nearest_turn():
    stated = found(("phase", "rad", -0.1, 0.1), ("amp", "LEGO", 1.0, 2.0))
    within = effect_truths_and_intervals(flicker(1.5, 0.02, 2 * math.pi - 0.05).parameters, stated)
    assert within["amp"] == [1.5, 1.0, 2.0]
    assert within["phase"] == pytest.approx([-0.05, -0.1, 0.1])


def test_samples_at_the_truth_have_its_moments():
    """One Gaussian: the covariance of the paper's A, B, C is half the inverse of [[A, C], [C, B]]."""
    blob = Blob(1.0, (0.5, 1.5), (4.0, 2.5), 0.3)
    covariance = np.array([[16.0, 3.0], [3.0, 6.25]])
    (a, c), (_, b) = np.linalg.inv(covariance) / 2
    theta = np.tile([1.0, 0.5, 1.5, a, b, c, 10.0, 60.0], (5, 1))
    chain = Chain(FreeMixture(1), FreeLevels(), KnownScene({}), ())
    within = sensor_truths_and_intervals(World(gaussian_spot([blob])), ModelSamples(chain, theta, np.ones(5), 1))
    for truth, low, high in within.values():
        assert (low, high) == pytest.approx((truth, truth), rel=1e-3)


def _case(kind, p_value, verdict="clean", combination=(), **more):
    names = list(combination)
    return {
        "kind": kind, "size": 12.0, "truth": [], "hidden": [], "verdict": verdict, "p_value": p_value,
        "combination": names, "hypotheses": [[names, 1.0]], "credible_set": ["+".join(names) or "clean"], **more,
    }  # fmt: skip


def test_cases_that_changed_are_counted_with_the_probability_of_their_difference():
    earlier = [_case("clean", 0.04)] * 3 + [_case("clean", 0.5)] * 10
    later = [_case("clean", 0.5)] * 3 + [_case("clean", 0.02)] * 2 + [_case("clean", 0.5)] * 8
    rows = {row["what"]: row for row in side_by_side.changed_counts(earlier, later)}
    alarms = rows["clean, alarm at .05"]
    assert [alarms[k] for k in ("cases", "earlier", "later", "only earlier", "only later")] == [13, 3, 2, 3, 2]
    assert alarms["p_value"] == 1.0
    assert rows["clean, alarm at .01"]["p_value"] == 1.0
    assert rows["single effect, right name first"]["cases"] == 0
