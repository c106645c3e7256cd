"""A combination of effects, refitted and weighed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.laplace import NoiseEvidence
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.names import Names
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.diagnosis.search.constants import STEERING
from probewise.effects import NUISANCES, is_out_of_vocabulary

__all__ = [
    "WeighedFit",
    "expected_nats",
    "in_vocabulary",
    "out_of_vocabulary",
]


@dataclass(frozen=True, eq=False)
class WeighedFit:
    """A combination of effects on the mean at one SSF order, refitted and weighed under each noise model."""

    found: Fit
    law: NoiseLaw  # of the noise, under which it was fitted
    evidence: Mapping[Names, NoiseEvidence]
    log_share: float  # in the evidence, for the discrete choices that its effects have made
    log_visible: float  # in the evidence: what of it is not the hypothesis with an effect less
    weights: Mapping[str, FloatArray]  # of the variants among which each effect chose

    @property
    def names(self) -> Names:
        """Its effects on the mean, sorted."""
        return tuple(sorted(self.found.model.names))

    @classmethod
    def of(cls, found: Fit, law: NoiseLaw, plain: Mapping[Names, NoiseEvidence], log_visible: float) -> WeighedFit:
        """Take a fit with the evidence of its parameters, as if nothing else had been chosen."""
        return cls(found, law, {}, 0.0, log_visible, {}).with_evidence(plain)

    @property
    def log_factor(self) -> float:
        """Log of what the evidence of its parameters alone is multiplied by."""
        return self.log_share + self.log_visible

    def with_evidence(self, plain: Mapping[Names, NoiseEvidence]) -> WeighedFit:
        """Take the evidence of its parameters under each noise model."""
        return replace(self, evidence=plain).moved(self.log_factor)

    def as_share(self, log_share: float, weights: Mapping[str, FloatArray]) -> WeighedFit:
        """Let it stand for all the variants of its effects."""
        return replace(self.moved(log_share - self.log_share), log_share=log_share, weights=weights)

    def moved(self, by: float) -> WeighedFit:
        """Move its log evidence under every noise model alike."""
        return replace(self, evidence={noise: replace(e, log_z=e.log_z + by) for noise, e in self.evidence.items()})

    @property
    def n_gaussians(self) -> int:
        """Its SSF order."""
        return self.found.model.sensor.n_gaussians

    @property
    def sd(self) -> float:
        """Sd of a whitened reading, a tail aside, rounding with it."""
        return self.found.sd * self.law.widening

    @property
    def degrees_of_freedom(self) -> int:
        """How many Gaussians its SSF is as free as."""
        return self.found.model.sensor.degrees_of_freedom

    @property
    def log_z(self) -> float:
        """Log evidence under the noise model of the most."""
        return max(e.log_z for e in self.evidence.values())

    def steering(self) -> Iterator[tuple[Names, NoiseEvidence]]:
        """List the noise models that are not far behind the best, and the plainest.

        What is missing from the mean can look like noise of any kind, and be seen under plain noise alone.
        """
        best, plain = self.log_z, min(self.evidence, key=len)
        return ((k, e) for k, e in self.evidence.items() if k == plain or e.log_z >= best - STEERING)


def expected_nats(first: WeighedFit, second: WeighedFit) -> float:
    """Log Bayes factor to be expected between two refitted models if the first is true.

    Half of the squared distance between their predictions, in sds of the noise as the first has it.
    """
    apart = first.law((first.found.residuals - second.found.residuals)[:, None])
    return 0.5 * float(np.sum(apart**2)) / first.sd**2


def in_vocabulary(noise: Names) -> Names:
    """Leave out of a noise model what is no name of the vocabulary's."""
    return tuple(name for name in noise if name not in NUISANCES)


def out_of_vocabulary(mean: Names) -> Names:
    """Select the effects on the mean that are outside the vocabulary."""
    return tuple(name for name in mean if is_out_of_vocabulary(name))
