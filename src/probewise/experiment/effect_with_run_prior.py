"""An effect with the prior that a single run needs: sizes large enough to matter, and times within the run.

A diagnosis of hundreds of readings weighs effects of all sizes, most of them far too small to change the dozen readings
of a run or its shape; here these are excluded. A change point is log-uniform over up to a hundred readings. A patch may
lie anywhere on the field, not only along scanned lines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

from probewise._arrays import FloatArray
from probewise.effects import HeavyTailedPrior, LogHeavyTailedPrior, NamedEffect
from probewise.effects.known import WrappedEffect
from probewise.effects.optics import PatchPrior
from probewise.experiment.pace import EACH_S
from probewise.priors import LogUniform, Prior, Product, Uniform

_SMALLEST = 4.0
"""Smallest sd of an effect's size, in typical sizes of a recording: a smaller one hardly moves the shape."""


@dataclass(frozen=True, eq=False)
class EffectWithRunPrior(WrappedEffect[Any]):
    """An effect with the prior for a run: no sizes too small to show, change points within the run.

    `field_mm` holds width and height of the field, on which a patch may lie anywhere.
    """

    effect: NamedEffect[Any]
    field_mm: tuple[float, float]

    within_run: ClassVar[Mapping[str, LogUniform]] = {"at_s": LogUniform(0.5 * EACH_S, 100.0 * EACH_S)}

    @cached_property
    def prior(self) -> Prior:
        """The effect's prior for a run."""
        own = self.effect.prior
        if isinstance(own, PatchPrior):
            size = HeavyTailedPrior(own.typical, smallest=_SMALLEST)
            x, y = (Uniform(0.0, length) for length in self.field_mm)
            return Product({own.size: size, "x": x, "y": y, "r": own.radius_prior})
        if not isinstance(own, Product):
            return own
        return Product({name: self._marginal_for_run(name, marginal) for name, marginal in own.marginals.items()})

    def _marginal_for_run(self, name: str, marginal: Any) -> Any:
        """Return a parameter's marginal prior: a size without small values, a change point within the run, or as is."""
        if isinstance(marginal, HeavyTailedPrior | LogHeavyTailedPrior):
            return replace(marginal, smallest=_SMALLEST)
        return self.within_run.get(name, marginal)

    def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
        """Describe the effect, given posterior means and sds of its parameters."""
        return self.effect.sentence(mean, sd)
