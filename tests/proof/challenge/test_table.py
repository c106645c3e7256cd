"""Each row of the table, from results made by hand."""

import math

import numpy as np
import pytest

from probewise.proof.campaign import Estimate, estimated_statistic
from probewise.proof.tables import (
    ScoreRow,
    calibration_error,
    confusion_counts,
    detected_and_named_by_effect,
    is_confidently_wrong,
    reliability_bins,
    score,
)

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
