"""What every named effect offers besides its function."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol, Self, TypeVar

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.effects.extent import Extent
from probewise.effects.noise_law import NoiseRows
from probewise.recordings.plan import Plan
from probewise.sensor.stages import Effect, NoiseLevel

__all__ = ["Gates", "NamedEffect", "NoiseEffect", "V", "give_or_take"]

V = TypeVar("V")


@dataclass(frozen=True, eq=False)
class Gates:
    """Where variants act that differ in nothing else, one bank entry each.

    `always` are the columns of an entry that acts on all readings, (n_columns, n_params); `opened`
    (n_variants, n_points) are the readings that each variant acts on.
    """

    always: FloatArray
    opened: BoolArray


class NamedEffect(Effect[V], Protocol[V]):
    """An effect of the vocabulary: what the diagnosis needs to look for it and to speak of it.

    A new effect is one class of this kind and one line in `VOCABULARY`.
    """

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each parameter, in the order of `prior.names`."""
        ...

    @property
    def covariates(self) -> tuple[str, ...]:
        """Covariates in which its residual shows."""
        ...

    @property
    def reads(self) -> tuple[str, ...]:
        """Columns of a plan that it reads beside place, time and scan; by default none."""
        return ()

    @property
    def amplitudes(self) -> tuple[int, ...]:
        """Which parameters are amplitudes: the readings change in proportion to first order, 0 means absent."""
        ...

    @property
    def nothing(self) -> Mapping[int, float] | None:
        """Values of parameters, by number, at which it does nothing; None where no setting says that.

        By default all amplitudes 0.
        """
        return dict.fromkeys(self.amplitudes, 0.0) or None

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Build it with a prior fit for a recording of this extent; None where it could not show there.

        An effect of the battery needs the battery's voltage, one of the direction a scan that turns back.
        """
        ...

    def is_of_the_ssf(self, plan: Plan) -> bool:
        """Tell whether an SSF of which nothing is known takes it up whole, by this plan: then it is no effect.

        By default it does not.
        """
        return False

    def bank(self) -> FloatArray:
        """Lay out settings to look for it with, shape (n_bank, n_columns, n_params).

        Each entry spans, by its columns, the readings' change to first order; entries differ in
        what is not linear. Effects on the noise: equally weighted nodes of the prior.
        """
        ...

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Say in plain words what it does, with its numbers, each of shape (n_params,)."""
        ...

    @property
    def n_peaks(self) -> int:
        """Number of settings apart from each other, all in the prior, that do the same; a fit finds one of them."""
        return 1

    @property
    def scans(self) -> tuple[str, ...]:
        """Names of the scans that it is bound to; () where it acts in all."""
        return ()

    @property
    def patterns(self) -> tuple[str, ...]:
        """Names of the patterns that it is bound to; () where it acts on all."""
        return ()

    def variants(self) -> tuple[Self, ...]:
        """List the discrete choices that it leaves open, all as probable: itself with each of them made.

        Which scan, which mounting, between which two readings: what no fit finds by small steps.
        Variants differ in their `scans` or `patterns`, or in their priors alone.
        """
        return (self,)

    def gates(self, plan: Plan) -> Gates | None:
        """Where its variants differ only in the readings that they act on: one prediction does for all of them."""
        return None

    def coarse(self) -> Self:
        """Leave fewer choices open, enough to see whether the effect is there at all; by default all of them."""
        return self

    def spread(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Spread samples of one variant's parameters, (n_samples, n_params), over all variants by their weight.

        As they are, unless a parameter says which variant it is.
        """
        return theta

    def start(self, entry: FloatArray, amounts: FloatArray) -> FloatArray:
        """Turn an entry of the bank (n_columns, n_params) and its columns' fitted amounts into a setting (n_params,).

        Amplitudes scale with the amounts; what is no amplitude (a level, an exponent) stays as in the bank.
        """
        setting = entry[0].copy()
        for k in self.amplitudes:
            setting[k] = amounts @ entry[:, k]
        return np.asarray(setting)


class NoiseEffect(NamedEffect[NoiseLevel], Protocol):
    """An effect on the noise: nothing of it is seen in the mean of the readings."""

    n_nodes: ClassVar[int] = 10
    """Nodes of its prior, for an effect of one parameter."""

    def bank(self) -> FloatArray:
        """Lay out equally weighted nodes of the prior of its one parameter, (n_nodes, 1, 1)."""
        return self.prior.from_unit_cube((np.arange(self.n_nodes)[:, None] + 0.5) / self.n_nodes)[:, None, :]

    def nodes(self, residuals: FloatArray, rows: NoiseRows) -> FloatArray:
        """Lay out equally weighted nodes of the prior about a fit, (n_nodes, n_params); none where it cannot be.

        `residuals` (n_points,) are in units of the noise sd.
        """
        return self.bank()[:, 0, :]

    def weighed_nodes(self, residuals: FloatArray, rows: NoiseRows) -> tuple[FloatArray, FloatArray]:
        """Lay out nodes about a fit with the log of the prior that each stands for, (n_nodes, n_params), (n_nodes,)."""
        nodes = self.nodes(residuals, rows)
        return nodes, np.full(len(nodes), -np.log(max(len(nodes), 1)))

    def draws_about(self, nodes: FloatArray, *, rng: np.random.Generator) -> FloatArray | None:
        """Draw parameters about nodes drawn, (n_samples, n_params) both; None where nodes lie as close as need be."""
        return None


def give_or_take(mean: float, sd: float, *, factor: float = 1.0) -> str:
    """Write mean ± sd with as many digits as the sd deserves."""
    mean, sd = factor * mean, factor * sd
    if not (np.isfinite(sd) and sd > 0):
        return f"{mean:.4g}"
    digits = int(np.clip(1 - np.floor(np.log10(sd)), 0, 8))
    return f"{mean:z.{digits}f} ± {sd:.{digits}f}"  # what rounds to zero has no sign
