"""Measure, infer, inquire: by hand, in a loop, killed and resumed, over what cannot be explained."""

import math
import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from exploring import ChainArm, run

from probewise.arm.instrument import Pose, Reading
from probewise.errors import FileError, ParameterError
from probewise.experiment import Exploration, arm_over, begin, explore, inquire, loop, read_journal, step
from probewise.experiment.judgement import is_target_reached, p_value_and_worst_reading
from probewise.experiment.paper import OneScan
from probewise.inference import GaussianKnown, StudentT
from probewise.inquiry import Grid, PerSecond, ReadingEntropy, UtilityMap
from probewise.inquiry.smc import prior_particles
from probewise.recordings import Disc
from probewise.scene import AnyOf, Circle, Field, Rectangle
from probewise.scene.scenes import HypothesisScene
from probewise.sensor import Chain, FixedLevels, FixedMixture
from probewise.world import Blob, World, gaussian_spot
from probewise.world.concealed import backlash, correlated_noise, lag

COARSE = Grid(400.0, 300.0, 14, 10)


def rng(seed=2013):
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def found():
    """One run of the soft sensor, shared by the tests that only look at it."""
    small = runpy.run_path(str(Path(__file__).with_name("conftest.py")))
    return run(small["QuickArm"](), small["small_experiment"](), rng=rng()), small


@pytest.fixture(scope="module")
def two_readings(small_for_all, tmp_path_factory):
    """The journal of a run of two readings."""
    journal = tmp_path_factory.mktemp("two") / "journal.jsonl"
    run(small_for_all.arm(), small_for_all.experiment(), rng=rng(), max_readings=2, journal=journal)
    return journal


def test_the_robot_finds_the_circle_to_the_precision_it_states(found):
    """Each parameter within five of its posterior sds: a right program fails once in a million."""
    result, small = found
    truth = np.array(small["QuickArm"]().truth)
    assert result.target_reached
    assert (result.last.sd < 4.0).all()
    assert (np.abs(result.last.mean - truth) < 5 * result.last.sd).all()
    assert result.stop_reason == "every length is known to better than 4 mm"


def test_a_step_by_hand_is_a_step_of_the_loop(small):
    experiment, arm = small.experiment(), small.arm()
    first = next(iter(explore(arm, experiment, rng=rng())))
    # explore() takes the first child of the generator's seed, and of that a child for each reading.
    child = np.random.SeedSequence(2013).spawn(1)[0]
    start, then = (
        np.random.default_rng(np.random.SeedSequence(child.entropy, spawn_key=(*child.spawn_key, k))) for k in (0, 1)
    )
    state = begin(experiment, small.arm(), rng=start)
    assert state.next_pose == first.reading.pose
    state, info = step(state, small.arm().measure(state.next_pose), experiment, rng=then)
    np.testing.assert_array_equal(info.samples, first.samples)
    assert (info.bits, info.log_z, info.next_pose) == (first.bits, first.log_z, first.next_pose)
    assert state.readings == (first.reading,)


def same(a, b):
    """Bit for bit, but for where the reading came from."""
    return (
        (a.number, a.reading, a.next_pose, a.bits, a.log_z, a.p_value, a.stop_reason)
        == (b.number, b.reading, b.next_pose, b.bits, b.log_z, b.p_value, b.stop_reason)
        and (a.samples == b.samples).all()
        and (a.mean == b.mean).all()
        and (a.map.values == b.map.values).all()
    )


def test_one_seed_gives_one_run_and_two_runs_of_a_generator_differ(small):
    experiment = small.experiment()
    one, again = (run(small.arm(), experiment, rng=rng(), max_readings=3) for _ in range(2))
    assert all(same(a, b) for a, b in zip(one.steps, again.steps, strict=True))
    shared = rng()
    first, second = (run(small.arm(), experiment, rng=shared, max_readings=2) for _ in range(2))
    assert first.readings[0].pose != second.readings[0].pose


def test_a_simulated_run_resumed_at_any_reading_writes_the_journal_of_one_never_interrupted(small, tmp_path):
    """Its clock shows the way from the place of the last reading, its noise is that of the next."""
    surface, concealed = Disc((250.0, 140.0), 60.0), (backlash(9.0), lag(3.0), correlated_noise(0.7))
    world = World(gaussian_spot([Blob(1.0, (0.0, 0.0), (8.0, 8.0))]), concealed=concealed)
    experiment = small.experiment(grid=COARSE, n_particles=200)

    def simulated(journal, taken=()):
        with arm_over(world, surface, Field(400.0, 300.0), seed=5, taken=taken) as arm:
            return run(arm, experiment, rng=rng(), max_readings=3, journal=journal)

    whole, journal = simulated(tmp_path / "whole"), tmp_path / "journal.jsonl"
    written = (tmp_path / "whole").read_bytes()
    ends = [k + 1 for k, byte in enumerate(written) if byte == ord("\n")]
    torn = written.index(b', "belief"', ends[1])
    for cut in [*ends[:3], torn]:
        journal.write_bytes(written[:cut])
        before = read_journal(journal)
        resumed = simulated(before, before.readings)
        assert journal.read_bytes() == written, cut
        assert resumed.readings == whole.readings
        assert any("the reading is kept" in note for note in resumed.steps[0].notes) == (cut == torn)
        assert resumed.last.mean.tolist() == whole.last.mean.tolist()


def test_a_journal_that_has_grown_since_it_was_read_is_not_resumed(small, tmp_path):
    journal = tmp_path / "journal.jsonl"
    run(small.arm(), small.experiment(grid=COARSE), rng=rng(), max_readings=1, journal=journal)
    before = read_journal(journal)
    run(small.arm(), small.experiment(grid=COARSE), rng=rng(), max_readings=2, journal=journal)
    text = journal.read_bytes()
    with pytest.raises(FileError, match="another process has written to it"):
        run(small.arm(), small.experiment(grid=COARSE), rng=rng(), max_readings=3, journal=before)
    assert journal.read_bytes() == text


def test_a_run_that_ended_is_replayed_without_asking_the_arm(small, tmp_path):
    journal = tmp_path / "journal.jsonl"
    first = run(small.arm(), small.experiment(), rng=rng(), max_readings=3, journal=journal)
    text = journal.read_bytes()
    arm = small.arm()
    second = run(arm, small.experiment(), rng=rng(), max_readings=3, journal=journal)
    assert arm.poses == []
    assert journal.read_bytes() == text
    assert all(same(a, b) for a, b in zip(first.steps, second.steps, strict=True))


def holey(small, missing):
    """Return an arm whose readings are missing at the poses that `missing` marks."""

    class Holey(small.arm):
        def measure(self, pose):
            reading = super().measure(pose)
            return replace(reading, value=math.nan) if missing(pose) else reading

    return Holey()


@pytest.mark.parametrize("changes", [{}, {"repeats": (3,), "noise_sd": 6.0}])
def test_a_run_goes_elsewhere_after_a_missing_reading_also_when_resumed(small, tmp_path, changes):
    """The first pose has no value, nor has any within 40 mm; the reading after it would be the best one there."""
    first = run(small.arm(), small.experiment(**changes), rng=rng(), max_readings=1).readings[0].pose

    def missing(pose):
        return math.hypot(pose.x_mm - first.x_mm, pose.y_mm - first.y_mm) < 40.0

    journal = tmp_path / "journal.jsonl"
    whole = run(holey(small, missing), small.experiment(**changes), rng=rng(), max_readings=4, journal=journal)
    lines = journal.read_bytes().splitlines(keepends=True)
    assert [math.isnan(reading.value) for reading in whole.readings] == [True, False, False, False]
    journal.write_bytes(b"".join(lines[:2]))
    resumed = run(holey(small, missing), small.experiment(**changes), rng=rng(), max_readings=4, journal=journal)
    assert resumed.readings[1:] == whole.readings[1:]


def test_a_run_without_values_ends_and_goes_on_when_resumed_with_the_instrument_mended(small, tmp_path):
    journal, experiment = tmp_path / "journal.jsonl", small.experiment(grid=COARSE)
    lost = run(holey(small, lambda _: True), experiment, rng=rng(), journal=journal)
    assert len(lost.steps) == 8
    assert len({reading.pose for reading in lost.readings}) == 8
    assert lost.stop_reason.startswith("the last 8 readings are all missing")
    mended = run(small.arm(), experiment, rng=rng(), journal=journal, max_readings=10)
    assert [info.stop_reason for info in mended.steps[:9]] == [None] * 9
    assert np.isfinite([reading.value for reading in mended.readings[8:]]).all()


@pytest.mark.parametrize(
    ("change", "options", "error", "says"),
    [
        ({"n_samples": 40}, {}, FileError, "other settings: .*options"),
        ({"blur_mm": 9.0}, {}, FileError, "other settings: .*sensor"),
        ({"grid": Grid(400.0, 300.0, 41, 31)}, {}, FileError, "other settings: .*field"),
        ({}, {"rng": rng(5)}, FileError, "seed '2013' there, '5' here"),
        ({}, {"max_readings": 1}, ParameterError, r"max_readings is 1; allowed: the 2 readings the journal holds"),
    ],
)
def test_a_journal_of_another_run_is_not_resumed(small, two_readings, change, options, error, says):
    with pytest.raises(error, match=says):
        explore(small.arm(), small.experiment(**change), **{"rng": rng(), "journal": two_readings, **options})


@pytest.mark.parametrize("beyond_s", [np.nan, np.inf])
def test_a_reading_whose_true_place_is_just_beyond_the_reach_ends_no_run(small, beyond_s):
    class Own:
        def reachable(self, places_mm):
            return places_mm[:, 0] >= 100.0

        def travel_s(self, start, places_mm):
            return np.where(self.reachable(places_mm), 2.0, beyond_s)

        def measure(self, pose):
            return {"value": 10.0, "x_mm": 99.9}

    experiment = small.experiment(utility=PerSecond())
    assert len(run(Own(), experiment, rng=np.random.default_rng(3), max_readings=2).steps) == 2


def test_readings_that_no_hypothesis_allows_are_flagged_and_never_nan(small):
    """A surface brighter than any hypothesis predicts: 95 where 10 to 60 are possible."""

    class Glaring(small.arm):
        def measure(self, pose):
            return replace(super().measure(pose), value=95.0)

    result = run(Glaring(), small.experiment(), rng=rng(), max_readings=2)
    assert len(result.steps) == 2
    assert result.last.p_value < 1e-100
    assert "no hypothesis explains the readings" in result.notes[-1]
    assert "doubtful: no hypothesis" in result.summary()
    assert np.isfinite(result.last.mean).all()


@pytest.mark.parametrize(
    ("reading_range", "step", "value", "fits"),
    [
        ((1.0, 50.0), 1.0, 50.0, True),
        ((1.0, 50.3), 1.0, 50.0, True),
        ((1.0, 50.0), None, 50.0, True),
        ((1.0, 50.0), 1.0, 49.0, False),  # of 60, where 50 would have been read
        ((-math.inf, math.inf), None, 50.0, False),
        ((50.0, 99.0), 1.0, 50.0, False),
        ((72.0, 99.0), 1.0, 72.0, True),
        ((70.0, 99.0), 1.0, 99.0, False),
    ],
)
def test_a_reading_at_an_end_of_the_scale_fits_what_is_predicted_beyond(small, reading_range, step, value, fits):
    """Ten noise sds lie between the 60 that is predicted on white and a reading of 50."""
    experiment = small.experiment(reading_range=reading_range, step=step)
    problem = experiment.problem([Reading(value, Pose(250.0, 140.0), 0.0)])
    posterior = prior_particles(experiment.prior, 1, rng=rng()).weighted
    posterior = replace(posterior, theta=np.array([[250.0, 140.0, 60.0]]))
    p_value, _ = p_value_and_worst_reading(experiment, posterior, problem)
    assert (p_value > 0.01) == fits


@pytest.mark.parametrize(
    "change",
    [{"stop_sd_mm": 0.0}, {"noise_sd": math.nan}, {"n_samples": 1}, {"n_particles": 10}, {"stop_probability": 1.0}],
)
def test_an_option_out_of_range_is_refused_by_name(small, change):
    with pytest.raises(ParameterError, match=next(iter(change))):
        small.experiment(**change)
    with pytest.raises(ParameterError, match=r"model\.names"):
        small.experiment(model=small.sensor(names=("x_mm", "y_mm")))


def test_a_growing_scan_has_the_student_t_of_one_data_set():
    readings, predicted = rng().normal(30, 2, 7), rng(1).normal(30, 2, (5, 7))
    expected = StudentT(np.zeros(7, int), 0.3, 10.0).log_prob(readings, predicted)
    np.testing.assert_allclose(OneScan(0.3, 10.0).log_prob(readings, predicted), expected)


def real_experiment(small, shape, **changes):
    mixture = FixedMixture(np.array([1.0]), np.array([[2.0, 3.0]]), np.array([[[56.0, 4.0], [4.0, 30.0]]]))
    chain = Chain(mixture, FixedLevels(10.0, 60.0), HypothesisScene(shape))
    return small.experiment(shape=shape, model=chain, likelihood=GaussianKnown(1.0), **changes)


@pytest.mark.slow
def test_of_a_set_of_shapes_the_robot_finds_which_and_where(small):
    """Paper: "a general system that works for any expected shape or set of shapes"."""
    field = Field(400.0, 300.0)
    shape = AnyOf({"circle": Circle(field, (40.0, 100.0), True), "rectangle": Rectangle(field, (80.0, 180.0), True)})
    experiment = real_experiment(small, shape, n_live=200, stop_sd_mm=6.0)
    only = real_experiment(small, shape.shapes["rectangle"])
    result = run(ChainArm(only.model, (210.0, 140.0, 150.0, 90.0, 0.4)), experiment, rng=rng(), max_readings=60)
    assert result.target_reached
    assert result.last.likely_shape == "rectangle"
    assert result.last.shapes["rectangle"] > 0.95
    assert "rectangle (p = " in result.last.summary()
    columns = shape.prior.columns_by_shape[1]
    assert np.isnan(np.delete(result.last.mean, columns)).all()
    error = result.last.mean[columns][:2] - [210.0, 140.0]
    assert (np.abs(error) < 5 * result.last.sd[columns][:2]).all()
    known = np.where(np.isfinite(result.last.sd), 1.0, np.nan)  # it stops on the lengths of the most probable
    assert is_target_reached(experiment, known, {"circle": 0.01, "rectangle": 0.99})
    assert not is_target_reached(experiment, known, {"circle": 0.4, "rectangle": 0.6})
    assert not is_target_reached(experiment, known * 7, {"circle": 0.01, "rectangle": 0.99})


@pytest.mark.slow
def test_a_run_that_nothing_explains_does_not_call_itself_known(small):
    """A sensor whose edges are four times as soft as the model believes, asked for half a millimetre."""
    blurred = small.arm(sensor=small.sensor(32.0))
    result = run(blurred, small.experiment(stop_sd_mm=1.0, grid=COARSE), rng=rng(), max_readings=40)
    said = [info.number for info in result.steps if any("no hypothesis explains" in note for note in info.notes)]
    assert said
    assert not result.target_reached
    assert is_target_reached(result.experiment, result.last.sd, result.last.shapes)
    assert "is not to be trusted" in result.stop_reason
    assert f"p = {result.last.p_value:.1g}" in result.stop_reason


@pytest.mark.slow
def test_several_readings_are_chosen_at_a_time(small):
    """Poses of a batch are those planned after its first reading, whatever they return."""
    arm = small.arm()
    steps = list(explore(arm, small.experiment(batch=3, grid=COARSE), rng=rng(), max_readings=6))
    poses = [(info.reading.pose.x_mm, info.reading.pose.y_mm) for info in steps]
    assert len(set(poses)) == 6
    other = small.arm(truth=(90.0, 60.0, 40.0))
    again = [
        (info.reading.pose.x_mm, info.reading.pose.y_mm)
        for info in explore(other, small.experiment(batch=3, grid=COARSE), rng=rng(), max_readings=3)
    ]
    assert again == poses[:3]
    with pytest.raises(ParameterError, match="batch"):
        small.experiment(batch=2, utility=ReadingEntropy())


@pytest.fixture
def peaked(small):
    """A map of another utility than information, with its peak at one place, and where that is."""
    experiment = small.experiment(grid=COARSE)
    values = np.zeros(len(experiment.designs))
    values[7] = 1.0
    design = experiment.designs[7]
    there = UtilityMap(experiment.designs, values, np.ones(len(values), dtype=bool), "chance to end the run")
    return there, (design.x_mm, design.y_mm)


def one_step(experiment, arm, planned):
    """Take the first step by hand, with poses planned before it."""
    state = replace(begin(experiment, arm, rng=rng()), planned=planned)
    return step(state, arm.measure(state.next_pose), experiment, rng=rng())


@pytest.mark.parametrize("asks", [False, True])
def test_a_reading_for_which_the_run_goes_on_is_taken_before_those_planned(small, peaked, monkeypatch, asks):
    there, place = peaked
    experiment, planned = small.experiment(batch=3, grid=COARSE), (Pose(10.0, 20.0), Pose(30.0, 40.0))
    assert len(experiment.kinds) == 1
    object.__setattr__(experiment, "trust", 0.9)  # this sensor has no rivals, so the constructor would refuse
    monkeypatch.setattr(inquire, "utilities_near_end", lambda *_, **__: there)
    monkeypatch.setattr(loop, "must_continue", lambda *_: asks)
    state, info = one_step(experiment, small.arm(), planned)
    assert (info.next_pose, *state.planned) == ((Pose(*place),) if asks else planned)


def test_repeats_are_taken_on_the_spot(small):
    experiment = small.experiment(repeats=(3,), noise_sd=6.0, likelihood=small.gaussian(6.0))
    result = run(small.arm(), experiment, rng=rng(), max_readings=6)
    places = [(r.pose.x_mm, r.pose.y_mm) for r in result.readings]
    assert places[0] == places[1] == places[2] != places[3]
    assert places[3] == places[4] == places[5]


def test_a_run_that_nothing_within_reach_can_advance_stops_and_says_so(small):
    """Four places and a sensor that says yes or no: when all are read, a further reading tells nothing."""
    arm = small.arm(sensor=small.sensor(0.0), reach_mm=30.0)
    result = run(arm, small.experiment(blur_mm=0.0, grid=COARSE), rng=rng(), max_readings=20)
    assert "every reading within reach promises the same" in result.stop_reason
    assert len(result.steps) <= 4
    assert not result.target_reached


ONE_PLACE = Grid(400.0, 300.0, 3, 3)  # of which (200, 0) is the only one within 30 mm of the arm


@np.errstate(all="raise")  # which is the caller's, and ends no run
def test_a_run_stops_when_the_only_place_within_reach_has_told_all_and_is_refused_where_it_tells_nothing(small):
    """A sensor that says yes or no, and has said it; and no circle of the prior near that place."""
    arm = small.arm(sensor=small.sensor(0.0), reach_mm=30.0)
    result = run(arm, small.experiment(blur_mm=0.0, grid=ONE_PLACE), rng=rng(), max_readings=20)
    assert len(arm.poses) == 1
    assert result.stop_reason.startswith("the only reading within reach promises nothing more, 0: none would tell")
    assert "the widest length is known to" in result.stop_reason
    far, arm = small.circle(width_mm=80.0, radius_mm=(20.0, 40.0)), small.arm(reach_mm=30.0)
    with pytest.raises(ParameterError, match="no reading within reach is expected to tell anything"):
        run(arm, small.experiment(shape=far, grid=ONE_PLACE), rng=rng())
    assert arm.poses == []


def test_a_run_that_went_on_to_check_its_sensor_says_both(found):
    whole, _ = found
    steps = [replace(step, checks_sensor=k >= len(whole.steps) - 3) for k, step in enumerate(whole.steps)]
    steps[-1] = replace(steps[-1], checks_sensor=False)
    assert replace(whole, steps=tuple(steps)).stop_reason == (
        "every length is known to better than 4 mm; 2 readings only checked what the sensor model may leave out"
    )


@pytest.mark.parametrize(("doubt_p", "p_value", "n_notes"), [(0.0, 1e-9, 2), (0.0, 0.2, 1), (1e-6, 1e-9, 1)])
def test_a_coarse_model_that_nothing_fits_says_so(doubt_p, p_value, n_notes):
    run = SimpleNamespace(
        last=SimpleNamespace(p_value=p_value, notes=("a",)), experiment=SimpleNamespace(doubt_p=doubt_p)
    )
    assert len(Exploration.notes.fget(run)) == n_notes
