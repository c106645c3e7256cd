"""The autonomous experiment: measure, infer, inquire, with a journal of measurements (paper, sections 2.2, 2.3)."""

from probewise.arm.carry_out import recording_of
from probewise.experiment.from_sensor import (
    TRUST,
    MethodName,
    experiment_for,
    naive_levels_from_recording,
    naive_levels_from_world,
)
from probewise.experiment.journal import Journal, JournalWriter, read_journal
from probewise.experiment.judgement import least_readings, probability_of_length_off
from probewise.experiment.loop import begin, explore, run_from_place, shadow_run, step
from probewise.experiment.method import Method, NestedSampling, SequentialMonteCarlo
from probewise.experiment.paper import find_shape
from probewise.experiment.result import (
    CLEAN,
    Exploration,
    Step,
    estimated_shape,
    left_out_after_step,
    repaired_sensor,
    result_json,
    samples_csv,
)
from probewise.experiment.setup import Experiment, FittedArm
from probewise.experiment.simulated import (
    HiddenShape,
    ModelName,
    RandomStreams,
    Truth,
    arm_over,
    as_shape,
    geometry_entry,
    scale_of,
    sensor_entry,
    with_cards,
    world_like,
)

__all__ = [
    "CLEAN",
    "TRUST",
    "Experiment",
    "Exploration",
    "FittedArm",
    "HiddenShape",
    "Journal",
    "JournalWriter",
    "Method",
    "MethodName",
    "ModelName",
    "NestedSampling",
    "RandomStreams",
    "SequentialMonteCarlo",
    "Step",
    "Truth",
    "arm_over",
    "as_shape",
    "begin",
    "estimated_shape",
    "experiment_for",
    "explore",
    "find_shape",
    "geometry_entry",
    "least_readings",
    "left_out_after_step",
    "naive_levels_from_recording",
    "naive_levels_from_world",
    "probability_of_length_off",
    "read_journal",
    "recording_of",
    "repaired_sensor",
    "result_json",
    "run_from_place",
    "samples_csv",
    "scale_of",
    "sensor_entry",
    "shadow_run",
    "step",
    "with_cards",
    "world_like",
]
