"""What a search has weighed: combinations refitted, the rest by screening, all turned into probabilities."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.bank import Bank
from probewise.diagnosis.evidence.laplace import NoiseEvidence
from probewise.diagnosis.evidence.templates import TemplateMemory
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.diagnosis.noise.models import NoiseModel
from probewise.diagnosis.residuals.covariates import Covariate
from probewise.diagnosis.search.odds import PriorOdds
from probewise.effects import NUISANCES, UNNAMED, NamedEffect
from probewise.recordings.plan import Recording
from probewise.sensor import Stage

__all__ = [
    "ALIASED_NATS",
    "STEERING",
    "Search",
    "WeighedFit",
    "expected_nats",
    "in_vocabulary",
    "out_of_vocabulary",
    "weighed",
]

Names = tuple[str, ...]

STEERING = 3.0
"""Nats behind the best: a noise model further back does not say what to look for next."""

ALIASED_NATS = 3.0
"""Nats that readings are expected to tell between two hypotheses; with fewer they cannot tell."""


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


@dataclass(frozen=True, eq=False)
class Search:
    """Everything weighed: refitted candidates by (order, names), and the screened rest.

    Hypotheses are pairs (mean, noise) of names; the mean ("unknown",) is what has no name, alone or beside others.
    """

    recording: Recording
    effects: Mapping[str, NamedEffect[Any]]
    noise_models: Mapping[Names, NoiseModel]
    certain: Names  # effects on the noise that the readings show without doubt
    sensors: Mapping[int, Null]
    candidates: Mapping[tuple[int, Names], WeighedFit]
    screened: Mapping[tuple[Names, Names], float]  # (mean, noise) -> log evidence
    unknown: Mapping[tuple[int, Names, Names], float]  # (order, mean, noise) -> log evidence
    prior: PriorOdds
    covariates: tuple[Covariate, ...]
    unknown_bases: Bank
    unknown_shares: Mapping[str, float]
    about: Fit  # where the templates of the tests are laid out
    templates: TemplateMemory
    probabilities: Mapping[tuple[Names, Names], float] = field(default_factory=dict)
    order_probabilities: Mapping[int, float] = field(default_factory=dict)  # of the clean mean

    def best(self, names: Names, noise: Names) -> WeighedFit | None:
        """Return the refitted candidate of these effects with the most evidence over orders."""
        options = [c for (_, key), c in self.candidates.items() if key == names]
        return max(options, key=lambda c: c.evidence[noise].log_z, default=None)

    def alike(self, names: Names) -> frozenset[Names]:
        """Give the other combinations that these readings cannot tell from this one, at any SSF order; () has none."""
        return frozenset(
            key
            for (n, key), other in self.candidates.items()
            if names and key and key != names and (n, names) in self.candidates
            if expected_nats(self.candidates[n, names], other) < ALIASED_NATS
        )

    @property
    def by_mean(self) -> dict[Names, float]:
        """Probability of each hypothesis about the mean, under any noise."""
        out: dict[Names, float] = {}
        for (mean, _), p in self.probabilities.items():
            out[mean] = out.get(mean, 0.0) + p
        return out

    def beside(self, noise: Names) -> WeighedFit | None:
        """Give the fit beside which something unknown most probably is; None where nothing unknown was weighed."""
        scores = {
            (n, names): value + self.prior.log_unknown(names)
            for (n, names, own), value in self.unknown.items()
            if own == noise
        }
        return self.candidates[max(scores, key=lambda key: scores[key])] if scores else None

    def looks(self, found: Fit) -> list[Bank]:
        """List every template that a test looks at about a fit: of the effects that it lacks, and the unknown.

        All are laid out about one fit: those of one recording predict much the same, and which templates a test looks
        with is its own choice.
        """
        on_mean = [effect for effect in self.effects.values() if effect.stage is not Stage.NOISE]
        missing = [effect for effect in on_mean if effect.name not in found.model.names]
        return [self.templates.bank(self.about, missing), self.unknown_bases]

    @property
    def order(self) -> int:
        """SSF order of the most probable explanation, named or not: that at which the null is tested."""
        by_order: dict[int, float] = {}
        terms = [(n, c.log_z + self.prior.log_mean(names)) for (n, names), c in self.candidates.items()]
        for (n, names, _), value in self.unknown.items():
            terms.append((n, value + self.prior.log_unknown(names)))
        for n, value in terms:
            by_order[n] = float(np.logaddexp(by_order.get(n, -np.inf), value))
        return max(by_order, key=lambda n: by_order[n])


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
    """Keep those of a combination on the mean that have a formula and no name in the vocabulary."""
    return tuple(name for name in mean if name in UNNAMED)


def weighed(search: Search) -> Search:
    """Turn evidences into probabilities of (mean, noise) hypotheses, summed over SSF orders."""
    prior = search.prior
    log_order = -math.log(len(search.sensors))
    log_z: dict[tuple[Names, Names], float] = {}
    for (_, names), candidate in search.candidates.items():
        for noise, evidence in candidate.evidence.items():
            log_z[names, noise] = float(np.logaddexp(log_z.get((names, noise), -np.inf), evidence.log_z))
    log_p = {key: value + prior.log_mean(key[0]) for key, value in log_z.items()}
    for (_, names, noise), value in search.unknown.items():
        key = ("unknown",), noise
        log_p[key] = float(np.logaddexp(log_p.get(key, -np.inf), value + prior.log_unknown(names)))
    for (names, noise), value in search.screened.items():
        log_p[names, noise] = value + prior.log_mean(names)
    for names, noise in log_p:
        uncertain = tuple(n for n in noise if n not in search.certain)
        log_p[names, noise] += log_order + prior.log_noise(uncertain)
    total = float(logsumexp(list(log_p.values())))
    nulls = {n: c for (n, names), c in search.candidates.items() if not names}
    clean_by_order = {n: float(logsumexp([e.log_z for e in c.evidence.values()])) for n, c in nulls.items()}
    norm = float(logsumexp(list(clean_by_order.values())))
    return replace(
        search,
        probabilities={key: math.exp(value - total) for key, value in log_p.items()},
        order_probabilities={n: math.exp(v - norm) for n, v in clean_by_order.items()},
    )
