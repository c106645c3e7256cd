"""Check by one search of the whole prior that an SMC run missed no peak: nested sampling with few live points.

An SMC run (sequential Monte Carlo, a climb) starts at the peaks that least squares found, so it may miss a peak with a
small basin. A search needs no start. With few live points its evidence is rough, but its samples show where the
posterior lies. The SMC run missed a part if many samples of the search lie far from all of its own, or if the search's
evidence is higher than the errors allow.
"""

from __future__ import annotations

import warnings

import numpy as np

from probewise._arrays import FloatArray
from probewise.calibration.order_problems import ProblemsByOrder
from probewise.calibration.order_search import Progress, round_reporter
from probewise.calibration.smc import SMCResult
from probewise.errors import DoubtfulResultWarning
from probewise.nested import NestedResult, run

_LEAST_LIVE, _LIVE_PER_PARAM = 50, 4
# One false alarm in 30,000 where the errors are normal.
_N_ERRORS = 4.0
# A part is missed where it holds this share of the search's samples.
_MISSED = 0.2
_N_SAMPLES, _N_OWN, _N_OTHERS = 300, 500, 2000


def search_for_missed_part(
    problems: ProblemsByOrder, n: int, climbed: SMCResult, *, rng: np.random.Generator, progress: Progress | None = None
) -> str:
    """Search the prior of `n` Gaussians, and describe in words what the SMC run `climbed` missed; "" if nothing.

    `problems`: of the recording, by order. `progress` is called after each round of the search.
    """
    problem = problems.problem(n)
    n_live = max(_LEAST_LIVE, _LIVE_PER_PARAM * len(problem.prior.names))
    report = None if progress is None else round_reporter(progress, n)
    with warnings.catch_warnings():
        # So few live points are rough, which is known; nobody sees this run.
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        found = run(problem, rng=rng, n_live=n_live, progress=report, max_cost=1.0, return_interrupted=False)
    return _missed_part_by_comparison_in_words(problems, n, climbed, found, rng)


def _missed_part_by_comparison_in_words(
    problems: ProblemsByOrder, n: int, climbed: SMCResult, found: NestedResult, rng: np.random.Generator
) -> str:
    error = float(np.hypot(found.log_z_error, climbed.log_z_error))
    if found.log_z - climbed.log_z > _N_ERRORS * error:
        return (
            f"ln Z is {found.log_z:.2f} ± {found.log_z_error:.2f} by a search of the whole prior, "
            f"{climbed.log_z:.2f} ± {climbed.log_z_error:.2f} by the quick way"
        )
    coordinates = problems.prior_of(n).coordinates
    share = share_far_from_known(
        coordinates.enter(climbed.theta), coordinates.enter(found.samples(_N_SAMPLES, rng=rng)), rng=rng
    )
    if share > _MISSED:
        return f"{share:.0%} of the samples of a search of the whole prior lie apart from those of the quick way"
    return ""


def share_far_from_known(known: FloatArray, asked: FloatArray, *, rng: np.random.Generator) -> float:
    """Return the share of samples `asked`, (m, d), that lie far from the samples `known`, (n, d), ordered by cloud.

    The distance is to the nearest of at most 2,000 known samples, drawn without the first 500, in the covariance of the
    known ones. Far is a greater distance than that of any of the first 500.
    """
    from scipy.spatial.distance import cdist  # slow to import, and needed by calibrations only

    own, others = known[:_N_OWN], known[_N_OWN:]
    others = others[rng.permutation(len(others))[:_N_OTHERS]]
    root = np.linalg.cholesky(np.cov(known, rowvar=False))
    own, others, asked = (np.linalg.solve(root, part.T).T for part in (own, others, asked))
    furthest = cdist(own, others).min(axis=1).max()
    return float((cdist(asked, others).min(axis=1) > furthest).mean())
