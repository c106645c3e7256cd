"""Something unknown beside refitted candidates: how much it explains, and where it is pruned for a name."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field

import numpy as np
from scipy.special import logsumexp

from probewise.diagnosis.evidence.bank import Bank
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.evidence.screening import log_mean, score_unknown
from probewise.diagnosis.names import Names
from probewise.diagnosis.residuals.covariate import Covariate
from probewise.diagnosis.residuals.outlying import outlying, score_together
from probewise.diagnosis.search.constants import ALIASED_NATS
from probewise.diagnosis.search.noises import Noises
from probewise.diagnosis.search.weighed_fit import WeighedFit, out_of_vocabulary

__all__ = ["Unknown"]


@dataclass(eq=False)
class Unknown:
    """What bases that know no physics explain beside each candidate, under each of its noises.

    Parameters
    ----------
    bases
        Templates of the unknown.
    covariates
        Along which readings that are far out may lie together.
    noises
        The noise models.
    complexity_penalty
        The nats against it beside an SSF worth so many Gaussians.
    n_choices
        Log of how many more combinations there are of as many names as these than of one.
    """

    bases: Bank
    covariates: tuple[Covariate, ...]
    noises: Noises
    complexity_penalty: Callable[[int], float]
    log_z: dict[tuple[int, Names, Names], float] = field(default_factory=dict)
    """Log evidence by (order, mean, noise)."""
    shares: dict[str, float] = field(default_factory=dict)
    """How much of it each family of bases has, beside the null that it explains most beside."""
    n_choices: Callable[[Names], float] = lambda names: 0.0

    def weigh(self, candidates: Iterable[WeighedFit]) -> None:
        """Weigh it beside each candidate."""
        best = -np.inf
        for candidate in candidates:
            for noise, evidence in candidate.steering():
                by_family = score_unknown(Linearised.of(candidate.found, evidence.law), self.bases)
                if evidence.law.share > 0:
                    far_out = outlying(candidate.found.residuals, evidence.law)
                    by_family |= score_together(far_out, self.covariates)
                if not by_family:
                    continue
                value = evidence.log_z + log_mean(np.array(list(by_family.values())))
                if not candidate.names:
                    value -= self.complexity_penalty(candidate.degrees_of_freedom)
                self.log_z[candidate.n_gaussians, candidate.names, noise] = value
                if value > best and not candidate.names:
                    best = value
                    total = logsumexp(list(by_family.values()))
                    self.shares = {k: math.exp(v - total) for k, v in by_family.items()}

    def prune(self, candidates: Collection[WeighedFit]) -> None:
        """Leave it out, alone or beside a name, where a name more, or two, explain as much and leave nothing for it.

        A basis of many columns, what differs from scan to scan say, holds the traces of named effects too. Two names
        are chosen from many more combinations than one is: they have to explain as much more as that makes by chance.
        """
        named = [c for c in candidates if not out_of_vocabulary(c.names)]
        for known in {c.names for c in named if len(c.names) <= 1}:
            rivals = [c for c in named if set(c.names) > set(known) and len(c.names) <= 2]
            if any(key[1] == known for key in self.log_z) and self._explained(known, rivals, candidates):
                self.log_z = {key: value for key, value in self.log_z.items() if key[1] != known}

    def _explained(self, known: Names, rivals: Collection[WeighedFit], candidates: Collection[WeighedFit]) -> bool:
        """Tell whether a candidate makes as much of the readings as something unknown beside `known` does."""
        most = max((self._beside(c) for c in candidates if c.names == known), default=-np.inf)
        believed = {c: self._believed(c, len(known)) for c in rivals}
        for candidate in sorted(believed, key=lambda c: -believed[c]):
            if believed[candidate] < most - ALIASED_NATS:
                return False
            if self._beside(candidate) == -np.inf:
                self.weigh([candidate])
            if self._beside(candidate) - self._evidence(candidate) < ALIASED_NATS:
                return True
        return False

    def _believed(self, candidate: WeighedFit, n_known: int) -> float:
        several = len(candidate.names) - n_known > 1
        return self._evidence(candidate) - (self.n_choices(candidate.names) if several else 0.0)

    def _evidence(self, candidate: WeighedFit) -> float:
        return self.noises.over_all({noise: evidence.log_z for noise, evidence in candidate.evidence.items()})

    def _beside(self, candidate: WeighedFit) -> float:
        own = candidate.n_gaussians, candidate.names
        return self.noises.over_all({key[2]: value for key, value in self.log_z.items() if key[:2] == own})
