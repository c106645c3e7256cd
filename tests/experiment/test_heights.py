"""The sensor's height is one more thing that the robot may choose."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from exploring import run
from hand_made import NAMES, sensor_of

from probewise.arm import Pose, Reading, as_instrument
from probewise.errors import DoubtfulResultWarning, ParameterError
from probewise.experiment import experiment_for, explore, result_json
from probewise.inference import GaussianKnown
from probewise.inquiry import Grid
from probewise.recordings import Disc, Instrumentation
from probewise.scene import Circle, Field, HypothesisScene
from probewise.sensor import FAST_NODES, Chain, FixedLevels, FixedMixture, footprint_of, mean_ssf_field
from probewise.world import Blob, World, gaussian_spot

FIELD = Field(300.0, 200.0)
CIRCLE = Circle(FIELD, (40.0, 80.0), inside=True)
TRUTH = np.array([140.0, 100.0, 60.0])
MIXTURE = FixedMixture(np.ones(1), np.array([[1.0, 1.5]]), np.array([[[16.0, 2.0], [2.0, 9.0]]]))
CHAIN = Chain(MIXTURE, FixedLevels(10.0, 60.0), HypothesisScene(CIRCLE), n_nodes=FAST_NODES)
WORLD = World(
    gaussian_spot([Blob(1.0, (1.0, 1.5), (4.0, 3.0), 1 / 6)], pixel_mm=0.5), black=10.0, white=60.0, noise_sd=0.0
)
DISC = Disc((140.0, 100.0), 60.0)
HEIGHTS = (12.0, 21.0)


def asked(small, **changes):
    options = {
        "shape": CIRCLE,
        "model": CHAIN,
        "likelihood": GaussianKnown(1.0),
        "grid": Grid(300.0, 200.0, 13, 9),
        "n_particles": 300,
        "heights_mm": HEIGHTS,
        "calibrated_height_mm": 14.0,
    }
    return small.experiment(**(options | changes))


LOW_MM, SLOPE = 5.0, 0.01
CLOSE_WORLD = World(
    gaussian_spot([Blob(1.0, (1.0, 1.5), (4.0, 3.0), 0.0)], pixel_mm=0.5),
    black=10.0,
    white=60.0,
    noise_sd=0.0,
    height_mm=LOW_MM,
)
SENSOR = np.array([0.5, 1.0, 1.5, 1 / 32, 1 / 18, 0.0, 10.0, 60.0])
SAMPLES = SENSOR + 1e-4 * np.random.default_rng(0).standard_normal((500, 8))


@pytest.fixture
def close_sensor():
    """A sensor calibrated 5 mm above a table that slopes by a hundredth."""
    axis = np.arange(-20.0, 20.5, 0.5)
    return sensor_of(
        np.column_stack([SAMPLES, np.full(500, SLOPE)]),
        names=(*NAMES, "height_gradient.mm_per_mm"),
        noise_sd=np.full(500, 0.5),
        field=mean_ssf_field(footprint_of(SENSOR[None, :6], 1), u_mm=axis, v_mm=axis),
        effects=("height_gradient",),
        instrumentation=Instrumentation(height_mm=LOW_MM),
    )


@pytest.mark.parametrize("arm_mm", [LOW_MM, 14.0])
@pytest.mark.parametrize("method", ["particles", "paper"])
def test_effects_of_the_height_change_that_of_the_calibration(method, arm_mm, close_sensor):
    """The world reads higher by so many mm; whatever height the arm tells, designs and readings count as calibrated."""
    experiment = experiment_for(close_sensor, CIRCLE, FIELD, method=method, trust=1.0)
    poses = [Pose(float(x), 100.0) for x in (60.0, 78.0, 84.0, 140.0, 197.0, 203.0, 240.0)]
    read = [
        CLOSE_WORLD.read(DISC, pose.x_mm, pose.y_mm, time_s=0.0, rng=None, height_mm=LOW_MM + SLOPE * pose.x_mm)
        for pose in poses
    ]
    problem = experiment.problem([Reading(0.0, pose, 0.0, {"height_mm": arm_mm}) for pose in poses])
    np.testing.assert_allclose(problem.model.predict(TRUTH[None], problem.recording.plan)[0], read, atol=0.5)
    designs = replace(problem.recording.plan, covariates={}, instrumentation=experiment.instrumentation)
    np.testing.assert_allclose(experiment.forecast.predict(TRUTH[None], designs)[0], read, atol=0.5)


def test_a_slope_among_the_rivals_is_one_hundredth_of_the_calibrated_height(close_sensor):
    plain = replace(close_sensor, names=NAMES, samples=SAMPLES, effects=())
    for sensor, height_mm in ((plain, LOW_MM), (replace(plain, instrumentation=Instrumentation()), 14.0)):
        experiment = experiment_for(sensor, CIRCLE, FIELD, trust=0.9)
        (slope,) = [kind.effect for kind in experiment.kinds if kind.left_out == "height_gradient"]
        assert slope.entries[0, 0, 0] == pytest.approx(0.01 * height_mm / np.hypot(300.0, 200.0))


def test_a_journal_names_the_height_only_beside_others_to_choose(small, close_sensor):
    """Journals of earlier versions did so, and go on."""
    seed = np.random.SeedSequence(1)
    assert experiment_for(close_sensor, CIRCLE, FIELD).settings(seed)["options"]["calibrated_height_mm"] is None
    assert asked(small).settings(seed)["options"]["calibrated_height_mm"] == 14.0


class OwnArm:
    """Reads a disc from 20 mm; `tells` is what it says of that beside the reading, `more` what it declares."""

    def __init__(self, tells, **more):
        self.tells = tells
        self.__dict__ |= more

    def measure(self, pose):
        value = WORLD.read(DISC, pose.x_mm, pose.y_mm, time_s=0.0, rng=None, height_mm=20.0)
        return {"value": value, **self.tells}


ELSEWHERE = {"of each reading": OwnArm({"height_mm": 20.0}), "of the arm": OwnArm({}, read_height_mm=20.0)}


@pytest.mark.parametrize("arm", ELSEWHERE.values(), ids=ELSEWHERE.keys())
def test_a_run_at_another_height_than_the_calibrated_one_is_doubtful_and_says_so_once(small, arm):
    experiment = asked(small, heights_mm=())
    with pytest.warns(DoubtfulResultWarning) as warned:
        found = run(arm, experiment, rng=np.random.default_rng(1), max_readings=3)
    (said,) = warned
    assert "reads 20 mm above the surface, and the sensor was calibrated at 14 mm" in str(said.message)
    assert "calibrate the sensor at 20 mm, or name the height (heights_mm, --heights 20)" in str(said.message)
    assert all(step.notes == (str(said.message),) for step in found.steps)
    assert json.loads(result_json(found))["notes"] == [str(said.message)]
    assert f"doubtful: {said.message}" in found.summary()


def test_an_arm_that_declares_its_height_is_doubted_before_it_moves(small):
    moved = []
    arm = OwnArm({}, read_height_mm=20.0, measure=moved.append)
    steps = explore(arm, asked(small, heights_mm=()), rng=np.random.default_rng(1))
    with warnings.catch_warnings(action="error"), pytest.raises(DoubtfulResultWarning):
        next(steps)
    assert not moved


@pytest.mark.parametrize(
    ("tells", "changes"),
    [
        ({"height_mm": 14.1}, {}),
        ({"height_mm": np.nan}, {}),
        ({}, {}),
        ({"height_mm": 20.0}, {"calibrated_height_mm": None}),
        ({"height_mm": 20.0}, {"heights_mm": (20.0,)}),
    ],
)
def test_a_height_that_is_calibrated_unknown_or_named_leaves_no_doubt(small, tells, changes):
    experiment = asked(small, **({"heights_mm": ()} | changes))
    arm = OwnArm(tells, lifts=True)
    found = run(arm, experiment, rng=np.random.default_rng(1), max_readings=1)
    assert found.notes == ()


REFUSED = {
    "heights": ({}, {}, r"heights_mm \(--heights\) is \(12.0, 21.0\); .* read at pose.height_mm: lifts = True"),
    "a height that is not its own": ({"read_height_mm": 20.0}, {"heights_mm": (21.0,)}, "heights_mm"),
    "turns": (
        {"lifts": True},
        {"orientations_rad": (0.0, 0.5)},
        r"orientations_rad \(--orientations\) is \(0.0, 0.5\); .* to pose.orientation_rad: turns = True",
    ),
}


@pytest.mark.parametrize(("declared", "changes", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_what_an_arm_does_not_declare_that_it_can_is_refused_before_it_moves(
    small, tmp_path, declared, changes, message
):
    """It would be recorded as turned or lifted, and would not be."""
    moved = []
    arm = as_instrument(OwnArm({}, measure=moved.append, **declared))
    path = tmp_path / "journal.jsonl"
    with pytest.raises(ParameterError, match=message):
        next(explore(arm, asked(small, **changes), rng=np.random.default_rng(1), journal=path))
    assert not moved
    assert not path.exists()
