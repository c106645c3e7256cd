"""Read and check the options of `probewise explore`: sensor, field, shapes, models."""

from __future__ import annotations

import argparse
import dataclasses
import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from probewise import experiment as posing
from probewise.calibration import FittedSensor, read_sensor
from probewise.cli._arm import ArmName, parse_arm, read_or_shipped_geometry
from probewise.cli._geometry import parse_cards, parse_field
from probewise.errors import ParameterError
from probewise.recordings import read_recording
from probewise.scene import Field

if TYPE_CHECKING:
    from probewise.arm import Geometry
    from probewise.experiment import Experiment, Model, RandomStreams
    from probewise.inference import Naive
    from probewise.scene import Card


@dataclass(frozen=True)
class ExploreInputs:
    """Checked inputs of a run.

    `other` is the experiment under the sensor model `other_model`, which --both-models shows too; otherwise None.
    `geometry` is that of a LEGO arm, or the one that --geometry gives a simulated arm; otherwise None.
    """

    arm: ArmName
    geometry: Geometry | None
    sensor: FittedSensor
    field: Field
    cards: tuple[Card, ...]
    experiment: Experiment
    model: Model
    other: Experiment | None
    other_model: Model
    streams: RandomStreams

    @property
    def black_and_white_readings(self) -> tuple[float, float]:
        """Posterior mean readings over black and over white."""
        means = self.sensor.mean()
        return means["I_min"], means["I_max"]


def read_checked_inputs(arguments: argparse.Namespace) -> ExploreInputs:
    """Read the files that the options name, check the options, and build the experiment.

    Raises ParameterError or FileError if an option contradicts another, or a file cannot be read.
    """
    chosen = parse_arm(arguments.arm)
    if chosen.kind == "file" and arguments.geometry is not None:
        raise ParameterError("--geometry", str(arguments.geometry), "none with FILE.py, which defines its own reach")
    geometry = read_or_shipped_geometry(arguments) if chosen.is_lego or arguments.geometry is not None else None
    field = _checked_field(arguments.field, geometry)
    sensor = read_sensor(arguments.sensor)
    if chosen.is_lego and sensor.instrumentation.unit not in ("", "LEGO"):
        raise ParameterError("--sensor", str(arguments.sensor), "one that reads in LEGO units, as the brick does")
    streams = posing.RandomStreams.spawned_from(np.random.default_rng(arguments.seed))
    shape = posing.shape_named(arguments.shape, field)
    orientations_rad, heights_mm, repeats = _checked_setting_choices(arguments, geometry)
    cards = parse_cards(arguments.reference, field)
    if cards and (arguments.both_models or arguments.model == "naive" or arguments.method == "paper"):
        allowed = "none with --both-models, --model naive or --method paper"
        raise ParameterError("--reference", arguments.reference[0], allowed)
    levels = _naive_levels(arguments, chosen, sensor, rng=streams.levels)
    pose = partial(
        posing.experiment_from_names,
        sensor,
        shape,
        field,
        method=arguments.method,
        utility=arguments.utility,
        nested_stop=arguments.nested_stop,
        orientations_rad=orientations_rad,
        repeats=repeats,
        cards=cards,
    )
    experiment = pose(
        model=arguments.model,
        naive=levels if arguments.model == "naive" else None,
        learn_sensor=arguments.learn_sensor,
        batch=arguments.batch,
        heights_mm=heights_mm,
        trust=arguments.trust,
    )
    if chosen.may_differ_from_geometry and geometry is not None and geometry.accuracy is not None:
        experiment = dataclasses.replace(
            experiment, fitted_arm=posing.FittedArm.from_geometry_and_sensor(geometry, sensor)
        )
    other, other_model = None, _model_to_compare_with(arguments.model)
    if arguments.both_models:
        other = pose(model=other_model, naive=levels if other_model == "naive" else None, trust=1.0)
    return ExploreInputs(
        arm=chosen,
        geometry=geometry,
        sensor=sensor,
        field=field,
        cards=cards,
        experiment=experiment,
        model=arguments.model,
        other=other,
        other_model=other_model,
        streams=streams,
    )


def _model_to_compare_with(model: Model) -> Model:
    return "naive" if model == "ssf" else "ssf"


def _checked_setting_choices(
    arguments: argparse.Namespace, geometry: Geometry | None
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[int, ...]]:
    """Return the orientations (radians), heights (mm) and repeats to choose from.

    Raises ParameterError if the arm, or the naive model, does not support them.
    """
    turns, heights_mm = arguments.orientations, arguments.heights
    asked = {"--orientations": turns, "--heights": heights_mm}
    refused = {}
    if geometry is not None:
        refused = {
            "--orientations": "none with the LEGO arm, no joint of which turns its sensor",
            "--heights": (
                f"none with the LEGO arm but {geometry.read_height_mm:g}: it reads that many mm above the surface"
            ),
        }
        if heights_mm == (geometry.read_height_mm,):
            del refused["--heights"]
    elif arguments.both_models:
        refused = {"--heights": "none with --both-models, since the naive model has no height"}
    for option, allowed in refused.items():
        if asked[option] is not None:
            raise ParameterError(option, ",".join(f"{value:g}" for value in asked[option]), allowed)
    return tuple(math.radians(turn) for turn in turns or (0.0,)), heights_mm or (), arguments.repeats or (1,)


def _checked_field(text: str | None, geometry: Geometry | None) -> Field:
    """Return the field given as "WIDTH,HEIGHT" (mm), else the geometry's, else the paper's.

    Raises ParameterError if the one given contradicts the geometry, or is no such text.
    """
    if geometry is None:
        return parse_field("1048,520" if text is None else text)
    own = Field(*geometry.field_mm)
    if text is not None and parse_field(text) != own:
        raise ParameterError("--field", text, f"{own.width_mm:g},{own.height_mm:g}, the geometry's; or none")
    return own


def _naive_levels(
    arguments: argparse.Namespace, chosen: ArmName, sensor: FittedSensor, *, rng: np.random.Generator
) -> Naive | None:
    """Return the paper's naive model's readings over black and white, with sds; None if it is not used.

    They are from a recording or the simulated sensor. Raises ParameterError if an option does not apply, or a real arm
    has no recording.
    """
    if arguments.nested_stop is not None and arguments.method != "paper":
        raise ParameterError("--nested-stop", arguments.nested_stop, "only with --method paper")
    wanted = arguments.method == "paper" and (arguments.model == "naive" or arguments.both_models)
    if arguments.levels is not None:
        if not wanted:
            raise ParameterError("--levels", str(arguments.levels), "only with --method paper and --model naive")
        return posing.naive_levels_from_recording(read_recording(arguments.levels), sensor)
    if not wanted:
        return None
    if chosen.kind in ("nxt", "file"):
        raise ParameterError(
            "--levels",
            "none",
            "a recording of readings over a black and a white sheet, for the naive model of the paper",
        )
    return posing.naive_levels_from_world(posing.world_like(sensor), posing.scale_of(sensor.instrumentation), rng=rng)
