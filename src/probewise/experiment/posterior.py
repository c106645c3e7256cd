"""The posterior of a run: a mixture of kinds of hypotheses, each with its own samples, evidence and error.

The probability of a kind is proportional to its prior times its evidence. Improbable kinds are kept with fewer samples,
so that later readings can revive them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.experiment.kinds import HypothesisKind
from probewise.experiment.particles import Particles, prior_particles
from probewise.nested import Weighted

IMPROBABLE = 1e-3  # probability below which a kind is carried by fewer samples
_FEWER = 3  # times
SUSPECTED = ((0.2, 2), (0.02, 4), (0.0, 6))  # probability from which on a rival has which fraction of the samples

WARY = 12.0
"""Factor on the odds that the sensor model is incomplete, wherever something is concluded: choice of readings, stopping
rule, reported shape and its error, credible set. By the plain odds a fault that a dozen readings can hardly show would
be right one time in ten, and whatever is concluded of a run that has it would miss."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """The kinds of hypotheses and, in the same order, their weighted samples with the evidence."""

    kinds: tuple[HypothesisKind, ...]
    particles: tuple[Particles, ...]

    @property
    def log_odds(self) -> FloatArray:
        """Log of prior times evidence of each kind, (n_kinds,)."""
        return np.array([k.log_prior + p.log_z for k, p in zip(self.kinds, self.particles, strict=True)])

    @property
    def probability(self) -> FloatArray:
        """Probability of each kind, (n_kinds,), summing to one."""
        return _probabilities_of_log_odds(self.log_odds)

    @property
    def log_z(self) -> float:
        """Natural log of the evidence of the mixture."""
        return float(logsumexp(self.log_odds))

    @property
    def left_out(self) -> dict[str, float]:
        """Probability of each effect that the sensor may leave out, marginalised over shapes; "" is none."""
        shares: dict[str, float] = {}
        for kind, p in zip(self.kinds, self.probability.tolist(), strict=True):
            shares[kind.left_out] = shares.get(kind.left_out, 0.0) + p
        return shares

    @property
    def most_probable_kind_index(self) -> int:
        """Index of the most probable kind."""
        return int(self.log_odds.argmax())

    def with_fault_odds_times(self, times: float) -> Posterior:
        """Return the posterior with the odds of an incomplete sensor model multiplied by `times`."""
        log_prior = np.array([k.log_prior + (math.log(times) if k.left_out else 0.0) for k in self.kinds])
        log_prior -= logsumexp(log_prior)
        kinds = tuple(replace(k, log_prior=p) for k, p in zip(self.kinds, log_prior.tolist(), strict=True))
        return replace(self, kinds=kinds)

    @property
    def with_raised_fault_odds(self) -> Posterior:
        """The posterior with the odds of a left-out effect multiplied by 12 (`WARY`); itself if no kind has one."""
        return self.with_fault_odds_times(WARY) if any(kind.left_out for kind in self.kinds) else self

    def joined(self, *, rng: np.random.Generator) -> Weighted:
        """Return the samples of all kinds as one weighted posterior; parameters that a kind lacks are drawn."""
        if len(self.kinds) == 1:
            return self.particles[0].weighted
        probability = self.probability
        some = [k for k, p in enumerate(probability) if p > 0]
        own = [self.particles[k].weighted for k in some]
        leader = self.particles[self.most_probable_kind_index].weighted
        theta = np.concatenate([self.kinds[k].to_whole_theta(w.theta, rng) for k, w in zip(some, own, strict=True)])
        log_weight = np.concatenate([w.log_weight + math.log(probability[k]) for k, w in zip(some, own, strict=True)])
        weight = np.exp(log_weight)
        errors = np.array([self.particles[k].log_z_error for k in some])
        return Weighted(
            self.kinds[0].whole_names,
            theta,
            log_likelihood=np.concatenate([w.log_likelihood for w in own]),
            log_weight=log_weight,
            log_z=self.log_z,
            log_z_error=float(np.sqrt(probability[some] ** 2 @ errors**2)),
            n_eff=float(weight.sum() ** 2 / (weight @ weight)),
            n_calls=sum(p.weighted.n_calls for p in self.particles),
            pareto_k=max(w.pareto_k for w in own),
            run=leader.run,
        )


def prior_posterior(kinds: Sequence[HypothesisKind], n_particles: int, *, rng: np.random.Generator) -> Posterior:
    """Return the posterior without readings: samples of every kind's prior, fewer for improbable kinds and rivals."""
    shares = [math.exp(kind.log_prior) for kind in kinds]
    sizes = [n_samples_of_kind(kind, p, n_particles) for kind, p in zip(kinds, shares, strict=True)]
    drawn = (prior_particles(kind.prior, n, rng=rng) for kind, n in zip(kinds, sizes, strict=True))
    return Posterior(tuple(kinds), tuple(drawn))


def n_samples_of_kind(kind: HypothesisKind, probability: float, n_particles: int) -> int:
    """Return the number of samples of a kind: fewer if improbable; for rivals at most half, but 100 or more."""
    if kind.left_out:
        return max(n_particles // next(part for least, part in SUSPECTED if probability >= least), 100)
    return n_particles if probability >= IMPROBABLE else n_particles // _FEWER


def _probabilities_of_log_odds(log_odds: FloatArray) -> FloatArray:
    """Return probabilities in the ratios of exp(log_odds), summing to one."""
    share = np.exp(log_odds - log_odds.max())
    return np.asarray(share / share.sum())
