"""Unknown effects in addition to candidates: their evidence, and their removal in favour of named effects."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.bank import TemplateBank
from probewise.diagnosis.evidence.screening import log_mean_exp
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.names import Names
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.diagnosis.residuals.covariate import Covariate
from probewise.diagnosis.residuals.outlying import clustering_log_bayes_factors, outlier_probabilities
from probewise.diagnosis.search.constants import ALIASED_NATS
from probewise.diagnosis.search.noises import NoiseModels
from probewise.diagnosis.search.weighed_fit import WeighedFit, effects_out_of_vocabulary


@dataclass(eq=False)
class UnknownEffects:
    """Evidence of an unknown effect, by basis functions, added to candidates, under each of their leading noise models.

    Parameters
    ----------
    scores
        Function of a fit, a noise distribution and a bank: log Bayes factors of its templates, by label.
    bases
        Bank of the basis functions.
    covariates
        Covariates in which outlying readings may cluster.
    noises
        The noise models.
    complexity_penalty
        Function of the degrees of freedom of an SSF: penalty in nats of an unknown effect added to the null.
    log_n_choices
        Function of names: log of the number of combinations of this size, relative to single names.
    """

    scores: Callable[[Fit, NoiseLaw, TemplateBank], Mapping[str, FloatArray]]
    bases: TemplateBank
    covariates: tuple[Covariate, ...]
    noises: NoiseModels
    complexity_penalty: Callable[[int], float]
    log_z: dict[tuple[int, Names, Names], float] = field(default_factory=dict)
    """Log evidence by (order, mean, noise)."""
    shares: dict[str, float] = field(default_factory=dict)
    """Share of each family of bases, beside the null with the largest evidence of an unknown effect."""
    log_n_choices: Callable[[Names], float] = lambda names: 0.0

    def weigh_beside(self, candidates: Iterable[WeighedFit]) -> None:
        """Compute and store (`log_z`) the log evidence of each candidate with an unknown effect added."""
        best = -np.inf
        for candidate in candidates:
            for noise, evidence in candidate.leading_noises():
                scores = self.scores(candidate.found, evidence.likeliest_law, self.bases)
                by_family = {family: log_mean_exp(own) for family, own in scores.items()}
                if evidence.likeliest_law.share > 0:
                    far_out = outlier_probabilities(candidate.found.residuals, evidence.likeliest_law)
                    by_family |= clustering_log_bayes_factors(far_out, self.covariates)
                if not by_family:
                    continue
                value = evidence.log_z + log_mean_exp(np.array(list(by_family.values())))
                if not candidate.names:
                    value -= self.complexity_penalty(candidate.ssf_degrees_of_freedom)
                self.log_z[candidate.n_gaussians, candidate.names, noise] = value
                if value > best and not candidate.names:
                    best = value
                    total = logsumexp(list(by_family.values()))
                    self.shares = {k: math.exp(v - total) for k, v in by_family.items()}

    def drop_superfluous(self, candidates: Collection[WeighedFit]) -> None:
        """Drop an unknown effect, alone or with one named effect, if one or two more named effects explain as much.

        An unknown effect added to the named ones must then be insignificant. A basis of many columns, such as one value
        per scan, can imitate named effects. Two names are chosen from many more combinations than one, so they must
        explain correspondingly more.
        """
        named = [c for c in candidates if not effects_out_of_vocabulary(c.names)]
        for known in dict.fromkeys(c.names for c in named if len(c.names) <= 1):
            rivals = [c for c in named if set(c.names) > set(known) and len(c.names) <= 2]
            if any(key[1] == known for key in self.log_z) and self._is_superfluous(known, rivals, candidates):
                self.log_z = {key: value for key, value in self.log_z.items() if key[1] != known}

    def _is_superfluous(self, known: Names, rivals: Collection[WeighedFit], candidates: Collection[WeighedFit]) -> bool:
        """Return whether one of the `rivals` makes an unknown effect added to `known` superfluous.

        The rival's evidence is at most three nats lower, and an unknown effect adds less than three to it.
        """
        most = max((self._log_evidence_with_unknown(c) for c in candidates if c.names == known), default=-np.inf)
        believed = {c: self._log_evidence_less_choices(c, len(known)) for c in rivals}
        for candidate in sorted(believed, key=lambda c: -believed[c]):
            if believed[candidate] < most - ALIASED_NATS:
                return False
            if self._log_evidence_with_unknown(candidate) == -np.inf:
                self.weigh_beside([candidate])
            if (
                self._log_evidence_with_unknown(candidate) - self._log_evidence_without_unknown(candidate)
                < ALIASED_NATS
            ):
                return True
        return False

    def _log_evidence_less_choices(self, candidate: WeighedFit, n_known: int) -> float:
        several = len(candidate.names) - n_known > 1
        return self._log_evidence_without_unknown(candidate) - (self.log_n_choices(candidate.names) if several else 0.0)

    def _log_evidence_without_unknown(self, candidate: WeighedFit) -> float:
        return self.noises.average_log_evidence(
            {noise: evidence.log_z for noise, evidence in candidate.evidence.items()}
        )

    def _log_evidence_with_unknown(self, candidate: WeighedFit) -> float:
        own = candidate.n_gaussians, candidate.names
        return self.noises.average_log_evidence({key[2]: value for key, value in self.log_z.items() if key[:2] == own})
