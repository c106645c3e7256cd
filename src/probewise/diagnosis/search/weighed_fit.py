"""A refitted combination of effects with its evidence: a candidate of the search."""

from __future__ import annotations

import math
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


def or_impossible(log_z: float) -> float:
    """Return a log evidence, minus infinity for one that is no number: all probabilities would be none."""
    return -math.inf if math.isnan(log_z) else log_z


@dataclass(frozen=True, eq=False)
class WeighedFit:
    """A candidate: effects on the mean refitted with an SSF of some number of Gaussians; evidence by noise effects."""

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
        """Build from a fit and its `plain` evidence by noise model: of its parameters alone, without prior factors."""
        return cls(found, law, {}, 0.0, log_detectable, {}).with_evidence(plain)

    @property
    def log_prior_factor(self) -> float:
        """Log prior factor in its evidence: of its effects' discrete choices, and of their detectable sizes."""
        return self.log_share + self.log_detectable

    def with_evidence(self, plain: Mapping[Names, NoiseEvidence]) -> WeighedFit:
        """Return a copy with new evidence, by noise model: `plain`, of its parameters alone, plus its prior factor."""
        return replace(self, evidence=plain).with_log_evidence_shifted(self.log_prior_factor)

    def with_variant_factor_and_weights(self, log_share: float, weights: Mapping[str, FloatArray]) -> WeighedFit:
        """Return a copy with other log prior factor and weights of its effects' variants (discrete choices)."""
        return replace(self.with_log_evidence_shifted(log_share - self.log_share), log_share=log_share, weights=weights)

    def with_log_evidence_shifted(self, by: float) -> WeighedFit:
        """Return a copy with its log evidence shifted by these nats under every noise model.

        An evidence that is no number counts as minus infinity: it must not spoil the probabilities of all others.
        """
        return replace(
            self,
            evidence={noise: replace(e, log_z=or_impossible(e.log_z + by)) for noise, e in self.evidence.items()},
        )

    @property
    def n_gaussians(self) -> int:
        """Number of Gaussians of its SSF (SSF order)."""
        return self.found.model.sensor.n_gaussians

    @property
    def whitened_sd(self) -> float:
        """Noise sd of a whitened reading, in reading units, including rounding but not a tail."""
        return self.found.sd * self.law.sd_factor_of_rounding

    @property
    def ssf_degrees_of_freedom(self) -> int:
        """Effective degrees of freedom of its SSF, counted in Gaussians."""
        return self.found.model.sensor.effective_n_gaussians

    @property
    def log_z(self) -> float:
        """Log evidence under the best noise model."""
        return max(e.log_z for e in self.evidence.values())

    def possible_noise(self, noise: Names) -> Names:
        """Return a noise model or, where it is impossible about this fit, the best of those with part of its effects.

        Lost readings, for instance, are not seen about a fit that is far off.
        """
        if np.isfinite(self.evidence[noise].log_z):
            return noise
        parts = [names for names in self.evidence if {*names} < {*noise}]
        return max(parts, key=lambda names: self.evidence[names].log_z, default=noise)

    def leading_noises(self) -> Iterator[tuple[Names, NoiseEvidence]]:
        """Iterate over the noise models within three nats of the best, and the simplest one: names and evidence.

        A missing effect on the mean can look like any noise effect, and be detectable under white noise only.
        """
        best, plain = self.log_z, min(self.evidence, key=len)
        return ((k, e) for k, e in self.evidence.items() if k == plain or e.log_z >= best - STEERING)


def expected_log_bayes_factor(first: WeighedFit, second: WeighedFit) -> float:
    """Return the log Bayes factor expected between two candidates if the first is true, in nats.

    This is half the squared distance between their predictions, whitened, in noise sds of the first.
    """
    apart = first.law((first.found.residuals - second.found.residuals)[:, None])
    return 0.5 * float(np.sum(apart**2)) / first.whitened_sd**2


def noise_effects_in_vocabulary(noise: Names) -> Names:
    """Return the effects of a noise model without nuisances, which have no name in the vocabulary."""
    return tuple(name for name in noise if name not in NUISANCES)


def effects_out_of_vocabulary(mean: Names) -> Names:
    """Return the effects on the mean, of those named, that are out of vocabulary."""
    return tuple(name for name in mean if is_out_of_vocabulary(name))
