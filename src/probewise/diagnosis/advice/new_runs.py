"""Parameters with a value of their own in each run: of a run yet to be recorded, only their prior is known."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.recordings.plan import Plan


def slopes_split_by_run(slopes: FloatArray, of_run: IntArray, plan: Plan) -> tuple[FloatArray, FloatArray]:
    """Split slopes of planned readings into those by values already fitted, and those by values of the new runs.

    A planned run is predicted at the values of a recorded run, by whose coordinates the slopes are.

    Parameters
    ----------
    slopes
        Slopes by a model's coordinates, (n_points, n_params).
    of_run
        Indices of the coordinates of which each run has a value of its own, with a standard normal prior.
    plan
        The planned runs, (n_points,).

    Returns
    -------
    The slopes with 0 in the columns `of_run`, (n_points, n_params); and, for each run and each of these columns that
    acts there, a column that is 0 in all other runs, (n_points, n_columns).
    """
    shared = slopes.copy()
    shared[:, of_run] = 0.0
    if not of_run.size:
        return shared, np.zeros((len(slopes), 0))
    inside = plan.scan[:, None] == np.arange(len(plan.scan_names))  # (n_points, n_runs)
    own = (inside[:, :, None] * slopes[:, None, of_run]).reshape(len(slopes), -1)
    return shared, own[:, np.any(own != 0, axis=0)]
