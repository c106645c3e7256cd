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


def row(results, name):
    (found,) = (r for r in score(results) if r.name == name)
    return found


def test_a_bootstrap_of_the_mean_agrees_with_its_standard_error():
    values = np.random.default_rng(1).standard_normal(400)
    found = estimated_statistic(values, lambda v: float(v.mean()))
    assert (found.high - found.low) / 2 == pytest.approx(1.96 * values.std() / 20, rel=0.1)


@pytest.mark.parametrize(
    ("low", "high", "decision"), [(0.95, 0.99, "met"), (0.8, 0.85, "missed"), (0.85, 0.95, "open"), (0.9, 1.0, "met")]
)
def test_a_row_is_decided_only_by_its_whole_interval(low, high, decision):
    assert ScoreRow("x", Estimate(0.9, low, high, 10), least=0.9).decision == decision


def test_false_alarms_are_counted_at_both_levels(make):
    results = [make.case(p_value=p) for p in (0.5, 0.3, 0.04, 0.005)]
    assert row(results, "false alarms, clean, alpha .05").found.value == 0.5
    assert row(results, "false alarms, clean, alpha .01").found.value == 0.25


def test_other_noise_has_rows_of_its_own(make):
    other = {"other_noise": True, "noise_model": "t4", "truth": ["outliers"]}
    results = [make.case(), make.case(p_value=0.01, **other), make.case(p_value=0.3, **other)]
    assert row(results, "false alarms, clean, alpha .05").found.n == 1
    assert row(results, "false alarms, other noise, alpha .05").found.value == 0.5
    assert row(results, "  t4").found.n == 2


def test_detection_is_of_effects_on_the_mean(make):
    noisy = make.single("outliers", hide=make.hidden("outliers", on_noise=True), p_value=0.5)
    results = [make.single(), make.single(p_value=0.02), make.single("halo"), noisy]
    assert row(results, "detection, alpha .01, lambda 8").found.value == pytest.approx(2 / 3)
    assert row(results, "detection, lambda 8, least of all effects").found.value == 0.5
    detected, named = detected_and_named_by_effect(results)["lag"]
    assert (detected.value, named.value) == (0.5, 1.0)


def test_a_credible_set_holds_the_truth_by_its_label(make):
    results = [
        make.single(credible_set=["halo", "lag"]),
        make.single(credible_set=["halo"]),
        make.case(credible_set=["clean", "lag", "halo"]),
        make.outside(credible_set=["unknown"]),
    ]
    assert row(results, "95 % credible set holds the truth").found.value == 0.75
    assert row(results, "size of the credible set, lambda 8").found.value == 1.5
    assert row(results, "  the truth and its aliases as one, lambda 8").found.value == 1.5


def test_aliases_of_the_truth_count_as_one_in_a_set(make):
    hide = make.hidden("lag", cosines={"lag": 1.0, "backlash": 0.99})
    sets = (["lag", "backlash", "halo"], ["backlash", "lag"], ["halo"])
    results = [make.single("lag", hide=hide, credible_set=own) for own in sets]
    assert row(results, "size of the credible set, lambda 8").found.value == 2.0
    assert row(results, "  the truth and its aliases as one, lambda 8").found.value == pytest.approx(4 / 3)


def test_only_a_name_can_be_the_wrong_name(make):
    results = [make.single(said=["halo"]), make.single(said=[]), make.single(said=["unknown"]), make.single()]
    assert row(results, "wrong name stated above .9").found.value == 0.25


def test_the_calibration_error_of_hand_made_bins(make):
    """Half stated .8, one of two right; half stated .95, both right: (.3 + .05) / 2."""
    results = [make.case(p=0.8), make.case(p=0.8, said=["lag"]), make.case(p=0.95), make.case(p=0.95)]
    assert calibration_error(results).value == pytest.approx(0.175)
    bins = reliability_bins(results)
    assert [(round(stated, 3), right.value, right.n) for stated, right in bins] == [(0.8, 0.5, 2), (0.95, 1.0, 2)]
    assert reliability_bins([]) == []


def test_the_place_counts_where_there_is_one(make):
    results = [make.single(size=12.0, overlap=o) for o in (1.0, 0.5, None)]
    assert row(results, "overlap of the place, lambda 12").found.value == 0.75


def test_intervals_count_where_the_name_is_right(make):
    own = {"lag": {"tau_s": [1.0, 0.5, 1.5], "other": [1.0, 2.0, 3.0]}}
    results = [make.single(parameters=own), make.single(said=["halo"], parameters=own, sensor={"u_mm": [0, 1, 2]})]
    assert row(results, "95 % intervals of effect parameters cover").found.value == 0.5
    assert row(results, "95 % intervals of SSF and levels cover").found.value == 1.0


def test_the_held_out_gain_is_a_ratio_of_sums(make):
    def scans(repaired):
        own = {"null": -100.0, "repaired": repaired, "right": -90.0}
        return dict.fromkeys(("angle", "pattern", "direction"), own)

    results = [
        make.single(held_out=scans(-80.0)),
        make.single(held_out=scans(-90.0)),
        make.single(held_out=scans(-101)),
    ]
    assert row(results, "held-out gain, share of the right model's").found.value == pytest.approx((20 + 10 - 1) / 30)
    assert row(results, "held-out worse than the null by over 1 nat").found.value == pytest.approx(1 / 3)
    assert row(results, "  of the right model, fitted to the same").found.value == 0.0
    of_right = {"null": -100.0, "repaired": -100.0, "right": -100.5}
    worse = make.single(held_out=dict.fromkeys(("angle", "pattern", "direction"), of_right))
    assert row([*results, worse], "  of the right model, fitted to the same").found.value == 0.25


def test_both_of_a_pair_have_to_be_named(make):
    def pair(*said):
        return make.case("pair", 12.0, truth=["halo", "lag"], hides=map(make.hidden, ("lag", "halo")), said=said)

    results = [pair("halo", "lag"), pair("lag"), pair("glint", "lag"), pair("glint", "halo", "lag")]
    assert row(results, "two effects: both named").found.value == 0.25
    assert row(results, "two effects: a false extra").found.value == 0.5


def test_what_has_no_name_should_be_unknown_and_nothing_else(make):
    results = [
        make.outside(),
        make.outside(said=["lag"]),
        make.outside(cosines={"flicker": 0.95}, said=["flicker"]),
        make.single(said=["unknown"]),
        make.single(),
    ]
    assert row(results, "outside the vocabulary: unknown, or a rare effect named right, lambda 12").found.value == 0.5
    assert row(results, "false unknown").found.value == 0.5


def test_the_rare_effect_that_acts_as_the_concealed_one_is_right_and_another_is_not(make):
    results = [
        make.outside(name="bent_rail", said=[said], p=0.95) for said in ("bent_rails", "unknown", "arm_knock", "lag")
    ]
    found = row(results, "outside the vocabulary: unknown, or a rare effect named right, lambda 12").found
    assert (found.value, found.n) == (0.5, 4)
    assert [is_confidently_wrong(result) for result in results] == [False, False, True, True]


def test_aliases_are_told_apart_by_the_advised_readings(make):
    def alias(verdict, said, p=0.5, settled=None):
        hide = make.hidden("lag", 12.0, cosines={"lag": 1.0, "backlash": 1.0})
        half_of_it = math.sqrt(1 - 1 / 48)  # 1.5 nats in a plan
        other = {"verdict": verdict, "settled": settled, "said": said, "p": p, "cosine": half_of_it}
        return make.case("alias", 12.0, truth=["lag"], hides=[hide], **other)

    after = {"hypotheses": [[["lag"], 0.99]], "readings": 51}
    results = [alias("cannot_tell", ["backlash"], settled=after), alias("named", ["backlash"], p=0.95)]
    assert row(results, "aliased pair: cannot tell").found.value == 0.5
    assert row(results, "aliased pair: sure of the wrong name").found.value == 0.5
    assert row(results, "right name after the advised readings").found.value == 0.5
    advised = row(results, "  readings advised, of those that repeating the plan needs").found
    assert advised.value == pytest.approx(51 / 816)


def test_an_alias_is_no_confusion(make):
    alias = make.hidden("lag", cosines={"lag": 1.0, "backlash": 1.0})
    results = [
        make.single(hide=alias, said=["backlash"]),
        make.single(said=["halo", "glint"]),
        make.case(said=["outliers"]),
        make.outside(said=["halo"]),
    ]
    truths, said, counts = confusion_counts(results)
    assert truths == ("clean", "lag", "outside")
    assert said == ("clean", "lag", "halo", "several")
    assert counts.tolist() == [[1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 1, 0]]
