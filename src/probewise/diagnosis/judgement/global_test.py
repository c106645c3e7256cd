"""Is anything missing from the mean? The null that is most believed, and its test, every look counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.convergence import require_converged
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.names import Names
from probewise.diagnosis.residuals.locate import global_p_value
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import WeighedFit

__all__ = ["N_DRAWS", "GlobalTest", "run_global_test"]

N_DRAWS = 999
"""Residuals drawn under the null."""

_NO_ALARM = 0.05  # by any rule, so that no other form of the SSF need be asked


@dataclass(frozen=True, eq=False)
class GlobalTest:
    """The null under the most probable noise model, as a linear problem, residuals drawn under it, and its p-value."""

    null: WeighedFit
    noise: Names
    problem: Linearised
    draws: FloatArray
    p_value: float


def run_global_test(searched: Searched, *, rng: np.random.Generator) -> GlobalTest:
    """Test that nothing is missing from the mean.

    Raises
    ------
    NotConvergedError
        If the fit of the null has not arrived anywhere, where there are readings enough to say so.
    """
    prepared, null, noise = searched.prepared, searched.null, searched.posterior.noise()
    problem = Linearised.of(null.found, null.evidence[noise].law)
    if not prepared.too_little:
        require_converged(null.found, Linearised.of(null.found, null.law))
    draws = problem.draws(N_DRAWS, rng=rng)
    p_value = global_p_value(problem, searched.looks(null.found), draws)
    p_value = _at_every_order(searched, null, noise, p_value, rng=rng)
    # Readings that never change carry no noise to measure a residual by.
    return GlobalTest(null, noise, problem, draws, 1.0 if prepared.constant else p_value)


def _at_every_order(
    searched: Searched, null: WeighedFit, noise: Names, p_value: float, *, rng: np.random.Generator
) -> float:
    """Ask whether an alarm stands, be the SSF of the null's order, of a greater one, or finer still.

    The evidence grants a Gaussian only where it gains the ten nats and more that it costs; what an SSF that is no
    mixture leaves below that is no physics. So an alarm must stand at every order, and beside fine structure about
    the freest, and the greatest p-value counts.
    """
    prepared, fits = searched.prepared, searched.evidences.fits
    rivals = [fits[n, ()] for n in sorted(n for n, names in fits if not names and n > null.n_gaussians)]
    asked = [(rival, False) for rival in rivals]
    if prepared.null is None:  # what is known is not forgotten: that it was turned shows by that alone
        asked.append(((rivals or [null])[-1], True))
    for rival, fine in asked:
        if p_value > _NO_ALARM:
            break
        found = rival.found
        beside = prepared.apparatus.fine_structure(found, prepared.usable) if fine else None
        problem = Linearised.of(found, rival.evidence[noise].law, beside)
        draws = problem.draws(N_DRAWS, rng=rng)
        p_value = max(p_value, global_p_value(problem, searched.looks(found), draws))
    return p_value
