"""The table of a challenge on systems, from results made by hand."""

import pytest

from probewise.proof.pages import _case_cells, challenge_page
from probewise.proof.tables import gains_on_held_out_runs, score_systems
from probewise.report.html import draw_or_raise

from ...conftest import hidden, system_case, system_single


def _row(results, name):
    return next(row for row in score_systems(results) if row.name.strip() == name)


def test_a_name_with_another_target_is_wrong():
    right, wrong = system_single("drifts:k"), system_single("drifts:k", said=["drifts:tau_s"])
    assert _row([right, wrong], "right name and target first, lambda 12").found.value == 0.5


def test_what_explains_the_same_within_three_nats_is_right_too():
    alias = hidden("drifts:k", 12.0, cosines={"differs:k": (1 - 2 * 2.0 / 144) ** 0.5})
    apart = hidden("drifts:k", 12.0, cosines={"differs:k": (1 - 2 * 4.0 / 144) ** 0.5})
    told = [system_single("drifts:k", hide=hide, said=["differs:k"]) for hide in (alias, apart)]
    assert [_row([r], "right name and target first, lambda 12").found.value for r in told] == [1.0, 0.0]
    assert [_row([r], "wrong name stated above .9").found.value for r in told] == [0.0, 1.0]


def test_other_words_for_the_same_readings_are_right():
    """Within three nats of the concealed effects, whatever the names; noise beside them still counts."""
    said = ["limit:v"]
    same, apart = (system_single("saturation", said=said, alternative_nats={"limit:v": nats}) for nats in (0.4, 3.5))
    assert [_row([r], "right name and target first, lambda 12").found.value for r in (same, apart)] == [1.0, 0.0]
    assert [_row([r], "wrong name stated above .9").found.value for r in (same, apart)] == [0.0, 1.0]
    both = {**same, "credible_set": ["saturation", "limit:v", "limit:v+outliers"]}
    assert _row([both], "size of the credible set, the truth and its aliases as one, lambda 12").found.value == 2.0


def test_a_law_on_no_list_whose_change_of_the_readings_is_like_that_of_a_name_counts_as_that_name():
    """Cosine .9 or more, after a full refit: at lambda 20, a loss of up to (1 - .81) 20^2 / 2 = 38 nats."""
    strange = hidden("strange_two_settlings", 20.0, in_vocabulary=False, cosines={})
    like, unlike = (
        system_case(
            "outside", 20.0, truth=["unknown"], hides=[strange], said=["settling"], alternative_nats={"settling": nats}
        )
        for nats in (37.9, 38.1)
    )
    assert [_row([r], "wrong name stated above .9").found.value for r in (like, unlike)] == [0.0, 1.0]


def test_an_oracle_tells_two_that_are_eight_nats_apart_as_often_as_the_normal_law_says():
    """Distance 4 sds: Phi(2) = 0.977. An alias, within three nats, does not count; cases without rivals have no row."""
    own = hidden("lag", 12.0, cosines={}) | {
        "cosines": {"delay": 1.0},
        "rival_nats": {"delay": 0.1, "settling": 8.0},
    }
    row = _row([system_single("lag", hide=own)], "oracle against the hardest rival, lambda 12")
    assert row.found.value == pytest.approx(0.97725, abs=1e-5)
    assert _row([system_single("lag", hide=own)], "oracle, so counted, lambda 12").found.value < 1.2
    assert not [row for row in score_systems([system_single("lag")]) if "oracle" in row.name]


def test_a_case_of_which_clean_is_said_is_not_called_right_though_the_right_name_is_first_of_all_names():
    doubted = system_single(said=[], hypotheses=[[[], 0.6], [["offset_drift"], 0.4]])
    beside_noise = system_single(said=["offset_drift", "random_walk"])
    assert _row([doubted], "right name and target first, lambda 12").found.value == 1.0
    assert [_case_cells(0, r)[4:7] for r in (doubted, beside_noise)] == [
        ("clean", "0.60", "no"),
        ("offset_drift and random_walk", "0.97", "yes"),
    ]


def test_alarms_and_names_on_clean_recordings_are_counted():
    quiet, loud = system_case(), system_case(p_value=0.01, said=["lag"])
    assert _row([quiet, loud], "false alarms, no effect, white noise, alpha .05").found.value == 0.5
    assert _row([quiet, loud], "physics named, no effect, white noise").found.value == 0.5


def test_noise_of_another_kind_has_a_row_of_its_own():
    told = system_case(truth=["outliers"], other_noise=True, noise_model="outliers", p_value=0.4)
    assert _row([told], "outliers").found.value == 0.0


def test_a_pair_needs_both_names_or_their_aliases():
    hides = [hidden("lag", 12.0, cosines={}), hidden("drag:v", 12.0, cosines={"damping:v": 1.0})]
    both = system_case("pair", 12.0, truth=["drag:v", "lag"], hides=hides, said=["damping:v", "lag"])
    one = system_case("pair", 12.0, truth=["drag:v", "lag"], hides=hides, said=["lag"])
    assert _row([both, one], "two effects, lambda 12 each: both named").found.value == 0.5


def test_held_out_gain_is_the_median_share_and_capped():
    """Shares 0.5, 1 (100 of 100 though 900 of 500 nats) and 0.25."""
    cases = [
        system_single(gains=(20.0, 40.0)),
        system_single(gains=(900.0, 500.0)),
        system_single(gains=(10.0, 40.0)),
    ]
    assert gains_on_held_out_runs(cases[1]) == (100.0, 100.0)
    assert _row(cases, "held-out runs: median share of the right model's gain").found.value == 0.5


@pytest.mark.parametrize(
    ("said", "gains", "told", "named"),
    [(["unknown"], (0.0, 50.0), 1.0, 0.0), (["lag"], (45.0, 50.0), 1.0, 1.0), (["lag"], (20.0, 50.0), 0.0, 0.0)],
)
def test_what_is_on_no_list_is_unknown_or_as_good_as_the_true_law(said, gains, told, named):
    strange = hidden("strange_switch:u", 20.0, in_vocabulary=False, cosines={})
    case = system_case("outside", 20.0, truth=["unknown"], hides=[strange], said=said, gains=gains)
    assert (
        _row([case], "out of vocabulary, lambda 20: unknown, a right name, or 0.8 of the held-out gain").found.value
        == told
    )
    assert _row([case], "the same without unknown").found.value == named


def test_intervals_of_values_per_run_do_not_count():
    """One effect has one for each run: they would outnumber all others."""
    case = system_single(parameters={"offset_per_run": {"values[1]": [1.0, 0.9, 1.1], "values[2]": [1.0, 1.05, 1.1]}})
    drift = system_single(parameters={"offset_drift": {"a": [1.0, 0.9, 1.1]}})
    assert _row([case, drift], "95 % intervals of effect parameters cover").found.value == 1.0


def test_a_case_that_failed_counts_in_the_last_row_alone():
    failed = {"kind": "single", "size": 12.0, "other_noise": False, "failed": "ParameterError: no", "at": "diagnosis"}
    assert _row([system_single(), failed], "cases that failed").found.value == 0.5
    assert _row([system_single(), failed], "right name and target first, lambda 12").found.n == 1


def test_the_page_tells_every_case():
    failed = {"kind": "single", "size": 12.0, "other_noise": False, "failed": "ParameterError: no", "at": "diagnosis"}
    strange = system_case(
        "outside",
        20.0,
        truth=["unknown"],
        hides=[hidden("strange_switch:u", 20.0, in_vocabulary=False, cosines={})],
    )
    results = [system_case(), system_single("drifts:k"), strange, failed]
    text = challenge_page(results, score_systems, command="probewise challenge", systems=True).html(draw_or_raise)
    for expected in ("drifts:k", "strange_switch:u", "ParameterError: no", "right covariate first, lambda 12"):
        assert expected in text
