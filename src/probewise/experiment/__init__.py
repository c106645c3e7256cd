"""The autonomous experiment: measure, infer, inquire, with a journal of measurements (paper, sections 2.2, 2.3)."""

from probewise.experiment.acquisition import ArmReachAndTravel
from probewise.experiment.configuration import Experiment, OneScan
from probewise.experiment.digest import value_digest
from probewise.experiment.fitted_arm import FittedArm
from probewise.experiment.found import OFF_MM, FoundParameter, FoundShape, found_shape, result_json, samples_csv
from probewise.experiment.from_names import MethodName, experiment_from_names
from probewise.experiment.hidden import HiddenShape, Truth, possible_shapes_by_name
from probewise.experiment.journal import (
    Entry,
    Journal,
    JournalWriter,
    PosteriorSummary,
    read_journal,
    recording_of,
    require_same_settings,
)
from probewise.experiment.left_out import CLEAN, LeftOutEffects, left_out_after_step, repaired_sensor
from probewise.experiment.limit import least_readings
from probewise.experiment.loop import begin, explore, run, step
from probewise.experiment.method import Method, SequentialMonteCarlo
from probewise.experiment.paper import (
    NestedSampling,
    naive_levels_from_recording,
    naive_levels_from_world,
    paper_experiment,
    student_t_likelihood,
)
from probewise.experiment.sensor_update import AdjustedMixture, SensorChangeSds, sensor_prior
from probewise.experiment.shadow import shadow_run
from probewise.experiment.simulation import (
    TRUST,
    Model,
    RandomStreams,
    arm_over,
    as_shape,
    default_trust,
    experiment_for,
    geometry_entry,
    scale_of,
    sensor_entry,
    shape_named,
    surface_of,
    with_cards,
    world_like,
)
from probewise.experiment.start import run_from_place
from probewise.experiment.state import PAPER_BITS, ArmError, Exploration, ExplorationState, Step
from probewise.experiment.stopping_rule import probability_of_length_off

__all__ = [
    "CLEAN",
    "OFF_MM",
    "PAPER_BITS",
    "TRUST",
    "AdjustedMixture",
    "ArmError",
    "ArmReachAndTravel",
    "Entry",
    "Experiment",
    "Exploration",
    "ExplorationState",
    "FittedArm",
    "FoundParameter",
    "FoundShape",
    "HiddenShape",
    "Journal",
    "JournalWriter",
    "LeftOutEffects",
    "Method",
    "MethodName",
    "Model",
    "NestedSampling",
    "OneScan",
    "PosteriorSummary",
    "RandomStreams",
    "SensorChangeSds",
    "SequentialMonteCarlo",
    "Step",
    "Truth",
    "arm_over",
    "as_shape",
    "begin",
    "default_trust",
    "experiment_for",
    "experiment_from_names",
    "explore",
    "found_shape",
    "geometry_entry",
    "least_readings",
    "left_out_after_step",
    "naive_levels_from_recording",
    "naive_levels_from_world",
    "paper_experiment",
    "possible_shapes_by_name",
    "probability_of_length_off",
    "read_journal",
    "recording_of",
    "repaired_sensor",
    "require_same_settings",
    "result_json",
    "run",
    "run_from_place",
    "samples_csv",
    "scale_of",
    "sensor_entry",
    "sensor_prior",
    "shadow_run",
    "shape_named",
    "step",
    "student_t_likelihood",
    "surface_of",
    "value_digest",
    "with_cards",
    "world_like",
]
