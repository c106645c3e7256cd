"""Global test of the most probable null's mean, corrected for multiple comparisons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.convergence import require_converged_fit
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.names import Names
from probewise.diagnosis.residuals.locate import bayes_factor_p_value
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import WeighedFit

N_DRAWS = 999
"""Number of residual draws under the null."""

_NO_ALARM = 0.05  # p-value above which no alarm is possible, so that other forms of the SSF need no test


@dataclass(frozen=True, eq=False)
class GlobalTest:
    """Result of the global test of the null: p-value, and the most probable noise, names of its effects.

    `problem` is the fit linearised under that noise; `draws` (n_rows, 999) are projected residuals under the null.
    """

    null: WeighedFit
    noise: Names
    problem: Linearised
    draws: FloatArray
    p_value: float


def run_global_test(searched: Searched, *, rng: np.random.Generator) -> GlobalTest:
    """Test whether effects are missing in the mean of the null; the p-value is 1 where all readings are equal.

    Raises
    ------
    NotConvergedError
        If the fit of the null did not converge, with enough readings to tell.
    """
    prepared, null, noise = searched.prepared, searched.null, searched.posterior.likeliest_noise()
    problem = Linearised.of(null.found, null.evidence[null.possible_noise(noise)].likeliest_law)
    if not prepared.has_too_little_data:
        require_converged_fit(null.found, Linearised.of(null.found, null.law))
    draws = problem.draw_null_residuals(N_DRAWS, rng=rng)
    p_value = bayes_factor_p_value(problem, searched.template_banks_for_global_test(null.found), draws)
    p_value = _max_p_value_over_orders(searched, null, noise, p_value, rng=rng)
    # Constant readings have no noise to compare a residual with.
    return GlobalTest(null, noise, problem, draws, 1.0 if prepared.has_only_equal_readings else p_value)


def _max_p_value_over_orders(
    searched: Searched, null: WeighedFit, noise: Names, p_value: float, *, rng: np.random.Generator
) -> float:
    """Return the largest p-value over the SSF's order (number of Gaussians) and higher ones, and with fine structure.

    The evidence accepts another Gaussian only if it gains ten nats or more; a smaller misfit of an SSF that is no
    mixture is not physics. So an alarm must hold at every order, and with fine structure about the freest form. Once a
    p-value exceeds .05, the rest is not tested.
    """
    prepared, fits = searched.prepared, searched.evidences.fits
    rivals = [fits[n, ()] for n in sorted(n for n, names in fits if not names and n > null.n_gaussians)]
    asked = [(rival, False) for rival in rivals]
    if prepared.null is None:  # a known prior is kept at every order: an orientation error shows only relative to it
        asked.append(((rivals or [null])[-1], True))
    for rival, fine in asked:
        if p_value > _NO_ALARM:
            break
        found = rival.found
        beside = prepared.apparatus.fine_structure_slopes(found, prepared.usable_rows) if fine else None
        problem = Linearised.of(found, rival.evidence[rival.possible_noise(noise)].likeliest_law, beside)
        draws = problem.draw_null_residuals(N_DRAWS, rng=rng)
        p_value = max(p_value, bayes_factor_p_value(problem, searched.template_banks_for_global_test(found), draws))
    return p_value
