"""Nested sampling: the evidence of a problem (a prior and a log likelihood) and samples of its posterior.

After the paper's sections "The Machine Learning System" (50 posterior samples, made distinct by about 1000
Metropolis-Hastings steps) and on estimating the parameters of the spatial sensitivity function (the evidence Z; stop
when successive values of log Z agree).
"""

from probewise.nested.dead_points import DeadPoints
from probewise.nested.diversify import DiversifyTally, diversify
from probewise.nested.evaluate import Bound, Evaluator, Points, Samplable
from probewise.nested.function_problem import FunctionProblem, make_problem
from probewise.nested.genealogy import relative_lineage_variance
from probewise.nested.importance import Weighted, pareto_k, update
from probewise.nested.kernels import KernelMove
from probewise.nested.merging import agreement_of, merge, n_alive_at_death
from probewise.nested.moves import Move, PriorRejection, SliceMove, Tally
from probewise.nested.refine import refine
from probewise.nested.repartition import Repartitioned, repartitioned
from probewise.nested.result import Agreement, Check, NestedResult
from probewise.nested.run import run
from probewise.nested.sampler import LIVE_PER_PARAM, least_live, replace_worst_live_points
from probewise.nested.stop import (
    NESTED_STOP,
    EvidenceChange,
    NestedStop,
    RemainingEvidence,
    RoundSummary,
    StopRule,
)
from probewise.nested.weighted_samples import WeightedSamples

__all__ = [
    "LIVE_PER_PARAM",
    "NESTED_STOP",
    "Agreement",
    "Bound",
    "Check",
    "DeadPoints",
    "DiversifyTally",
    "Evaluator",
    "EvidenceChange",
    "FunctionProblem",
    "KernelMove",
    "Move",
    "NestedResult",
    "NestedStop",
    "Points",
    "PriorRejection",
    "RemainingEvidence",
    "Repartitioned",
    "RoundSummary",
    "Samplable",
    "SliceMove",
    "StopRule",
    "Tally",
    "Weighted",
    "WeightedSamples",
    "agreement_of",
    "diversify",
    "least_live",
    "make_problem",
    "merge",
    "n_alive_at_death",
    "pareto_k",
    "refine",
    "relative_lineage_variance",
    "repartitioned",
    "replace_worst_live_points",
    "run",
    "update",
]
