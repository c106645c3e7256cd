"""One case of a system, and the table of a challenge on systems, from results made by hand."""

import pytest

from probewise.proof.challenge import challenge, run_system_case
from probewise.proof.pages import challenge_page
from probewise.proof.tables import gains_on_held_out_runs, score_systems
from probewise.report.html import draw_or_raise

from ...conftest import hidden, system_case, system_single

FIRST, WRONG = "right name and target first, lambda 12", "wrong name stated above .9"
RECOGNISED = "out of vocabulary, lambda 20: unknown, a right name, or 0.8 of the held-out gain"
FAILED = {"kind": "single", "size": 12.0, "other_noise": False, "failed": "ParameterError: no", "at": "diagnosis"}
STRANGE = hidden("strange_switch:u", 20.0, in_vocabulary=False, cosines={})


def two_apart(nats):
    """Another name is said, which loses so many nats: at lambda 12 by its cosine."""
    hide = hidden("drifts:k", 12.0, cosines={"differs:k": (1 - 2 * nats / 144) ** 0.5})
    return system_single("drifts:k", hide=hide, said=["differs:k"])


def other_words(nats, **others):
    return system_single("saturation", said=["limit:v"], alternative_nats={"limit:v": nats}, **others)


def unlisted(said, gains=(40.0, 40.0), **others):
    return system_case("outside", 20.0, truth=["unknown"], hides=[STRANGE], said=said, gains=gains, **others)


def pair(*said):
    hides = [hidden("lag", 12.0, cosines={}), hidden("drag:v", 12.0, cosines={"damping:v": 1.0})]
    return system_case("pair", 12.0, truth=["drag:v", "lag"], hides=hides, said=said)


FOUND = {
    "another target is wrong": (
        [system_single("drifts:k"), system_single("drifts:k", said=["drifts:tau_s"])],
        {FIRST: 0.5},
    ),
    "two names within three nats are both right": ([two_apart(2.0)], {FIRST: 1.0, WRONG: 0.0}),
    "two names four nats apart are not": ([two_apart(4.0)], {FIRST: 0.0, WRONG: 1.0}),
    "other words for the same readings are right": (
        [other_words(0.4, credible_set=["saturation", "limit:v", "limit:v+outliers"])],
        {
            **{FIRST: 1.0, WRONG: 0.0},
            "size of the credible set, the truth and its aliases as one, lambda 12": 2.0,  # noise beside it counts
        },
    ),
    "other words for others are wrong": ([other_words(3.5)], {FIRST: 0.0, WRONG: 1.0}),
    # Cosine .9 or more, after a full refit: at lambda 20, a loss of up to (1 - .81) 20^2 / 2 = 38 nats.
    "a law on no list like a name is that name": (
        [unlisted(["settling"], alternative_nats={"settling": 37.9})],
        {WRONG: 0.0},
    ),
    "a law on no list unlike it is not": ([unlisted(["settling"], alternative_nats={"settling": 38.1})], {WRONG: 1.0}),
    "alarms and names on clean recordings": (
        [system_case(), system_case(p_value=0.01, said=["lag"])],
        {"false alarms, no effect, white noise, alpha .05": 0.5, "physics named, no effect, white noise": 0.5},
    ),
    "noise of another kind by itself": (
        [system_case(truth=["outliers"], other_noise=True, noise_model="outliers", p_value=0.4)],
        {"  outliers": 0.0},
    ),
    "both of a pair, or their aliases": (
        [pair("damping:v", "lag"), pair("lag")],
        {"two effects, lambda 12 each: both named": 0.5},
    ),
    # Shares 0.5, 1 (100 of 100 though 900 of 500 nats) and 0.25.
    "the median share of the gain, capped": (
        [system_single(gains=gains) for gains in ((20.0, 40.0), (900.0, 500.0), (10.0, 40.0))],
        {"held-out runs: median share of the right model's gain": 0.5},
    ),
    "unknown": ([unlisted(["unknown"], (0.0, 50.0))], {RECOGNISED: 1.0, "  the same without unknown": 0.0}),
    "as good as the true law": (
        [unlisted(["lag"], (45.0, 50.0))],
        {RECOGNISED: 1.0, "  the same without unknown": 1.0},
    ),
    "poorer": ([unlisted(["lag"], (20.0, 50.0))], {RECOGNISED: 0.0, "  the same without unknown": 0.0}),
    # One effect has one for each run: they would outnumber all others.
    "no intervals of values per run": (
        [
            system_single(parameters={"offset_per_run": {"values[1]": [1.0, 0.9, 1.1], "values[2]": [1.0, 1.05, 1.1]}}),
            system_single(parameters={"offset_drift": {"a": [1.0, 0.9, 1.1]}}),
        ],
        {"95 % intervals of effect parameters cover": 1.0},
    ),
    "a case that failed in the last row alone": ([system_single(), FAILED], {"cases that failed": 0.5, FIRST: 1.0}),
}


@pytest.mark.parametrize("what", FOUND)
def test_each_row_counts(what):
    results, expected = FOUND[what]
    found = {row.name: row.found.value for row in score_systems(results)}
    assert {name: found[name] for name in expected} == expected


def test_gains_are_capped():
    assert gains_on_held_out_runs(system_single(gains=(900.0, 500.0))) == (100.0, 100.0)


def test_an_oracle_tells_two_that_are_eight_nats_apart_as_often_as_the_normal_law_says():
    """Distance 4 sds: Phi(2) = 0.977. An alias, within three nats, does not count; cases without rivals have no row."""
    own = hidden("lag", 12.0, cosines={"delay": 1.0}) | {"rival_nats": {"delay": 0.1, "settling": 8.0}}
    found = {row.name.strip(): row.found.value for row in score_systems([system_single("lag", hide=own)])}
    assert found["oracle against the hardest rival, lambda 12"] == pytest.approx(0.97725, abs=1e-5)
    assert found["oracle, so counted, lambda 12"] < 1.2
    assert not [row for row in score_systems([system_single("lag")]) if "oracle" in row.name]


def test_the_page_tells_every_case():
    results = [system_case(), system_single("drifts:k"), unlisted(["unknown"]), FAILED]
    text = challenge_page(results, score_systems, command="probewise challenge", systems=True).html(draw_or_raise)
    for expected in ("drifts:k", "strange_switch:u", "ParameterError: no", "right covariate first, lambda 12"):
        assert expected in text


@pytest.mark.slow
def test_a_case_is_diagnosed_from_its_files_and_the_campaign_goes_on(tmp_path):
    path = tmp_path / "cases.jsonl"
    first, both = (
        list(challenge(range(n), seed=5, work=run_system_case, of="systems").run(path=path).values()) for n in (1, 2)
    )
    assert both[0] == first[0]
    assert "failed" not in both[0]
    assert set(both[0]["held_out"]) == {"inside", "beyond"}
    assert len(path.read_text().splitlines()) == 3
    assert any(row.found.n for row in score_systems(both))
