"""The experiment of a fitted sensor, and a simulated arm over a simulated field."""

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
from probewise.arm import Geometry, Pose, Reach, Reading, ReadingScale, SimulatedArm, Workspace
from probewise.calibration import FittedSensor
from probewise.calibration.sensor_file import require_fitted_sensor
from probewise.effects import Estimated, Known
from probewise.errors import ParameterError, did_you_mean, printable
from probewise.experiment.configuration import Experiment
from probewise.experiment.digest import value_digest
from probewise.experiment.pace import DescribedEffect, FromRest
from probewise.experiment.rivals import OF_MOTION
from probewise.experiment.sensor_update import AdjustedMixture, sensor_prior
from probewise.inference import Naive, Rounded
from probewise.inquiry import Finishing, Grid, Utility
from probewise.priors import LogNormal, Marginal, Normal
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
from probewise.sensor.stages import AnyEffect
from probewise.world import CoveredSurface, Oval, Spot, Surface, World

Model: TypeAlias = Literal["ssf", "naive"]

_CELLS_PER_SD = 8.0  # cells per noise sd for unrounded readings
_USUAL_HEIGHT_MM = 14.0  # height of the paper's sensor above the surface
_PAINTED_VERTICES = 512  # vertices of a curved outline that is not an ellipse: within 0.01 mm of a circle of 150 mm


class RandomStreams(NamedTuple):
    """Independent random streams of a simulated run: for inference (`run`), hidden shape (`truth`), shadow run, noise.

    `noise` is a seed, from which each reading's generator is made; see `arm_over`. `levels` is for the readings over
    black and white before the run, see `naive_levels_from_world`.
    """

    run: np.random.Generator
    truth: np.random.Generator
    shadow: np.random.Generator
    noise: int
    levels: np.random.Generator

    @classmethod
    def spawned_from(cls, rng: np.random.Generator) -> RandomStreams:
        """Spawn the streams from one generator, so that one seed gives the whole run."""
        run, truth, shadow, noise, levels = rng.spawn(5)
        return cls(run, truth, shadow, int(noise.integers(2**63)), levels)


def sensor_entry(sensor: FittedSensor, path: str | os.PathLike[str] | None = None) -> dict[str, str]:
    """Return a journal's entries for the sensor: the sha256 of its JSON, and the path of its file if given."""
    require_fitted_sensor(sensor)
    named = {} if path is None else {"sensor_file": printable(os.fspath(path))}
    return {**named, "sensor_sha256": hashlib.sha256(sensor.to_json().encode()).hexdigest()}


def geometry_entry(geometry: Geometry | None) -> dict[str, str]:
    """Return a journal's entry for the geometry of its arm, a digest; empty without a geometry."""
    return {} if geometry is None else {"geometry_sha256": value_digest(geometry)}


def entropy_bin_width_of(sensor: FittedSensor) -> float:
    """Return the bin width of the paper's entropy: the instrument's rounding step, or else its noise sd."""
    return scale_of(sensor.instrumentation).step or float(sensor.noise_sd.mean())


def shape_named(names: Sequence[str], field: Field) -> Shape:
    """Build the possible shape from one name, or the set of possible shapes from several.

    Raises
    ------
    ParameterError
        If a name is not in `SHAPES`.
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


def as_shape(shape: str | Sequence[str] | Shape, field: Field) -> Shape:
    """Return a shape, or build it from one or several names.

    Raises
    ------
    ParameterError
        If `shape` is neither a shape nor a name in `SHAPES`, or several.
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
    """Build the experiment of a fitted sensor over an unknown shape, with readings on the sensor's scale.

    Parameters
    ----------
    sensor
        The fitted sensor; if it averages several hypotheses, the most probable one is used. The SSF model takes the
        mixture with the mean and covariance of the sensor's mean field, for closed forms instead of sums over pixels,
        and effects on the mean at their posterior means; with `trust` below 1 these effects are inferred along with the
        shape. Effects on the noise are left out. The naive model takes the sensor's two levels.
    shape
        The possible shape on the field.
    field
        The playing field, mm; the places are a grid of 131 x 65 over it, as in the paper.
    model
        "ssf" or "naive".
    n_live
        Live points of nested sampling, if no sample predicts a reading.
    utility
        The utility; by default the expected information and, near the end, the probability of ending the run.
    learn_sensor
        Infer the SSF's size and place and the two levels jointly with the shape, with a prior from the calibration (see
        `sensor_prior`); for the SSF model.
    batch
        Readings chosen together.
    orientations_rad, repeats, heights_mm
        Possible orientations, numbers of repeated readings and heights, for an arm that supports them; heights only for
        the SSF model of a sensor with a known height of calibration.
    trust
        Prior probability that the sensor model is complete; below 1 only for the SSF model of a known sensor.
    cards
        Cards of known place and albedo on the field; for the SSF model.

    Raises
    ------
    ParameterError
        If an option does not go with the model or the sensor.
    """
    require_fitted_sensor(sensor, "in the order experiment_for(sensor, shape, field)")
    if model not in get_args(Model):
        raise ParameterError("model", model, " or ".join(map(repr, get_args(Model))))
    sensor = sensor.with_leading_effects()  # a mean over several hypotheses describes none of them
    levels, noise_sd, scale = mean_levels_of(sensor), float(sensor.noise_sd.mean()), scale_of(sensor.instrumentation)
    scene = CardedScene(shape, cards) if cards else HypothesisScene(shape)
    pose = partial(
        experiment_without_inference(
            sensor, shape, field, model, orientations_rad=orientations_rad, repeats=repeats, heights_mm=heights_mm
        ),
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
        # A reading on the edge fits neither level, and the naive model has no partial coverage.
        return pose(NaiveSensor(levels, scene), Naive(levels.i_min, sd, levels.i_max, sd), doubt_p=0.0)
    chain = sensor_chain_at_means(sensor, scene, estimated=trust < 1 and not learn_sensor)
    # Unrounded readings get cells scaled to the noise; the end cells are open.
    step = scale.step or noise_sd / _CELLS_PER_SD
    likelihood = Rounded(noise_sd, step, scale.low, scale.high, whole_steps=scale.step is not None)
    if learn_sensor:
        free = replace(chain, ssf=AdjustedMixture(sensor.mean_mixture()), levels=FreeLevels())
        return pose(free, likelihood, sensor_prior=sensor_prior(sensor))
    return pose(chain, likelihood)


def experiment_without_inference(
    sensor: FittedSensor,
    shape: Shape,
    field: Field,
    model: Model,
    *,
    orientations_rad: tuple[float, ...],
    repeats: tuple[int, ...],
    heights_mm: tuple[float, ...],
) -> partial[Experiment]:
    """Return a partial `Experiment` with the arguments that all methods share: shape, noise, scale, designs.

    Called with the model, the likelihood and the arguments that differ between methods, it returns the experiment.
    """
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
        calibrated_height_mm=(
            checked_calibrated_height_mm(sensor, model, heights_mm) if heights_mm else sensor.instrumentation.height_mm
        ),
    )


def mean_levels_of(sensor: FittedSensor) -> FixedLevels:
    """Return the posterior mean levels of a fitted sensor."""
    means = sensor.mean()
    return FixedLevels(means["I_min"], means["I_max"])


def sensor_chain_at_means(sensor: FittedSensor, scene: HypothesisScene, *, estimated: bool = False) -> Chain:
    """Return the chain of a fitted sensor over a scene: mean field's mixture, mean levels, effects at their means.

    Effects on the noise are dropped. With `estimated`, the effects carry priors fitted to their samples, so that a run
    can infer their parameters too; effects of the arm's direction of motion then leave out a run's first reading.
    """
    means = sensor.mean()
    effects: list[AnyEffect] = []
    # A run has a clock and a frame of its own, not those of the recording that was diagnosed.
    for effect in replace(sensor, origins={}).effects_on_new_scans:
        if effect.stage is Stage.NOISE:  # noise of readings far apart in place and time is independent
            continue
        names = [f"{effect.name}.{name}" for name in effect.prior.names]
        values = tuple(means[name] for name in names)
        samples = [sensor.samples[:, sensor.names.index(name)] for name in names]
        if estimated and all(own.std() > 0 for own in samples):
            acting = FromRest(cast(DescribedEffect, effect)) if effect.name in OF_MOTION else effect
            effects.append(Estimated(acting, values, tuple(map(_marginal_prior_from_samples, samples))))
        else:
            effects.append(Known(effect, values))
    return Chain(sensor.mean_mixture(), mean_levels_of(sensor), scene, tuple(effects), n_nodes=FAST_NODES)


def _marginal_prior_from_samples(samples: FloatArray) -> Marginal:
    """Return a prior fitted to samples, (n_samples,): by mean and sd of their logs if all are positive, else normal."""
    if (samples > 0).all():
        log = np.log(samples)
        return LogNormal(float(np.exp(log.mean())), float(log.std()))
    return Normal(float(samples.mean()), float(samples.std()))


TRUST = 0.9
"""Default prior probability that a sensor model is complete."""


def default_trust(shape: Shape, *, model: Model, learn_sensor: bool, utility: Utility) -> float:
    """Return the default prior probability that the sensor model is complete (its trust).

    It is 0.9 (`TRUST`), or 1 where no rival is considered: for the naive model, a sensor that is learnt, several
    shapes, or any utility but `Finishing()`.
    """
    plain = model == "naive" or learn_sensor or isinstance(shape, AnyOf) or utility != Finishing()
    return 1.0 if plain else TRUST


def checked_calibrated_height_mm(sensor: FittedSensor, model: Model, heights_mm: tuple[float, ...]) -> float:
    """Return the height of the calibration, to which the footprint at other heights is scaled.

    Raises ParameterError for the naive model, and for a sensor without a stated height of calibration.
    """
    height_mm = sensor.instrumentation.height_mm
    if model == "naive":
        raise ParameterError("heights_mm", heights_mm, 'none with the model "naive", which knows no height')
    if height_mm is None:
        allowed = "none with this sensor: its description does not say at which height_mm it was calibrated"
        raise ParameterError("heights_mm", heights_mm, allowed)
    return height_mm


def scale_of(instrumentation: Instrumentation) -> ReadingScale:
    """Return the scale of readings: the LEGO brick's for its unit, otherwise the declared step and range."""
    if instrumentation.unit == "LEGO":
        return ReadingScale()
    low, high = instrumentation.min, instrumentation.max
    return ReadingScale(-math.inf if low is None else low, math.inf if high is None else high, instrumentation.step)


def world_like(sensor: FittedSensor) -> World:
    """Build the simulated world of a fitted sensor: its mean field as the footprint, its levels, noise and height."""
    require_fitted_sensor(sensor)
    field, means = sensor.field, sensor.mean()
    corner = (field.origin_mm[0] - field.pixel_mm / 2, field.origin_mm[1] - field.pixel_mm / 2)
    # A fitted free-form field may be slightly negative; a physical footprint is not.
    spot = Spot(np.maximum(field.values, 0.0), field.pixel_mm, corner)
    height_mm = sensor.instrumentation.height_mm or _USUAL_HEIGHT_MM
    noise_sd = float(sensor.noise_sd.mean())
    return World(spot, black=means["I_min"], white=means["I_max"], noise_sd=noise_sd, height_mm=height_mm)


def surface_of(name: str, theta: FloatArray, field: Field) -> Surface:
    """Return the world's surface of a shape with parameters theta, (n_params,); it shares only geometry with models."""
    return surface_of_region(SHAPES[name](field).region(theta[None, :]), name)


def surface_of_region(region: Region, name: str) -> Surface:
    """Return the world's surface of the region of one hypothesis.

    Raises
    ------
    ParameterError
        If the region's outline is not a single closed line.
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
    """Return a surface of the world with cards on it; one that has cards already is returned as it is."""
    if not cards or isinstance(surface, CoveredSurface):
        return surface
    laid = [Polygon(tuple((float(x), float(y)) for x, y in card.corners_mm), inside=card.albedo) for card in cards]
    return CoveredSurface(surface, tuple(laid))


def arm_over(
    world: World,
    surface: Surface,
    field: Field,
    *,
    seed: int,
    taken: Sequence[Reading] = (),
    workspace: Workspace | None = None,
    scale: ReadingScale | None = None,
) -> SimulatedArm:
    """Return a simulated arm over a surface.

    Parameters
    ----------
    world, surface, field
        World and surface that the arm's sensor reads, and the field.
    seed
        Seed of the noise. Each reading has its own generator, so that a resumed run has the same noise as an
        uninterrupted one.
    taken
        Readings of the run before it was interrupted: the arm starts at the pose and time of the last one.
    workspace
        Reach of the arm and orientations of its sensor; None: the default `Reach` over the field, orientation 0.
    scale
        Rounding and range of readings; by default the LEGO brick's.
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
        scale=ReadingScale() if scale is None else scale,
        height_mm=world.height_mm,
        last=taken[-1] if taken else None,
    )
