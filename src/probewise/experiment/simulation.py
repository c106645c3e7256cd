"""Pose the experiment that a fitted sensor makes, and put a simulated arm over a simulated field."""

from __future__ import annotations

import hashlib
import itertools
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Literal, NamedTuple, TypeAlias, cast, get_args

import numpy as np

from probewise._arrays import FloatArray
from probewise._kinds import did_you_mean
from probewise.arm import LegoScale, Pose, Reach, Reading, SimulatedArm, Workspace
from probewise.calibration import FittedSensor
from probewise.calibration.sensor_file import require_sensor
from probewise.effects import Known
from probewise.errors import ParameterError
from probewise.experiment.learning import AdjustedMixture, sensor_prior
from probewise.experiment.setting import Experiment
from probewise.inference import Naive, Rounded
from probewise.inquiry import Finishing, Grid, Utility
from probewise.recordings import Disc, Instrumentation, Polygon
from probewise.scene import (
    SHAPES,
    AnyOf,
    Card,
    CardedScene,
    EllipseRegion,
    Field,
    HypothesisScene,
    Region,
    Shape,
    outlines,
)
from probewise.scene.albedo import require_shape
from probewise.sensor import FAST_NODES, Chain, FixedLevels, FreeLevels, NaiveSensor, Stage
from probewise.world import Covered, Oval, Spot, Surface, World

__all__ = [
    "TRUST",
    "Model",
    "Streams",
    "arm_over",
    "bin_width_of",
    "calibrated_height",
    "chain_of",
    "experiment_for",
    "levels_of",
    "posing",
    "scale_of",
    "sensor_named",
    "shape_named",
    "shape_of",
    "surface_of",
    "surface_under",
    "usual_trust",
    "world_like",
]

Model: TypeAlias = Literal["ssf", "naive"]

_CELLS_PER_SD = 8.0  # of a reading that is not rounded
_USUAL_HEIGHT_MM = 14.0  # of the paper's sensor above the surface
_PAINTED_VERTICES = 512  # of a curved outline that is no ellipse: within 0.01 mm of a circle of 150 mm


class Streams(NamedTuple):
    """The independent randomness of one simulated run: of the robot, of what is hidden, of a shadow run, of the noise.

    `noise` is a number, from which each reading's generator is made; see `arm_over`. `levels` is that of readings over
    black and white before the run, see `levels_in`. `arm` draws errors of a real arm's geometry, see `with_arm_error`.
    """

    run: np.random.Generator
    truth: np.random.Generator
    shadow: np.random.Generator
    noise: int
    levels: np.random.Generator
    arm: np.random.Generator

    @classmethod
    def of(cls, rng: np.random.Generator) -> Streams:
        """Spawn them from one generator, so that one seed gives the whole run."""
        run, truth, shadow, noise, levels, arm = rng.spawn(6)
        return cls(run, truth, shadow, int(noise.integers(2**63)), levels, arm)


def sensor_named(sensor: FittedSensor, path: str | os.PathLike[str] | None = None) -> dict[str, str]:
    """Say for a journal which sensor a run is made with: the fingerprint of what it says, and its file if any."""
    require_sensor(sensor)
    named = {} if path is None else {"sensor_file": os.fspath(path)}
    return {**named, "sensor_sha256": hashlib.sha256(sensor.to_json().encode()).hexdigest()}


def bin_width_of(sensor: FittedSensor) -> float:
    """Give the width of the bins that the paper's entropy sorts readings into: the instrument's step, or its noise."""
    return scale_of(sensor.instrumentation).step or float(sensor.noise_sd.mean())


def shape_named(names: Sequence[str], field: Field) -> Shape:
    """Build the hypothesis: one shape, or a set of shapes.

    Raises
    ------
    ParameterError
        If a name is none of `SHAPES`.
    """
    for name in names:
        if name not in SHAPES:
            raise ParameterError(
                "shape",
                name,
                f"one of {', '.join(SHAPES)}, or several; or a value of probewise.scene{did_you_mean(name, SHAPES)}",
            )
    chosen = {name: SHAPES[name](field) for name in dict.fromkeys(names)}
    return AnyOf(chosen) if len(chosen) > 1 else next(iter(chosen.values()))


def shape_of(shape: str | Sequence[str] | Shape, field: Field) -> Shape:
    """Take a shape as it is, or build it from a name or several.

    Raises
    ------
    ParameterError
        If it is neither a shape nor a name of `SHAPES`.
    """
    if isinstance(shape, str):
        return shape_named((shape,), field)
    if isinstance(shape, Sequence) and shape:
        return shape_named(shape, field)
    require_shape(shape)
    return cast(Shape, shape)


def experiment_for(
    sensor: FittedSensor,
    shape: Shape,
    field: Field,
    *,
    model: Model = "ssf",
    n_live: int = 200,
    utility: Utility | None = None,
    learn_sensor: bool = False,
    batch: int = 1,
    orientations_rad: tuple[float, ...] = (0.0,),
    repeats: tuple[int, ...] = (1,),
    heights_mm: tuple[float, ...] = (),
    trust: float = 1.0,
    cards: tuple[Card, ...] = (),
) -> Experiment:
    """Pose the experiment: a fitted sensor over a shape that is not known, read on the sensor's own scale.

    Parameters
    ----------
    sensor
        As calibrated; of what a diagnosis has left open, the most probable. The SSF model takes the mixture with the
        mean and covariance of its mean field, so that closed forms stand in for the sum over pixels, and its effects
        at their posterior means; the naive model takes its two levels.
    shape
        What may lie on the field.
    field
        Where to look: 131 x 65 places, as in the paper.
    model
        "ssf" or "naive".
    n_live
        Live points of nested sampling, where a reading surprises.
    utility
        What a reading is worth; by default its expected information and, near the end, whether it ends the run.
    learn_sensor
        Infer the SSF's size and place and the two levels along with the shape, from a prior about the
        calibration (see `sensor_prior`); for the SSF model.
    batch
        Readings that are chosen together.
    orientations_rad, repeats, heights_mm
        How the sensor may be turned, how often it may read on the spot and how high it may stand, for an arm that
        can do so; heights for the SSF model of a sensor whose description says at which it was calibrated.
    trust
        Probability that the sensor model leaves nothing out, before the first reading; below 1 for the SSF model of
        a sensor that is known.
    cards
        Cards of known place and albedo that lie on the field; for the SSF model.
    """
    require_sensor(sensor, "in the order experiment_for(sensor, shape, field)")
    if model not in get_args(Model):
        raise ParameterError("model", model, " or ".join(map(repr, get_args(Model))))
    sensor = sensor.leading()  # a mean over rivals is true of none of them
    levels, noise_sd, scale = levels_of(sensor), float(sensor.noise_sd.mean()), scale_of(sensor.instrumentation)
    scene = CardedScene(shape, cards) if cards else HypothesisScene(shape)
    pose = partial(
        posing(sensor, shape, field, model, orientations_rad=orientations_rad, repeats=repeats, heights_mm=heights_mm),
        utility=Finishing() if utility is None else utility,
        batch=batch,
        n_live=n_live,
        trust=trust,
    )
    if model == "naive":
        if cards:
            raise ParameterError("cards", cards, 'none with the model "naive", which knows two levels alone')
        if learn_sensor:
            raise ParameterError("learn_sensor", learn_sensor, 'False with the model "naive", which has no SSF')
        sd = math.hypot(noise_sd, (scale.step or 0.0) / math.sqrt(12))
        # A reading on the edge never fits two levels, and the naive model knows no edge.
        return pose(NaiveSensor(levels, scene), Naive(levels.i_min, sd, levels.i_max, sd), doubt_p=0.0)
    chain = chain_of(sensor, scene)
    # Without steps cells are taken as fine as the noise asks for: at the ends a reading stands for all beyond.
    likelihood = Rounded(noise_sd, scale.step or noise_sd / _CELLS_PER_SD, scale.low, scale.high)
    if learn_sensor:
        free = replace(chain, ssf=AdjustedMixture(sensor.mixture()), levels=FreeLevels())
        return pose(free, likelihood, sensor_prior=sensor_prior(sensor))
    return pose(chain, likelihood)


def posing(
    sensor: FittedSensor,
    shape: Shape,
    field: Field,
    model: Model,
    *,
    orientations_rad: tuple[float, ...],
    repeats: tuple[int, ...],
    heights_mm: tuple[float, ...],
) -> partial[Experiment]:
    """Pose what every method of inference shares: the shape on the field, the sensor's scale, what can be chosen."""
    scale = scale_of(sensor.instrumentation)
    return partial(
        Experiment,
        shape,
        noise_sd=float(sensor.noise_sd.mean()),
        grid=Grid(field.width_mm, field.height_mm),
        step=scale.step,
        reading_range=(scale.low, scale.high),
        orientations_rad=orientations_rad,
        repeats=repeats,
        heights_mm=heights_mm,
        calibrated_height_mm=calibrated_height(sensor, model, heights_mm) if heights_mm else None,
    )


def levels_of(sensor: FittedSensor) -> FixedLevels:
    """Take the mean levels of a fitted sensor."""
    means = sensor.mean()
    return FixedLevels(means["I_min"], means["I_max"])


def chain_of(sensor: FittedSensor, scene: HypothesisScene) -> Chain:
    """Put a fitted sensor over a scene: its mean field's mixture, its mean levels, its effects at their means."""
    means = sensor.mean()
    effects = tuple(
        Known(effect, tuple(means[f"{effect.name}.{name}"] for name in effect.prior.names))
        for effect in sensor.carried_effects
        if effect.stage is not Stage.NOISE  # readings far apart in place and time share no noise
    )
    return Chain(sensor.mixture(), levels_of(sensor), scene, effects, n_nodes=FAST_NODES)


TRUST = 0.9
"""Probability that a sensor model leaves nothing out, where nobody says otherwise."""


def usual_trust(shape: Shape, *, model: Model, learn_sensor: bool, utility: Utility) -> float:
    """Trust a sensor as one does where nobody says otherwise.

    Wholly where doubt has no model, with several shapes, or where a reading is to be worth something of one's own.
    """
    plain = model == "naive" or learn_sensor or isinstance(shape, AnyOf) or utility != Finishing()
    return 1.0 if plain else TRUST


def calibrated_height(sensor: FittedSensor, model: Model, heights_mm: tuple[float, ...]) -> float:
    """Take the height of the calibration: what the sensor sees at another follows from it."""
    height_mm = sensor.instrumentation.height_mm
    if model == "naive":
        raise ParameterError("heights_mm", heights_mm, 'none with the model "naive", which knows no height')
    if height_mm is None:
        allowed = "none with this sensor: its description does not say at which height_mm it was calibrated"
        raise ParameterError("heights_mm", heights_mm, allowed)
    return height_mm


def scale_of(instrumentation: Instrumentation) -> LegoScale:
    """Take the scale that readings come in: the LEGO brick's for its unit, else step and range as they are declared."""
    if instrumentation.unit == "LEGO":
        return LegoScale()
    low, high = instrumentation.min, instrumentation.max
    return LegoScale(-math.inf if low is None else low, math.inf if high is None else high, instrumentation.step)


def world_like(sensor: FittedSensor) -> World:
    """Build the world that a sensor.json describes: its mean field as the spot, its levels, noise and height."""
    require_sensor(sensor)
    field, means = sensor.field, sensor.mean()
    corner = (field.origin_mm[0] - field.pixel_mm / 2, field.origin_mm[1] - field.pixel_mm / 2)
    # A fitted field of free form may dip below zero; what light there is never does.
    spot = Spot(np.maximum(field.values, 0.0), field.pixel_mm, corner)
    height_mm = sensor.instrumentation.height_mm or _USUAL_HEIGHT_MM
    noise_sd = float(sensor.noise_sd.mean())
    return World(spot, black=means["I_min"], white=means["I_max"], noise_sd=noise_sd, height_mm=height_mm)


def surface_of(name: str, theta: FloatArray, field: Field) -> Surface:
    """Paint the shape for the world: geometry alone crosses over."""
    return surface_under(SHAPES[name](field).region(theta[None, :]), name)


def surface_under(region: Region, name: str) -> Surface:
    """Paint the region of one hypothesis for the world.

    Raises
    ------
    ParameterError
        If it has no closed outline, or one of several pieces.
    """
    if isinstance(region, EllipseRegion):
        center, axes = region.center_mm[0].tolist(), region.semi_axes_mm[0].tolist()
        if axes[0] == axes[1]:
            return Disc((center[0], center[1]), axes[0])
        return Oval((center[0], center[1]), (axes[0], axes[1]), float(region.angle_rad[0]))
    (outline,) = outlines(region, n_vertices=_PAINTED_VERTICES)
    if np.isnan(outline).any():
        raise ParameterError("shape", name, "one whose outline is one closed line")
    return Polygon(tuple((float(x), float(y)) for x, y in outline[:-1]))


def with_cards(surface: Surface, cards: Sequence[Card]) -> Surface:
    """Lay cards on a surface of the world: geometry and albedo alone cross over."""
    if not cards or isinstance(surface, Covered):
        return surface
    laid = [Polygon(tuple((float(x), float(y)) for x, y in card.corners_mm), inside=card.albedo) for card in cards]
    return Covered(surface, tuple(laid))


def arm_over(
    world: World,
    surface: Surface,
    field: Field,
    *,
    seed: int,
    taken: Sequence[Reading] = (),
    workspace: Workspace | None = None,
    scale: LegoScale | None = None,
) -> SimulatedArm:
    """Stand the simulated arm over a surface.

    Parameters
    ----------
    world, surface, field
        What it reads, and how large the field is.
    seed
        Of the noise. Each reading has a generator of its own, so that a run that was stopped goes on
        with the noise it would have had.
    taken
        Readings that the run took before it was stopped: the arm stands, and its clock, where the last one left them.
    workspace
        Where the arm can go and how its sensor then stands; by default nearly everywhere, and never turned.
    scale
        What readings are rounded to and kept within; by default the LEGO brick's.
    """
    number = itertools.count(len(taken))

    def light(pose: Pose, time_s: float, height_mm: float) -> float:
        rng = np.random.default_rng([seed, next(number)])
        place = (pose.x_mm, pose.y_mm, pose.orientation_rad)
        return world.read(surface, *place, time_s=time_s, rng=rng, height_mm=height_mm)

    reach = Reach((field.width_mm, field.height_mm)) if workspace is None else workspace
    return SimulatedArm(
        light,
        reach=reach,
        scale=LegoScale() if scale is None else scale,
        height_mm=world.height_mm,
        last=taken[-1] if taken else None,
    )
