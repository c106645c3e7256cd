"""What a newcomer gets wrong first is said in words, where it is made: never a KeyError or a TypeError from below."""

import warnings
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hand_made import TRUTH, sensor_of

import probewise
from probewise import diagnosis
from probewise.arm import Pose, Reading, SimulatedArm
from probewise.calibration import Calibration, read_sensor
from probewise.diagnosis import diagnose_system, fit_simulator
from probewise.effects import VOCABULARY
from probewise.errors import NotConvergedError, ProbewiseError
from probewise.experiment import Experiment, Exploration
from probewise.inference import GaussianKnown, Naive, Rounded, SensorProblem, StudentT
from probewise.inquiry import Grid
from probewise.investigation import investigate
from probewise.nested import RemainingEvidence, diversify, run
from probewise.priors import Product, Uniform
from probewise.recordings import HalfPlane, Plan, Recording, read_recording, write_recording
from probewise.scene import Circle, HypothesisScene
from probewise.sensor import Chain, FixedLevels, FixedMixture, FreeLevels
from probewise.systems import RunTable, Simulator, predict_system
from probewise.world import Blob, World, gaussian_spot

RNG = np.random.default_rng(0)
EDGE = HalfPlane(0.0, 0.0)
RECORDING = Recording.from_table(
    {"x_mm": np.linspace(-20, 20, 30), "y_mm": 0, "reading": np.linspace(10, 60, 30)},
    patterns={"edge": EDGE},
    unit="LEGO",
)
PLAN = RECORDING.plan
# The pattern is named, and nobody says what it is.
UNDESCRIBED = Recording(
    Plan(
        PLAN.x_mm, PLAN.y_mm, PLAN.orientation_rad, PLAN.time_s, PLAN.scan, PLAN.scan_names, PLAN.pattern, ("edge",), {}
    ),
    RECORDING.readings,
)
CIRCLE = Circle()
MIXTURE = FixedMixture([1.0], [[0.0, 1.5]], [[[16.0, 0.0], [0.0, 6.25]]])
MODEL = Chain(MIXTURE, FixedLevels(10.0, 60.0), HypothesisScene(CIRCLE))
SENSOR = sensor_of(np.tile(TRUTH, (500, 1)))
EXPERIMENT = Experiment(CIRCLE, MODEL, GaussianKnown(0.7), 0.7)
ARM = SimulatedArm(lambda pose, time_s, height_mm: 10.0)
TABLE = {"run": ["a"] * 12, "t_s": np.arange(12.0), "temp_c": 20.0 + np.arange(12.0)}


def simulator(**changed):
    """A heater that is told nothing wrong but what is changed."""
    known = {"reading": "temp_c", "unit": "degC", "parameters": {"tau_s": ("log", 1, 1000)}, "time": "t_s"}
    return Simulator(**{**known, "simulate": lambda p, data: p["tau_s"] + data["t_s"], **changed})


def arrays(**changed):
    """A plan of which nothing is wrong but what is changed."""
    return Plan.from_arrays(**{"x_mm": np.arange(30.0), "y_mm": 0, "patterns": EDGE, "unit": "V", **changed})


def inquiry(**changed):
    """A line through the origin, measured with noise, of which nothing is wrong but what is changed."""
    known = {"model": lambda p, x: p["a"] * x, "prior": {"a": (0, 1)}, "settings": np.arange(3.0), "noise": 0.1}
    return probewise.Inquiry(**{**known, **changed}, rng=RNG)


def record(number, plan, asked):
    """Records what is known already."""
    return RECORDING


OVEN = simulator()
FIELD = Recording.from_table({"x_mm": [500.0], "y_mm": 250.0, "reading": [10.0]}, patterns={"field": EDGE}, unit="LEGO")


class OneNumber:
    """A likelihood that forgets that it is asked for many hypotheses."""

    def log_prob(self, readings, predicted):
        return 0.0


class Frame:
    """Stands for a data frame, of many lines."""

    def __repr__(self):
        return "   x_mm  reading\n" + "0  -10.0  0.4\n" * 60


class Bell:
    prior = Product({"x": Uniform(-5.0, 5.0), "y": Uniform(-5.0, 5.0)})

    def __init__(self, log_likelihood=None):
        self.log_likelihood = log_likelihood or (lambda theta: -0.5 * (theta**2).sum(axis=1))


class OfOne(Calibration):
    """A calibration, whatever it was made of."""

    sensor = SENSOR


CALIBRATION = OfOne(RECORDING, ())


def found():
    """Run nested sampling, short."""
    with warnings.catch_warnings(action="ignore"):
        return run(Bell(), rng=np.random.default_rng(1), n_live=20, stop=RemainingEvidence(5.0))


calibrate, explore, diagnose, sampled, fitted, predicted, investigated = (
    partial(verb, rng=RNG)
    for verb in (
        probewise.calibrate,
        probewise.explore,
        diagnosis.diagnose,
        run,
        fit_simulator,
        predict_system,
        investigate,
    )
)
A_RECORDING = "allowed: a Recording: read_recording"
A_SENSOR = "allowed: a FittedSensor: read_sensor"

MISTAKES = {
    "names in an array without an axis": (lambda: arrays(scan=np.array("a")), "scan is .*one per reading"),
    "a ragged column": (
        lambda: fitted(OVEN, {**TABLE, "temp_c": [[1], [1, 2]]}),
        "column 'temp_c' is .*numbers, in an",
    ),
    "half a scan": (lambda: replace(PLAN, scan=PLAN.scan + 0.5), "scan is .*allowed: whole numbers"),
    "a word for a number of places": (lambda: Grid(n_x="many"), "n_x is 'many'; allowed: a whole number, 2"),
    "a word for truth": (lambda: Circle(inside="no"), "inside is 'no'; allowed: True or False"),
    "columns for a column": (lambda: RunTable(TABLE, time=["t_s"]), "time is .*allowed: the name of a column"),
    "a masked name": (lambda: arrays(scan=np.ma.array(["a"] * 30, mask=[1] * 30)), r"scan\[0\] is .*a name in every"),
    "a transform to words": (
        lambda: sampled(lambda p: 0.0, lambda u: "far", names=["x"]),
        "what the prior makes .* is 'far'; allowed: numbers",
    ),
    "no parameter": (lambda: inquiry(prior={}), r"prior is \{\}; allowed: one parameter or more"),
    # randomness
    "a seed to calibrate": (lambda: calibrate(RECORDING, rng=0), r"rng is 0; .*default_rng\(0\)"),
    # calibrate
    "an unknown pattern": (lambda: calibrate(UNDESCRIBED), "'edge' is named but not described"),
    # predict
    "swapped": (lambda: probewise.predict(PLAN, SENSOR), "sensor is .*order predict"),
    # audit
    "a misspelt word of an audit": (
        lambda: probewise.audit(PLAN).effects_with_detectability("invisibel"),
        "detectability is 'invisibel'; .*; did you mean invisible",
    ),
    # explore
    "an unknown shape": (lambda: explore(SENSOR, shape="heart"), "shape is 'heart'; allowed: one of"),
    # nested sampling
    "a function as problem": (lambda: sampled(lambda theta: 0.0), "allowed: a problem with a prior and a log_likel"),
    "a scalar likelihood": (
        lambda: sampled(Bell(lambda theta: -0.5 * float((theta**2).sum()))),
        r"returned shape \(\); allowed: \(300,\), one number per hypothesis: theta is a batch of shape \(300, 2\)",
    ),
    "an interval by name": (lambda: found().interval("x"), "mass is 'x'; .*columns of the result are x 0, y 1"),
    # priors
    "bounds for a distribution": (
        lambda: Product({"a": (0, 1)}),
        r"marginals\['a'\] is \(0, 1\); .*Uniform\(low, high",
    ),
    # poses and readings
    "a reading swapped": (
        lambda: Reading(Pose(0, 0), 3.0, 0.0),
        r"value is Pose\(.*order Reading\(value, pose, time_s",
    ),
    "a world as light": (
        lambda: SimulatedArm(World(gaussian_spot([Blob(1.0, (0.0, 0.0), (4.0, 4.0))]))),
        r"allowed: a function light\(pose, time_s, height_mm\)",
    ),
    "light without a number": (
        lambda: SimulatedArm(lambda pose, time_s, height_mm: None).measure(Pose(500.0, 200.0)),
        "what light returned is None; allowed: a number",
    ),
    # instruments of one's own
    "a size alone": (lambda: explore(SENSOR, conceal=3), "conceal is 3; allowed: effects as a text"),
    "an arm that cannot measure": (lambda: explore(SENSOR, arm=Bell()), r"object with measure\(pose"),
    "a Calibration to explore": (lambda: explore(CALIBRATION), "take its .sensor, this is the OfOne"),
    "a truth by wrong names": (
        lambda: explore(SENSOR, truth={"x_mm": 500, "radius_mm": 90}),
        "truth is .*; allowed: one number for each of x_mm, y_mm, radius_mm",
    ),
    # files
    "a method to write": (
        lambda: write_recording(Exploration(EXPERIMENT, ()).recording, "r.csv"),
        r"this is the method recording, call it: recording\(\)",
    ),
    "a table to read": (lambda: read_recording(Frame()), r"Recording.from_table\(\.\.\.\)"),
    "a sensor to read": (
        lambda: read_sensor(SENSOR),
        "allowed: the name of a sensor.json file; a FittedSensor needs no",
    ),
    # simulators
    "a table for a simulator": (
        lambda: diagnose_system(TABLE, OVEN, rng=RNG),
        r"simulator is .*; allowed: a Simulator\(",
    ),
    "a table of no row": (lambda: fitted(OVEN, {"t_s": [], "temp_c": []}), "table is 'without a row'"),
    "a file for a function": (
        lambda: simulator(simulate="oven.py"),
        r"simulate is 'oven.py'; .*read_simulator\('FILE.py'\)",
    ),
    "a text for a flag": (lambda: simulator(vectorized="no"), "vectorized is 'no'; allowed: True or False"),
    "a number for the noise": (lambda: simulator(noise=0.05), "noise is 0.05; .*was {'sd': 0.05} meant"),
    "one name for several": (
        lambda: simulator(run="run", per_run="tau_s"),
        r"per_run is 'tau_s'; .*in a list: \['tau_s'\]",
    ),
    # models and effects of one's own
    "a function for a null": (
        lambda: diagnose(RECORDING, null=lambda p, plan: 0),
        r"null is .*; allowed: a null model: SensorAndShape",
    ),
    "an effect by another name": (
        lambda: diagnose(RECORDING, effects={"lagg": VOCABULARY["lag"]}),
        "effects is 'lagg'; allowed: 'lag', the name of that effect",
    ),
    "a likelihood of one number": (
        lambda: SensorProblem(CIRCLE.prior, MODEL, OneNumber(), FIELD).log_likelihood(
            np.array([[500.0, 250.0, 90.0]] * 2)
        ),
        r"log_prob of OneNumber returned shape \(\); allowed: \(2,\), one number per hypothesis",
    ),
    # investigations
    # tables
    # settings of any instrument
    # the verbs
    "an array without an axis": (
        lambda: explore(SENSOR, repeats=np.array(1)),
        r"repeats is array\(1\); allowed: a num",
    ),
    "a bar of another kind": (
        lambda: calibrate(RECORDING, progress=lambda done: None),
        r"progress is .*; allowed: True, False, or a function progress\(stage, done, total, note\)",
    ),
    "a folder that cannot be": (
        lambda: explore(SENSOR, journal="/proc/nowhere/run.jsonl", progress=False),
        "/proc/nowhere: cannot be made",
    ),
    # drawings
    # recordings and plans
    "a row that is not there": (
        lambda: RECORDING.take([30]),
        "rows is .*; allowed: numbers of rows in a list, up to 29",
    ),
    # scenes
    # sensors
    "a shape as scene": (lambda: Chain(MIXTURE, FreeLevels(), CIRCLE), "scene is .*; allowed: a scene such as"),
    # likelihoods and problems
}


@pytest.mark.parametrize(("make", "message"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_said_in_words(make, message):
    with pytest.raises(ProbewiseError, match=message) as raised:
        make()
    assert isinstance(raised.value, ValueError | NotConvergedError)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 420


def test_lists_are_taken_where_arrays_are_meant():
    theta = [[0.5, 0.5]]
    assert Bell.prior.log_prob(theta) == pytest.approx(-2 * np.log(10.0))
    for likelihood in (
        GaussianKnown(1.0),
        Naive(10.0, 1.0, 60.0, 1.0),
        Rounded(1.0),
        StudentT(np.zeros(2, dtype=int), 0.1, 10.0),
    ):
        expected = likelihood.log_prob(np.array([10.0, 60.0]), np.array([[10.0, 60.0]]))
        assert likelihood.log_prob([10, 60], [[10, 60]]).tolist() == expected.tolist()
    assert ARM.reachable([[500, 200]]).tolist() == [True]
    moved = diversify([[0.1, 0.2], [0.3, 0.4]], Bell(), rng=np.random.default_rng(0), n_steps=2)
    assert moved.shape == (2, 2)


def test_numbers_of_numpy_are_numbers():
    pose = Pose(np.float32(1.5), np.int64(2), np.array(0.5))
    assert (pose.x_mm, pose.y_mm, pose.orientation_rad) == (1.5, 2.0, 0.5)
    assert type(pose.x_mm) is float
