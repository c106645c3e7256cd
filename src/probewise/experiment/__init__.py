"""The autonomous experiment: measure, infer, inquire, with a journal of measurements (paper, sections 2.2, 2.3)."""

from probewise.experiment.acquisition import ArmOverGrid
from probewise.experiment.arm_error import with_arm_error
from probewise.experiment.configuration import Experiment, OneScan
from probewise.experiment.digest import value_digest
from probewise.experiment.fitted_arm import FittedArm
from probewise.experiment.found import OFF_MM, FoundParameter, FoundShape, found_shape, result_json, samples_csv
from probewise.experiment.hidden import Hidden, Truth, members_of
from probewise.experiment.journal import (
    Entry,
    Journal,
    JournalWriter,
    PosteriorSummary,
    read_journal,
    recording_of,
    require_same_settings,
)
from probewise.experiment.left_out import CLEAN, LeftOut, left_out_of, repaired
from probewise.experiment.limit import least_readings
from probewise.experiment.loop import begin, explore, run, step
from probewise.experiment.method import Method, SequentialMonteCarlo
from probewise.experiment.paper import (
    NestedSampling,
    levels_from,
    levels_in,
    paper_experiment,
    student_t_bounds,
)
from probewise.experiment.posed import MethodName, pose_experiment
from probewise.experiment.sensor_update import AdjustedMixture, Change, sensor_prior
from probewise.experiment.shadow import shadow_run
from probewise.experiment.simulation import (
    TRUST,
    Model,
    Streams,
    arm_over,
    experiment_for,
    scale_of,
    sensor_named,
    shape_named,
    shape_of,
    surface_of,
    usual_trust,
    with_cards,
    world_like,
)
from probewise.experiment.start import run_from
from probewise.experiment.state import PAPER_BITS, ArmError, Exploration, ExplorationState, Step
from probewise.experiment.stopping_rule import chance_off

__all__ = [
    "CLEAN",
    "OFF_MM",
    "PAPER_BITS",
    "TRUST",
    "AdjustedMixture",
    "ArmError",
    "ArmOverGrid",
    "Change",
    "Entry",
    "Experiment",
    "Exploration",
    "ExplorationState",
    "FittedArm",
    "FoundParameter",
    "FoundShape",
    "Hidden",
    "Journal",
    "JournalWriter",
    "LeftOut",
    "Method",
    "MethodName",
    "Model",
    "NestedSampling",
    "OneScan",
    "PosteriorSummary",
    "SequentialMonteCarlo",
    "Step",
    "Streams",
    "Truth",
    "arm_over",
    "begin",
    "chance_off",
    "experiment_for",
    "explore",
    "found_shape",
    "least_readings",
    "left_out_of",
    "levels_from",
    "levels_in",
    "members_of",
    "paper_experiment",
    "pose_experiment",
    "read_journal",
    "recording_of",
    "repaired",
    "require_same_settings",
    "result_json",
    "run",
    "run_from",
    "samples_csv",
    "scale_of",
    "sensor_named",
    "sensor_prior",
    "shadow_run",
    "shape_named",
    "shape_of",
    "step",
    "student_t_bounds",
    "surface_of",
    "usual_trust",
    "value_digest",
    "with_arm_error",
    "with_cards",
    "world_like",
]

Field = ArmOverGrid
"""The old name of `ArmOverGrid`."""

State = ExplorationState
"""The old name of `ExplorationState`."""

beside = shadow_run
"""The old name of `shadow_run`."""

Belief = PosteriorSummary
"""The old name of `PosteriorSummary`."""
