"""A study is the same whoever does it; what it conceals; what is said of many runs."""

import math

import numpy as np
import pytest
from scipy.stats import chi2, poisson

from probewise.arm import Pose
from probewise.errors import ParameterError
from probewise.experiment import CLEAN
from probewise.experiment.rivals import rivals_of
from probewise.proof.campaign import estimated_share
from probewise.proof.concealed_study import CONCEALED, ConcealedTrial, _arm_in_concealed_world
from probewise.proof.study import (
    BRIGHT,
    DARK,
    FIELD,
    REFERENCE,
    SearchConfiguration,
    Trial,
    experiment_of,
    experiment_of_trial,
    footprint_pixels,
    paper_comparison_rows,
    run_trial,
    summaries,
    summarise,
    trials_by_row,
)
from probewise.proof.study import study as campaign_of
from probewise.recordings import Disc, Plan
from probewise.world import World

from ..conftest import search

ROWS = {REFERENCE: 2, SearchConfiguration(model="naive"): 2}
BRIEF = {"max_readings": 3}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "trials.jsonl"
    return campaign_of(ROWS, **BRIEF).run(path=path), path


def timeless(results):
    return {trial: {key: value for key, value in t.items() if key != "cpu_s"} for trial, t in results.items()}


@pytest.mark.slow
def test_the_robot_knows_the_circle_when_it_stops():
    trial = run_trial(Trial(REFERENCE, 2))
    assert trial["reached"]
    assert trial["error_mm"] < 12
    assert len(trial["widest_mm"]) == trial["readings"]
    assert trial["widest_mm"][-1] < 4 <= trial["widest_mm"][-2]
    assert trial["first_white"] < trial["readings"]
    assert trial["bits_at_white"] < trial["bits"]


@pytest.mark.slow
def test_a_run_that_may_not_go_on_is_a_miss(study):
    table, trials = summaries(study[0]), trials_by_row(study[0])
    for row in ROWS:
        assert [t["reached"] for t in trials[row]] == [False, False]
        assert [t["readings"] for t in trials[row]] == [3, 3]
        assert table[row].mean.value == 3
        assert table[row].reached.value == 0


@pytest.mark.slow
def test_the_papers_method_stands_beside_ours_on_the_same_circle():
    """The first place is drawn by the same rule from other samples; levels come from readings before the run."""
    ours, paper, _, naive = rows = paper_comparison_rows(nested_stop="remaining")
    assert [row.method for row in rows] == ["particles", "paper"] * 2
    assert paper.name == "inside, SSF, the paper's method to remaining evidence"
    assert ours == REFERENCE
    for row in (paper, naive):
        found = run_trial(Trial(row, 0, max_readings=1))
        assert (found["readings"], found["reached"]) == (1, False)
    one, again, other = (experiment_of_trial(Trial(naive, k)).likelihood for k in (0, 0, 1))
    assert one == again != other
    assert abs(one.mu_black - 10) < 5 / 20**0.5
    assert abs(one.mu_white - 60) < 5 / 20**0.5


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"method": "other"}, "method"),
        ({"method": "paper"}, "utility, learn_sensor, batch"),
        ({"method": "paper", "utility": "entropy", "learn_sensor": True}, "utility, learn_sensor, batch"),
        ({"method": "paper", "utility": "entropy", "nested_stop": "never"}, "nested_stop"),
        ({"nested_stop": "remaining"}, "nested_stop"),
    ],
)
def test_rows_that_cannot_be_are_refused(changes, named):
    with pytest.raises(ParameterError) as caught:
        SearchConfiguration(**changes)
    assert caught.value.name == named


def test_what_a_file_holds_is_not_done_again(study):
    told = []
    one = campaign_of({REFERENCE: 1}, max_readings=3)
    again = one.run(path=study[1], progress=lambda *words: told.append(words))
    assert told == [("runs", 1, 1)]
    (trial,) = one.tasks.values()
    assert again == {trial: study[0][trial]}
    assert summaries(again) == {}


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_loses_and_counts_twice_nothing(study, tmp_path):
    """Two workers on this machine; one is killed as soon as the first run has ended."""
    distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")
    path, killed = tmp_path / "trials.jsonl", []
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, processes=True, host="127.0.0.1"
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        victim = cluster.workers[0].process.process

        def kill(stage, done, total, note=""):
            if note and not killed:
                victim._process.kill()
                killed.append(note)

        found = campaign_of(ROWS, **BRIEF).run(path=path, executor=client.get_executor(pure=False), progress=kill)
    assert killed
    assert timeless(found) == timeless(study[0])
    assert len(path.read_text().splitlines()) == 1 + 4


def _readings(trial):
    """Readings inside the circle, across its edge and beside it, and back."""
    x, y, r = trial.circle_mm
    with _arm_in_concealed_world(trial) as arm:
        return np.array([arm.measure(Pose(x + d, y, 0.0)).value for d in 3 * (0, r + 2, 0, r - 1, r + 30, 1 - r, 0)])


@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=pytest.mark.slow) if k == "edge_blur" else k for k in CONCEALED]
)
def test_every_form_changes_readings_over_some_circle(name):
    plain, hidden = (
        np.array([_readings(ConcealedTrial(effect, 2, circle, 1.0, varied=True)) for circle in range(2)])
        for effect in ("", name)
    )
    assert np.isfinite(hidden).all()
    assert np.abs(hidden - plain).max() > 0.05


def test_every_right_answer_is_a_rival_of_the_robot():
    known = experiment_of(REFERENCE)
    rivals = {r.name for r in rivals_of(known.model, known.likelihood, (FIELD.width_mm, FIELD.height_mm))}
    assert {name for k in CONCEALED for name in ConcealedTrial(k, 0, 0, 1.0).right_answers} <= rivals | {CLEAN}


def test_under_varied_conditions_the_robot_knows_noise_rounding_and_sensor():
    """Two routes: the robot's model, and pixels; over a hundred circles every kind of conditions comes up."""
    trials = [ConcealedTrial("", 0, k, 1.0, varied=True) for k in range(100)]
    now = [trial.conditions for trial in trials]
    assert {len(c.blobs) for c in now} == {1, 2}
    assert {c.step for c in now} == {None, 1.0}
    assert 0.3 < min(c.noise_sd for c in now) < 0.4 < 1.7 < max(c.noise_sd for c in now) < 2.0
    assert 2 < min(c.each_s for c in now) < 3 < 17 < max(c.each_s for c in now) < 20
    trial = next(t for t in trials if len(t.conditions.blobs) > 1)
    x, y, r = trial.circle_mm
    steps = np.linspace(r - 20, r + 20, 9)
    zero = np.zeros(9, dtype=np.int64)
    plan = Plan(x + steps, np.full(9, y), np.zeros(9), 8.0 * np.arange(9), zero, ("s",), zero, ("field",))
    world = World(footprint_pixels(trial.conditions.blobs), black=DARK, white=BRIGHT, noise_sd=0.0)
    seen = world.expected_readings(plan, {"field": Disc((x, y), r)})
    predicted = trial.conditions.experiment().model.predict(trial.circle_mm[None, :], plan)[0]
    np.testing.assert_allclose(predicted, seen, atol=0.1)


def test_a_scale_of_x_that_is_named_is_compared_as_it_was_put_right():
    """Along X to the true lengths, or along Y to the arm's along X; unnamed, a circle lies between."""
    trial = ConcealedTrial("scale_of_x", 2, 0, 0.9)
    true = trial.circle_mm
    for mean, name, right in (
        (true + 1, "position_scale", true),
        (true / 1.05 + 1, "position_scale", true / 1.05),
        (true, CLEAN, true / [1.05, 1, 1]),
    ):
        np.testing.assert_allclose(trial.circle_found_as(name, mean), right)


def trial(readings, **others):
    return search(
        readings, **{"first_white": 3, "bits": 20.0, "chance_wrong": 1e-3, "held": [True, True, False], **others}
    )


@pytest.mark.parametrize(("k", "n"), [(0, 50), (1, 7), (89, 100), (200, 200)])
def test_a_share_has_wilsons_interval(k, n):
    """Its ends are as many standard errors of theirs from the share as 95 % of a normal distribution (Wilson 1927)."""
    found, z2 = estimated_share([True] * k + [False] * (n - k)), chi2.ppf(0.95, 1)
    ends = np.roots([1 + z2 / n, -2 * k / n - z2 / n, (k / n) ** 2])
    assert (found.value, found.low, found.high) == pytest.approx((k / n, min(ends), max(ends)), abs=1e-12)


def test_a_miss_counts_as_the_limit_and_says_nothing_of_what_comes_after_white():
    found = summarise([trial(8), trial(14), trial(100, reached=False, first_white=None)], max_readings=100)
    assert found.mean.value == pytest.approx((8 + 14 + 100) / 3)
    assert found.median.value == 14
    assert found.after_white.value == pytest.approx((5 + 11) / 2)
    assert found.to_white.value == pytest.approx((3 + 3 + 100) / 3)
    assert found.reached.value == pytest.approx(2 / 3)
    assert found.held.value == pytest.approx(2 / 3)
    assert found.bits_each.value == pytest.approx(np.mean([20 / 8, 20 / 14, 0.2]))


def test_runs_that_are_sure_and_wrong_are_held_against_what_their_posteriors_expect():
    runs = [trial(9) for _ in range(997)] + [trial(9, error_mm=13.0) for _ in range(3)]
    found = summarise(runs, max_readings=100)
    assert found.wrong == 3
    assert found.wrong_expected == pytest.approx(1.0)
    assert poisson.sf(found.wrong_limit, 1.0) <= 0.01 < poisson.sf(found.wrong_limit - 1, 1.0)


def test_the_medians_interval_holds_it_as_often_as_it_says():
    """Distribution-free, so any skewed one will do: at least 95 of 100, over 400 tables of 41 runs."""
    rng = np.random.default_rng(4)
    draws = np.ceil(rng.lognormal(2.5, 0.8, (400, 41)))
    true = math.ceil(math.exp(2.5))
    tables = [summarise([trial(int(n)) for n in np.clip(row, 4, 1e6)], max_readings=10**6).median for row in draws]
    held = np.mean([t.low <= true <= t.high for t in tables])
    assert held > 0.95 - 4 * math.sqrt(0.95 * 0.05 / 400)


def test_one_run_has_no_error():
    with pytest.raises(ParameterError, match="2 or more"):
        summarise([trial(8)], max_readings=100)


@pytest.mark.parametrize(
    "wrong", [{"population": "outside"}, {"model": "best"}, {"utility": "luck"}, {"noise_sd": 0.0}, {"width": -1.0}]
)
def test_rows_that_mean_nothing_are_refused(wrong):
    with pytest.raises(ParameterError, match=next(iter(wrong))):
        SearchConfiguration(**wrong)
