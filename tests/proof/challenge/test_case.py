"""One case from beginning to end, its campaign, its page, and what a null model leaves of an effect."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from probewise import __version__
from probewise.cli import main
from probewise.effects import VOCABULARY
from probewise.errors import FileError
from probewise.proof import pages as report
from probewise.proof.challenge import Task, challenge, run_case
from probewise.proof.refits import NullRefit, cosines_with_vocabulary
from probewise.proof.sensors import stratum_of
from probewise.proof.tables import oracle_credible_set_size, oracle_name_rate, readings_to_separate_alias, score
from probewise.recordings.plan import Recording
from probewise.recordings.plans import paper_plan
from probewise.report.html import draw_or_raise
from probewise.world.concealed import ambient_step, halo
from probewise.world.spots import Blob, gaussian_spot
from probewise.world.world import World

from ..conftest import case, hidden, outside, single


@pytest.fixture
def file_of(tmp_path):
    """Write a campaign's file of cases made by hand."""

    def write(results, seed=3, version=__version__):
        settings = {"challenge": version, "seed": seed}
        lines = [{"format": "campaign/1", "settings": settings}]
        lines += [{"key": Task(seed, k).key, "result": r} for k, r in enumerate(results)]
        path = tmp_path / "cases.jsonl"
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
        return path

    return write


def test_what_a_file_holds_is_not_done_again(file_of):
    results = [case(), single()]
    assert list(challenge(range(2), seed=3).run(path=file_of(results)).values()) == results


def test_another_version_s_cases_are_not_mixed_in(file_of):
    with pytest.raises(FileError, match=r"a campaign with challenge '0\.0'"):
        challenge([0], seed=3).run(path=file_of([case()], version="0.0"))


def test_a_case_that_cannot_be_drawn_is_noted(monkeypatch):
    def fails(*_, **__):
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr("probewise.proof.sensors.draw_case", fails)
    found = run_case(Task(1, 0))
    assert (found["failed"], found["at"]) == ("ZeroDivisionError: by zero", "drawing")
    assert found["kind"] == stratum_of(0)[0].kind


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 9])
def test_a_case_goes_through_strict_json_into_every_row(number):
    """And one of them again: it depends on its seed and number alone."""
    found = run_case(Task(1, number))
    if number == 1:
        assert {**run_case(Task(1, number)), "cpu_s": None} == {**found, "cpu_s": None}
    found = json.loads(json.dumps(found, allow_nan=False))
    assert "failed" not in found
    assert found["kind"] == stratum_of(number)[0].kind
    assert (found["settled"] is not None) == (found["kind"] == "alias")
    assert sum(p for _, p in found["hypotheses"]) == pytest.approx(1.0, abs=0.05)
    for h in found["hidden"]:
        assert h["size_lambda"] == pytest.approx(found["size"], rel=0.1)
        assert h["cosines"][h["name"]] > 0.98
    assert score([found])


@pytest.fixture
def results():
    failed = {"kind": "pair", "size": 12.0, "other_noise": False, "failed": "no <plan>", "at": "drawing"}
    return [case(), case(p=0.6), single(), single(said=["halo"]), outside(), failed]


def test_the_page_stands_alone_and_tells_of_failures(results):
    page = report.challenge_page(results, score, command="probewise challenge", systems=False).html(draw_or_raise)
    assert "no &lt;plan&gt;" in page
    assert page.count("data:image/png;base64,") == 2
    assert "http://" not in page


def test_the_verb_scores_what_its_file_holds(results, file_of, capsys):
    out = file_of(results, seed=5).parent
    assert main(["challenge", "--cases", "6", "--seed", "5", "--out", str(out)]) == 0
    assert "6 cases" in capsys.readouterr().out
    assert (out / "table.csv").read_text().startswith("what,found")
    assert "probewise challenge --cases 6 --seed 5" in (out / "report.html").read_text()


@pytest.fixture(scope="module")
def world():
    return World(gaussian_spot([Blob(1.0, (0.5, 1.5), (4.0, 2.5), 0.2)], pixel_mm=0.5))


@pytest.fixture(scope="module")
def plan():
    return paper_plan()


@pytest.fixture(scope="module")
def clean(world, plan):
    return world.simulate(plan, rng=None)


@pytest.fixture(scope="module")
def refit(clean):
    refit = NullRefit()
    refit.null_fit(clean)
    return refit


def changed(clean, change):
    return Recording(clean.plan, clean.readings + change)


def test_what_is_left_of_a_small_effect_is_its_projection(refit, clean):
    """Two routes: the refit, and least squares on slopes by differences."""
    null = refit.null_fit(clean)
    wave = 0.2 * np.sin(np.arange(len(clean)) / 7.0)
    _, slopes = null.model.predict_and_differentiate(null.z)
    left = wave - slopes @ np.linalg.lstsq(slopes, wave)[0]
    assert refit(clean, changed(clean, wave)) == pytest.approx(np.linalg.norm(left), rel=0.01)


def test_an_effect_is_like_itself_and_like_no_other(refit, world, plan, clean):
    at_s = float(np.quantile(plan.time_s, 0.4))
    step = replace(world, concealed=(ambient_step(1.0, at_s),)).simulate(plan, rng=None)
    few = {name: VOCABULARY[name] for name in ("ambient_step", "offset_drift", "backlash", "correlated_noise")}
    found = cosines_with_vocabulary(refit, clean, step, vocabulary=few)
    assert found["ambient_step"] == pytest.approx(1.0, abs=1e-3)
    assert 0.3 < found["offset_drift"] < 0.95
    assert found["backlash"] < 0.3
    assert "correlated_noise" not in found


@pytest.mark.slow
def test_a_skirt_about_a_gaussian_spot_is_one_gaussian_more(refit, world, plan, clean):
    """And a change of the light is not: it is not even asked."""
    skirt = replace(world, concealed=(halo(0.08, 12.0),)).simulate(plan, rng=None)
    assert cosines_with_vocabulary(refit, clean, skirt)["ssf_order"] > 0.99
    step = replace(world, concealed=(ambient_step(0.4, 300.0),)).simulate(plan, rng=None)
    assert "ssf_order" not in cosines_with_vocabulary(refit, clean, step)


def test_an_alarm_is_due_on_physics_alone():
    like = hidden("halo", cosines={"halo": 1.0, "ssf_order": 0.999})
    results = [single("halo", hide=like, p_value=0.7), single("lag", p_value=1e-5)]
    (found,) = (row for row in score(results) if row.name == "detection, alpha .01, lambda 8")
    assert (found.found.value, found.found.n) == (1.0, 1)


def lag(size, **cosines):
    return {"name": "lag", "size_lambda": size, "in_vocabulary": True, "cosines": {"lag": 1.0, **cosines}}


def test_one_rival_is_told_as_often_as_the_nearer_of_two_points():
    """What the rival of fitted size predicts is the projection of the truth on its direction, by least squares."""
    size, rho = 6.0, 0.8
    rng = np.random.default_rng(1)
    own = np.array([size, 0.0])
    way = np.array([rho, math.sqrt(1 - rho**2)])
    rival = np.linalg.lstsq(way[:, None], own, rcond=None)[0] * way
    read = own + rng.standard_normal((200_000, 2))
    right = np.linalg.norm(read - own, axis=1) < np.linalg.norm(read - rival, axis=1)
    assert oracle_name_rate(lag(size, halo=rho)) == pytest.approx(right.mean(), abs=0.003)


def test_the_hardest_rival_that_is_wrong_counts():
    # At lambda 8 a cosine of .99 leaves less than three nats: that name is right too.
    assert oracle_name_rate(lag(8.0, backlash=0.99)) == 1.0
    hard = oracle_name_rate(lag(8.0, halo=0.9))
    assert oracle_name_rate(lag(8.0, backlash=0.99, halo=0.9, glint=0.6)) == hard < 1


def test_the_set_holds_one_where_nothing_is_alike_and_aliases_count_once():
    assert oracle_credible_set_size(lag(8.0)) == 1.0
    assert oracle_credible_set_size(lag(8.0, backlash=1.0)) == 1.0
    assert 1.0 < oracle_credible_set_size(lag(8.0, halo=0.92)) < 2.0
    assert oracle_credible_set_size(lag(8.0, halo=0.5)) == pytest.approx(1.0, abs=0.01)


def test_no_number_of_repeated_plans_parts_two_that_agree():
    alias = case("alias", 12.0, truth=["lag"], hides=[hidden("lag", 12.0)], cosine=-1.0)
    assert readings_to_separate_alias(alias) == math.inf
    assert readings_to_separate_alias(alias | {"cosine": 0.5}) == pytest.approx(408 * 3 / 54)
