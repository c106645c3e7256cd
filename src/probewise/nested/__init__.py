"""Nested sampling: the evidence of a problem (a prior and a log likelihood) and samples of its posterior.

Paper, section 2.3 (50 posterior samples, made distinct by about 1000 Metropolis-Hastings steps) and section 2.7 (the
evidence Z, eq. 18; 300 live points; stop when consecutive values of log Z differ by less than 1e-8).
"""

from probewise.nested.diversify import diversify
from probewise.nested.importance import Weighted, pareto_k, refine, update
from probewise.nested.moves import KernelMove, Move, PriorRejection, SliceMove, Tally
from probewise.nested.problem import Bound, Evaluator, FunctionProblem, Points, Samplable, make_problem
from probewise.nested.result import Check, NestedResult, Samples, merge
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
