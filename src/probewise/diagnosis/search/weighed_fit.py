"""A refitted combination of effects with its evidence: a candidate of the search."""

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
        """Names of its effects on the mean, sorted."""
        return tuple(sorted(self.found.model.names))

    @classmethod
    def of(cls, found: Fit, law: NoiseLaw, plain: Mapping[Names, NoiseEvidence], log_detectable: float) -> WeighedFit:
        """Build from a fit and its `plain` evidence: of its parameters alone, without prior factors."""
        return cls(found, law, {}, 0.0, log_detectable, {}).with_evidence(plain)

    @property
    def log_prior_factor(self) -> float:
        """Log of the prior factor by which its evidence differs from that of its parameters alone."""
        return self.log_share + self.log_detectable

    def with_evidence(self, plain: Mapping[Names, NoiseEvidence]) -> WeighedFit:
        """Return it with new evidence, by noise model: `plain`, that of its parameters alone, plus its prior factor."""
        return replace(self, evidence=plain).with_log_evidence_shifted(self.log_prior_factor)

    def with_variant_factor_and_weights(self, log_share: float, weights: Mapping[str, FloatArray]) -> WeighedFit:
        """Return it with another log prior factor of its effects' variants, and the variants' weights, by effect."""
        return replace(self.with_log_evidence_shifted(log_share - self.log_share), log_share=log_share, weights=weights)

    def with_log_evidence_shifted(self, by: float) -> WeighedFit:
        """Return it with its log evidence shifted by these nats under every noise model."""
        return replace(self, evidence={noise: replace(e, log_z=e.log_z + by) for noise, e in self.evidence.items()})

    @property
    def n_gaussians(self) -> int:
        """Its SSF order, the number of Gaussians."""
        return self.found.model.sensor.n_gaussians

    @property
    def whitened_sd(self) -> float:
        """Sd of a whitened reading, including rounding but not a tail."""
        return self.found.sd * self.law.sd_factor_of_rounding

    @property
    def ssf_degrees_of_freedom(self) -> int:
        """Effective degrees of freedom of its SSF, counted in Gaussians."""
        return self.found.model.sensor.effective_n_gaussians

    @property
    def log_z(self) -> float:
        """Log evidence under the best noise model."""
        return max(e.log_z for e in self.evidence.values())

    def leading_noises(self) -> Iterator[tuple[Names, NoiseEvidence]]:
        """Iterate over names and evidence of the noise models within three nats of the best, and of the simplest one.

        A missing effect on the mean can look like any noise effect, and be detectable under white noise only.
        """
        best, plain = self.log_z, min(self.evidence, key=len)
        return ((k, e) for k, e in self.evidence.items() if k == plain or e.log_z >= best - STEERING)


def expected_log_bayes_factor(first: WeighedFit, second: WeighedFit) -> float:
    """Return the log Bayes factor expected between two candidates if the first is true, in nats.

    It is half the squared distance between their predictions, whitened, in noise sds of the first.
    """
    apart = first.law((first.found.residuals - second.found.residuals)[:, None])
    return 0.5 * float(np.sum(apart**2)) / first.whitened_sd**2


def noise_effects_in_vocabulary(noise: Names) -> Names:
    """Return those effects of a noise model that are in the vocabulary, without nuisances."""
    return tuple(name for name in noise if name not in NUISANCES)


def effects_out_of_vocabulary(mean: Names) -> Names:
    """Return those effects on the mean that are out of vocabulary."""
    return tuple(name for name in mean if is_out_of_vocabulary(name))
