"""The calibration of each order, that is of each number of Gaussians, as an inference problem."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from probewise._arrays import IntArray
from probewise.calibration.deduplicated_model import DeduplicatedModel
from probewise.calibration.priors import SSFPrior
from probewise.errors import ParameterError, ShapeError
from probewise.inference import SensorProblem, student_t_of
from probewise.recordings import Recording
from probewise.scene import KnownScene
from probewise.sensor import FAST_NODES, Chain, FreeLevels, FreeMixture


@dataclass(frozen=True, eq=False)
class ProblemsByOrder:
    """A recording, the prior of each order, and which readings share a noise sd.

    `data_sets`: of each row, see `problem_for`; None for one per scan.
    """

    recording: Recording
    prior: Callable[[Recording, int], SSFPrior]
    data_sets: IntArray | None = None

    def prior_of(self, n_gaussians: int) -> SSFPrior:
        """Return the prior of an order; ParameterError if it is no `SSFPrior`."""
        found = self.prior(self.recording, n_gaussians)
        if not isinstance(found, SSFPrior):
            raise ParameterError("prior", found, "an SSFPrior")
        return found

    def problem(self, n_gaussians: int, *, n_nodes: int = FAST_NODES) -> SensorProblem:
        """Return the inference problem of an order, with `n_nodes` quadrature nodes over curved edges."""
        return problem_for(self.recording, self.prior_of(n_gaussians), data_sets=self.data_sets, n_nodes=n_nodes)


def problem_for(
    recording: Recording, prior: SSFPrior, *, data_sets: IntArray | None = None, n_nodes: int = FAST_NODES
) -> SensorProblem:
    """Make the inference problem of one order: a chain over known patterns, Student-t with one sigma per data set.

    Parameters
    ----------
    recording
        The readings.
    prior
        Prior of the order's parameters.
    data_sets
        Data set of each row, (n_points,) from 0, else ShapeError; default: its scan.
    n_nodes
        Quadrature nodes over curved edges. By default the error there, 1e-4 of I_max - I_min, is below a tenth of the
        least noise sd of the prior.
    """
    plan = recording.plan
    groups = plan.scan if data_sets is None else np.asarray(data_sets)
    if groups.shape != (len(plan),):
        raise ShapeError(f"data_sets have shape {groups.shape}; allowed: ({len(plan)},), one per row")
    chain = Chain(FreeMixture(prior.n_gaussians), FreeLevels(), KnownScene(plan.patterns), n_nodes=n_nodes)
    return SensorProblem(prior, DeduplicatedModel(chain, plan), student_t_of(recording, groups), recording)
