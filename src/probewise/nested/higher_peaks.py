"""Look above the end of a run for a narrow peak that no live point met.

A run ends where its live points can no longer raise log Z, if the likelihood goes on as before. A narrow peak on a
broad one (a phase transition, Skilling 2006) can hold most of the posterior and rise above the broad peak only tens of
nats further up, where no live point has been. Draws about the top of the broad peak need no chains and can meet the
flank of the narrow one. A draw higher than the top belongs to another peak, which is climbed.
"""

from __future__ import annotations

import numpy as np

from probewise.nested.ascent import GaussianAtPeak, climb_to_top
from probewise.nested.evaluate import Evaluator, Points
from probewise.nested.result import NestedResult
from probewise.nested.space import within_bounds_mask

_HIGHER = 0.2  # nats by which a draw lies above the known top, so that it belongs to another peak
_SCALES = (1.5, 1.2, 0.95)  # of the draws, in sds at the top
_PER_LIVE = 0.1  # draws of a scale, for each live point and each parameter squared: a cone is the rarer, the more
_MOST_SHARE = 1 / 8  # of the run's evaluations, for these draws
_MOST_PEAKS = 5


def find_higher_peaks(
    run: NestedResult, top: GaussianAtPeak, evaluate: Evaluator, *, max_calls: int, rng: np.random.Generator
) -> list[GaussianAtPeak]:
    """Look for peaks higher than `top`, the peak on which a run ended; return the top of each, the highest last.

    `evaluate`: the run's problem, whose prior has `to_unit_cube` or coordinates of its own; it counts the evaluations,
    at most `max_calls`. Without a higher peak at most an eighth of the run's are used.
    """
    n_params, most = len(evaluate.names), evaluate.n_calls + max_calls
    wanted = run.n_live * max(_PER_LIVE * n_params**2, 1.0)
    n_draws = int(min(wanted, min(max_calls, _MOST_SHARE * run.n_calls) / len(_SCALES)))
    if n_draws < run.n_live:
        return []
    peaks = list[GaussianAtPeak]()
    # Of several peaks of about one height the climb took one, and the run knows the others.
    known = max(top.highest_log_likelihood, float(run.log_likelihood.max()))
    scale = np.repeat(_SCALES, n_draws)[:, None]
    tried = top.centre + scale * rng.standard_normal((scale.size, n_params)) @ top.root.T
    drawn = evaluate(tried[within_bounds_mask(evaluate.space, tried)], rng)
    if top.met is not None:
        drawn = Points.join(drawn, top.met)
    for _ in range(_MOST_PEAKS):
        best = drawn.take_rows(drawn.rows_by_rising_likelihood()[-1:])
        if not len(best) or not best.log_likelihood[0] > known + _HIGHER:
            break
        peak = climb_to_top(
            GaussianAtPeak(best, best.u[0], top.root),
            evaluate,
            max_calls=most - evaluate.n_calls,
            rng=rng,
            known=known + _HIGHER,
        )
        peaks.append(peak)
        known = max(known, peak.highest_log_likelihood)
    return peaks
