"""The stages of the chain from pose to reading: the table that they see, and how an effect acts at each."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ParamSpec, TypeAlias

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.errors import require
from probewise.world.spots import Spot


@dataclass(frozen=True, eq=False)
class Rows:
    """One row per reading, in order of time.

    `place_mm`: position (x, y) of the sensor, shape (n_points, 2): commanded, or true once the arm's errors are
    applied; `direction`: unit vector of the last motion, 0 where there was none, shape (n_points, 2);
    `orientation_rad`: orientation, commanded or true, shape (n_points,); `time_s`: time, shape (n_points,); `scan`:
    number of the scan, an index of `scan_names`, shape (n_points,); `scan_names`: name of each scan; `covariates`:
    other logged columns by name, arrays of shape (n_points,); `across`: unit vector across the straight edges of the
    pattern below, (1, 0) for others (`common_edge_normal`), shape (n_points, 2); `edge_mm`: distance from the sensor's
    position to the pattern's nearest edge, infinite where there is none, (n_points,).
    """

    place_mm: FloatArray
    direction: FloatArray
    orientation_rad: FloatArray
    time_s: FloatArray
    scan: IntArray
    scan_names: tuple[str, ...]
    covariates: Mapping[str, FloatArray]
    across: FloatArray
    edge_mm: FloatArray

    def commanded_column(self, name: str, *, otherwise: float) -> FloatArray:
        """Return the covariate `name`, shape (n_points,), with `otherwise` in place of NaN or of an absent column."""
        column = self.covariates.get(name, np.full(len(self.time_s), np.nan))
        return np.where(np.isfinite(column), column, otherwise)

    def in_scans_mask(self, names: tuple[str, ...]) -> BoolArray:
        """Return a mask of the rows that belong to a scan in `names`, shape (n_points,)."""
        chosen = [k for k, name in enumerate(self.scan_names) if name in names]
        return np.isin(self.scan, chosen)

    def scan_start_mask(self) -> BoolArray:
        """Return a mask, shape (n_points,), of the rows that start a scan or resume it after another scan."""
        return np.concatenate([[True], self.scan[1:] != self.scan[:-1]])


STAGES = (
    *("place", "turn", "pattern", "albedo", "tilt", "height", "footprint", "seen"),
    *("response", "gain", "offset", "lag", "saturation", "noise", "quantisation", "loss"),
)
"""In order: pose, scene, footprint, u, response, gain, offsets, lag, saturation, noise, rounding."""

AFTER_VIEW = STAGES[STAGES.index("response") :]
"""The stages after `World.view`, in which the light is summed."""


@dataclass(frozen=True, eq=False)
class FootprintPart:
    """A component of the footprint: a `share` of the light comes through `spot`, moved by `shift_mm` (lab frame)."""

    share: float
    spot: Spot
    shift_mm: tuple[float, float] = (0.0, 0.0)


Act: TypeAlias = Callable[..., Any]
"""How an effect acts at its stage: a function of what the chain has there, which returns that with the effect.

- "albedo": of the albedo at points `x_mm`, `y_mm` of the lab frame, and these; all of one shape.
- "footprint": of the footprint's components, whose shares sum to one.
- "noise", "loss": of values, (n_points,), the `Rows`, the seen white fraction and a generator. Values are independent
  standard normal draws, which become the noise in units of its sd; at "loss", the finished readings.
- All others: of one quantity per reading, (n_points,) unless given, and the `Rows`, whose poses are true, but commanded
  ones at "place" and "turn". "place": position of the sensor, (n_points, 2), mm; "turn": its orientation, rad;
  "pattern": displacement of the pattern from its description, (n_points, 2), mm; "tilt": shift of the footprint in the
  lab frame, (n_points, 2), mm; "height" above the surface, mm; "seen" and "response": the seen white fraction u;
  "gain": the signal without I_min; "offset", "lag", "saturation" and "quantisation": the reading.
"""


@dataclass(frozen=True)
class Concealed:
    """An effect that a world conceals: name, stage, parameters by name, how it acts, and the kind that makes it."""

    name: str
    stage: str  # one of STAGES
    parameters: Mapping[str, Any] = field(hash=False)
    act: Act = field(compare=False, repr=False)
    kind: Callable[..., Concealed] = field(compare=False, repr=False)

    def __reduce__(self) -> tuple[Callable[..., Concealed], tuple[Any, ...]]:
        return self.kind, tuple(self.parameters.values())

    @property
    def disturbs(self) -> bool:
        """Whether it changes the noise or loses readings."""
        return self.stage in ("noise", "loss")


P = ParamSpec("P")
KINDS: dict[str, Callable[..., Concealed]] = {}
"""Every kind of effect by name, as `acts_at` made it."""


def acts_at(stage: str) -> Callable[[Callable[P, Act]], Callable[P, Concealed]]:
    """Make a kind of effect of a function from parameters to how it acts: called, it returns the effect of its name."""
    require(stage in STAGES, "stage", stage, f"one of {', '.join(STAGES)}")

    def kind_of_effect(act_with: Callable[P, Act]) -> Callable[P, Concealed]:
        @functools.wraps(act_with)
        def effect(*values: P.args, **named: P.kwargs) -> Concealed:
            bound = inspect.signature(act_with).bind(*values, **named)
            bound.apply_defaults()
            return Concealed(act_with.__name__, stage, bound.arguments, act_with(*values, **named), effect)

        KINDS[act_with.__name__] = effect
        return effect

    return kind_of_effect
