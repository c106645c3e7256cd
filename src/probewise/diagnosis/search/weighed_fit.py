"""A refitted combination of effects with its evidence."""

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


@dataclass(frozen=True, eq=False)
class WeighedFit:
    """A combination of effects on the mean at one SSF order, refitted, with its evidence under each noise model."""

    found: Fit
    law: NoiseLaw  # noise distribution of the fit
    evidence: Mapping[Names, NoiseEvidence]
    log_share: float  # log prior factor of the effects' discrete choices (variants)
    log_detectable: float  # log probability that all effects have a detectable size
    weights: Mapping[str, FloatArray]  # weights of each effect's variants

    @property
    def names(self) -> Names:
        """Its effects on the mean, sorted."""
        return tuple(sorted(self.found.model.names))

    @classmethod
    def of(cls, found: Fit, law: NoiseLaw, plain: Mapping[Names, NoiseEvidence], log_detectable: float) -> WeighedFit:
        """Build from a fit and the evidence of its parameters, without factors for discrete choices."""
        return cls(found, law, {}, 0.0, log_detectable, {}).with_evidence(plain)

    @property
    def log_factor(self) -> float:
        """Log of the factor on the evidence of its parameters."""
        return self.log_share + self.log_detectable

    def with_evidence(self, plain: Mapping[Names, NoiseEvidence]) -> WeighedFit:
        """Return it with other evidences of its parameters under each noise model."""
        return replace(self, evidence=plain).moved(self.log_factor)

    def as_share(self, log_share: float, weights: Mapping[str, FloatArray]) -> WeighedFit:
        """Return it with the factor and the weights for all variants of its effects."""
        return replace(self.moved(log_share - self.log_share), log_share=log_share, weights=weights)

    def moved(self, by: float) -> WeighedFit:
        """Return it with its log evidence shifted equally under every noise model."""
        return replace(self, evidence={noise: replace(e, log_z=e.log_z + by) for noise, e in self.evidence.items()})

    @property
    def n_gaussians(self) -> int:
        """Its SSF order."""
        return self.found.model.sensor.n_gaussians

    @property
    def sd(self) -> float:
        """Sd of a whitened reading, including rounding but not a tail."""
        return self.found.sd * self.law.widening

    @property
    def degrees_of_freedom(self) -> int:
        """Effective degrees of freedom of its SSF, counted in Gaussians."""
        return self.found.model.sensor.degrees_of_freedom

    @property
    def log_z(self) -> float:
        """Log evidence under the best noise model."""
        return max(e.log_z for e in self.evidence.values())

    def steering(self) -> Iterator[tuple[Names, NoiseEvidence]]:
        """List the noise models that are not far behind the best, and the simplest one.

        A missing effect on the mean can look like any noise effect, and be detectable under white noise only.
        """
        best, plain = self.log_z, min(self.evidence, key=len)
        return ((k, e) for k, e in self.evidence.items() if k == plain or e.log_z >= best - STEERING)


def expected_nats(first: WeighedFit, second: WeighedFit) -> float:
    """Return the expected log Bayes factor between two refitted models if the first is true.

    It is half the squared distance between their predictions, in noise sds of the first.
    """
    apart = first.law((first.found.residuals - second.found.residuals)[:, None])
    return 0.5 * float(np.sum(apart**2)) / first.sd**2


def in_vocabulary(noise: Names) -> Names:
    """Return the effects of a noise model that are in the vocabulary."""
    return tuple(name for name in noise if name not in NUISANCES)


def out_of_vocabulary(mean: Names) -> Names:
    """Select the effects on the mean that are outside the vocabulary."""
    return tuple(name for name in mean if is_out_of_vocabulary(name))
