"""Nested sampling: the evidence of a problem (a prior and a log likelihood) and samples of its posterior.

After the paper's sections "The Machine Learning System" (50 posterior samples, made distinct by about 1000
Metropolis-Hastings steps) and on estimating the parameters of the spatial sensitivity function (the evidence Z; stop
when successive values of log Z agree).
"""

from probewise.nested.diversify import diversify
from probewise.nested.importance import Weighted, pareto_k, refine, update
from probewise.nested.merge import merge
from probewise.nested.moves import KernelMove, Move, PriorRejection, SliceMove, Tally
from probewise.nested.problem import Bound, Evaluator, FunctionProblem, Points, Samplable, make_problem
from probewise.nested.result import Agreement, Check, NestedResult, Samples
from probewise.nested.sampler import (
    LIVE_PER_PARAM,
    NESTED_STOP,
    EvidenceChange,
    NestedStop,
    RemainingEvidence,
    RoundSummary,
    StopRule,
    least_live,
    run,
)

__all__ = [
    "LIVE_PER_PARAM",
    "NESTED_STOP",
    "Agreement",
    "Bound",
    "Check",
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
    "RoundSummary",
    "Samplable",
    "Samples",
    "SliceMove",
    "StopRule",
    "Tally",
    "Weighted",
    "diversify",
    "least_live",
    "make_problem",
    "merge",
    "pareto_k",
    "refine",
    "run",
    "update",
]
