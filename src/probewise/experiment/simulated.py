"""A simulated field: the world of a fitted sensor, the hidden shape, and an arm over it."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias, cast

import numpy as np

from probewise._arrays import FloatArray, floats, read_only_floats
from probewise._kinds import checked_finite_number, require_rng
from probewise.arm import Geometry, Pose, Reach, Reading, ReadingScale, SimulatedArm, Workspace
from probewise.calibration import FittedSensor
from probewise.calibration.sensor_file import require_fitted_sensor
from probewise.errors import ParameterError, did_you_mean, printable, require
from probewise.experiment.journal import value_digest
from probewise.recordings import Disc, Instrumentation, Polygon, Uniform
from probewise.scene import SHAPES, AnyOf, Card, EllipseRegion, Field, Shape, outlines
from probewise.scene.shapes import require_shape
from probewise.world import Concealed, CoveredSurface, Oval, Reader, Spot, Surface, World

ModelName: TypeAlias = Literal["ssf", "naive"]
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


def as_shape(shape: str | Sequence[str] | Shape, field: Field) -> Shape:
    """Return a shape, or build it from its name, or the set of possible shapes from several names of `SHAPES`."""
    if not isinstance(shape, Sequence) or not shape:
        require_shape(shape)
        return cast(Shape, shape)
    names = (shape,) if isinstance(shape, str) else shape
    for name in names:
        if name not in SHAPES:
            allowed = f"one of {', '.join(SHAPES)}, or several; or a value of probewise.scene"
            raise ParameterError("shape", name, f"{allowed}{did_you_mean(name, SHAPES)}")
    chosen = {name: SHAPES[name](field) for name in dict.fromkeys(names)}
    return AnyOf(chosen) if len(chosen) > 1 else next(iter(chosen.values()))


def scale_of(instrumentation: Instrumentation) -> ReadingScale:
    """Return the scale of readings: the LEGO brick's for its unit, otherwise the declared step and range."""
    if instrumentation.unit == "LEGO":
        return ReadingScale()
    low, high = instrumentation.min, instrumentation.max
    return ReadingScale(-math.inf if low is None else low, math.inf if high is None else high, instrumentation.step)


def world_like(sensor: FittedSensor, concealed: tuple[Concealed, ...] = ()) -> World:
    """Build the simulated world of a fitted sensor: its mean field as the footprint, its levels, noise and height.

    ParameterError if it lacks a column that a `concealed` effect acts by, such as a battery's voltage.
    """
    require_fitted_sensor(sensor)
    field, means = sensor.field, sensor.mean()
    corner = (field.origin_mm[0] - field.pixel_mm / 2, field.origin_mm[1] - field.pixel_mm / 2)
    # A fitted free-form field may be slightly negative; a physical footprint is not.
    spot = Spot(np.maximum(field.values, 0.0), field.pixel_mm, corner)
    height_mm = sensor.instrumentation.height_mm or _USUAL_HEIGHT_MM
    noise_sd = float(sensor.noise_sd.mean())
    world = World(spot, means["I_min"], means["I_max"], noise_sd, concealed=concealed, height_mm=height_mm)
    if concealed:  # by a reading an effect says what it lacks
        world.read(Uniform(0.5), 0.0, 0.0, time_s=0.0, rng=None, height_mm=height_mm)
    return world


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

    Each reading has a generator of its own, from `seed`, so that a resumed run has the same noise as an uninterrupted
    one. `taken` are the readings of the run before it was interrupted: the arm starts at the pose and time of the last
    one. `workspace` is the reach of the arm, by default `Reach` over the field; `scale` rounding and range of readings,
    by default the LEGO brick's.
    """
    reader = Reader(world, seed=(seed,))

    def light(pose: Pose, time_s: float, height_mm: float) -> float:
        place = (pose.x_mm, pose.y_mm, pose.orientation_rad)
        return reader.read(surface, *place, time_s=time_s, height_mm=height_mm)

    for earlier in taken:
        light(earlier.pose, earlier.time_s, earlier.covariates.get("height_mm", world.height_mm))
    reach, last = workspace or Reach((field.width_mm, field.height_mm)), taken[-1] if taken else None
    return SimulatedArm(light, reach=reach, scale=scale or ReadingScale(), height_mm=world.height_mm, last=last)


Truth = Sequence[float] | Mapping[str, float] | Mapping[str, Sequence[float]] | Mapping[str, Mapping[str, float]]
"""Parameters of the first shape, in order or by name; or {"rectangle": ...}, those of a shape by its name."""


@dataclass(frozen=True, eq=False)
class HiddenShape:
    """A shape with its parameters, theta (n_params,), and its name among the possible shapes."""

    name: str
    shape: Shape
    theta: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "theta", read_only_floats(self.theta))

    @classmethod
    def from_parameters(cls, name: str, shape: Shape, theta: FloatArray, *, called: str = "truth") -> HiddenShape:
        """Build from parameters, (n_params,); `called` is the name of these in messages.

        ParameterError if the number of parameters is wrong, or the shape's prior excludes one, given the others.
        """
        prior = shape.prior
        values = floats(theta, called)
        n = len(prior.names)
        require(values.shape == (n,), called, theta, f"{n} numbers, {', '.join(prior.names)}")
        one = np.eye(len(values), dtype=np.bool_)
        with np.errstate(invalid="ignore"):  # of a ratio of infinities
            given = prior.to_unit_cube(values[None])
        # The least and greatest value that the prior allows each parameter, given the others.
        low, high = (np.diagonal(prior.from_unit_cube(np.where(one, end, given))) for end in (0.0, 1.0))
        for k, value in enumerate(values.tolist()):
            if not low[k] <= value <= high[k]:
                allowed = f"{low[k]:g} to {high[k]:g}, as the {name}'s prior has it"
                allowed += "; without it the seed draws one" * ("truth" in called)
                raise ParameterError(f"{prior.names[k]} of {called}", value, allowed)
        return cls(name, shape, values)

    @classmethod
    def drawn_from_prior(cls, members: Mapping[str, Shape], *, rng: np.random.Generator) -> HiddenShape:
        """Draw one of several shapes, all equally probable, and its parameters from its prior."""
        require_rng(rng)
        name = list(members)[int(rng.integers(len(members)))]
        prior = members[name].prior
        return cls(name, members[name], prior.from_unit_cube(rng.random((1, len(prior.names))))[0])

    @classmethod
    def given_or_drawn(
        cls, truth: Truth | None, shape: Shape, field: Field, *, rng: np.random.Generator
    ) -> HiddenShape:
        """Build from parameters, of a possible shape or as {shape: parameters}; None: draw shape and parameters.

        Parameters without the name of a shape are those of the first of a set of possible shapes. ParameterError if the
        shape's name is unknown, or its prior excludes the numbers.
        """
        members = dict(shape.shapes) if isinstance(shape, AnyOf) else {type(shape).__name__.lower(): shape}
        if truth is None:
            return cls.drawn_from_prior(members, rng=rng)
        name, values = next(iter(members)), cast(object, truth)
        known = {**{name: make(field) for name, make in SHAPES.items()}, **members}
        if isinstance(truth, Mapping) and len(truth) == 1 and set(truth) <= set(known):
            ((name, values),) = truth.items()
        elif isinstance(truth, Mapping) and not set(truth) & set(members[name].prior.names):
            raise ParameterError("truth", truth, f"one shape of {', '.join(known)} with its parameters")
        return cls.from_parameters(name, known[name], _theta_in_prior_order(known[name].prior.names, values))

    @property
    def journal_entry(self) -> dict[str, str | float]:
        """The shape's name and parameters for the journal's first line, since a resumed run needs the same shape."""
        return {"shape": self.name, **self.parameters}

    @property
    def surface(self) -> Surface:
        """The shape's surface in the simulated world, which shares only geometry with the models.

        ParameterError for a shape whose outline is not a single closed line.
        """
        region = self.shape.region(self.theta[None, :])
        if isinstance(region, EllipseRegion):
            center, axes = region.center_mm[0].tolist(), region.semi_axes_mm[0].tolist()
            if axes[0] == axes[1]:
                return Disc((center[0], center[1]), axes[0])
            return Oval((center[0], center[1]), (axes[0], axes[1]), float(region.angle_rad[0]))
        (outline,) = outlines(region, n_vertices=_PAINTED_VERTICES)
        require(not np.isnan(outline).any(), "shape", self.name, "one whose outline is one closed line")
        return Polygon(tuple((float(x), float(y)) for x, y in outline[:-1]))

    @property
    def outline_mm(self) -> FloatArray:
        """The shape's outline, closed, (n_points, 2)."""
        return outlines(self.shape.region(self.theta[None, :]))[0]

    @property
    def parameters(self) -> dict[str, float]:
        """The shape's parameters by name."""
        return dict(zip(self.shape.prior.names, self.theta.tolist(), strict=True))

    def parameters_by_hypothesis_name(self, names: Sequence[str]) -> dict[str, float]:
        """Return the parameters under the names of a hypothesis, such as "rectangle.width_mm" in a set of shapes.

        Of `names`, those of parameters that this shape does not have are left out.
        """
        known, prefix = self.parameters, f"{self.name}."
        return {name: known[name.removeprefix(prefix)] for name in names if name.removeprefix(prefix) in known}


def _theta_in_prior_order(names: Sequence[str], values: object) -> FloatArray:
    if not isinstance(values, Mapping):
        return floats(values, "truth")  # type: ignore[arg-type]
    require(set(values) == set(names), "truth", values, f"one number for each of {', '.join(names)}")
    return np.array([checked_finite_number(f"truth[{name!r}]", values[name]) for name in names])
