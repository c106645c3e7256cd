"""Effects with a change point in time; between which two readings it lies is a discrete choice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np

from probewise._arrays import BoolArray, FloatArray, distinct_values
from probewise.effects.extent import Extent
from probewise.effects.heavy_tailed_prior import HeavyTailedPrior
from probewise.effects.vocabulary import NamedEffect, V, VariantMasks
from probewise.priors import Product, Uniform
from probewise.recordings.plan import Plan

_MOST_TIMES = 512
_FEW = 48  # intervals, enough to detect that something changed in one of them


@dataclass(frozen=True)
class ChangePointEffect(NamedEffect[V]):
    """Base of effects that act on the readings taken after `at_s`, the last parameter.

    `times_s` are the times of the readings. Between which two of them the change point lies is a discrete choice
    (`between_s`); its position within that interval does not affect any reading.
    """

    times_s: tuple[float, ...] = (0.0, 1e5)
    between_s: tuple[float, float] | None = None

    @property
    def typical_sizes(self) -> Mapping[str, float]:
        """Typical size of each amplitude, by name."""
        raise NotImplementedError

    @property
    def amplitudes(self) -> tuple[int, ...]:
        """Indices of all parameters but the last, the time."""
        return tuple(range(len(self.typical_sizes)))

    @cached_property
    def prior(self) -> Product:
        """Prior of the amplitudes, heavy-tailed with either sign, and of the time, uniform in `change_interval_s`."""
        sizes = {name: HeavyTailedPrior(size) for name, size in self.typical_sizes.items()}
        return Product({**sizes, "at_s": Uniform(*self.change_interval_s)})

    def bank(self) -> FloatArray:
        """Return one entry, (1, n_amplitudes, n_params): a column per amplitude, the time amid its interval."""
        sizes = np.diag(list(self.typical_sizes.values()))
        return np.column_stack([sizes, np.full(len(sizes), sum(self.change_interval_s) / 2)])[None, :, :]

    @property
    def change_interval_s(self) -> tuple[float, float]:
        """Bounds of the interval in which the change point may lie, s: `between_s`, else the whole recording."""
        return self.between_s or (self.times_s[0], self.times_s[-1])

    @staticmethod
    def after_change_mask(theta: FloatArray, plan: Plan) -> BoolArray:
        """Return the mask of the readings taken after each sample's change point, (n_samples, n_points)."""
        return np.asarray(plan.time_s > theta[:, -1:])

    @property
    def has_change_point(self) -> bool:
        """True."""
        return True

    def variants(self) -> tuple[Self, ...]:
        """Return one variant for each interval between consecutive `times_s`."""
        return tuple(replace(self, between_s=pair) for pair in pairwise(self.times_s))

    def with_fewer_variants(self) -> Self:
        """Return the effect with neighbouring intervals joined, so that at most 48 remain."""
        stride = -(-(len(self.times_s) - 1) // _FEW)
        return replace(self, times_s=(*self.times_s[:-1:stride], self.times_s[-1]))

    def variant_masks(self, plan: Plan) -> VariantMasks:
        """Return the masks of readings after each candidate change point, (n_intervals, n_points).

        A candidate is the middle of its interval. The bank entry beside the masks acts on all readings.
        """
        always = self.bank()[0]
        always[:, -1] = -np.inf
        middles = [sum(pair) / 2 for pair in pairwise(self.times_s)]
        return VariantMasks(always, np.array([plan.time_s > at for at in middles]))

    def redraw_by_variant(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Redraw the time of change: for each sample an interval with probability `weights`, then a time within it.

        `theta` is (n_samples, n_params), in and out; `weights` is (n_intervals,).
        """
        times = np.array(self.times_s)
        chosen = rng.choice(len(weights), len(theta), p=weights)
        at_s = times[chosen] + np.diff(times)[chosen] * rng.random(len(theta))
        return np.concatenate([theta[:, :-1], at_s[:, None]], axis=1)


def candidate_change_times_s(extent: Extent) -> tuple[float, ...] | None:
    """Return the distinct times of a recording's readings, thinned to at most 512 intervals; None for one time."""
    times = distinct_values(extent.plan.time_s)
    if len(times) < 2:
        return None
    stride = -(-(len(times) - 1) // _MOST_TIMES)
    return tuple(np.append(times[:-1:stride], times[-1]).tolist())
