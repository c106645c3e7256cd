"""Stopping rules: functions of a round's summary that return a reason to stop, or None to go on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from probewise.errors import ParameterError


@dataclass(frozen=True)
class RoundSummary:
    """Summary of a run after a round, passed to `progress` and to the stopping rule.

    `n_dead`, `n_calls`: dead points and likelihood evaluations so far. `log_z` counts the dead points only.
    `log_z_remaining` is the log of an upper bound on the live points' evidence: the best likelihood times the remaining
    volume; `log_ratio_remaining` is the log of that bound over the evidence so far. `last_change` is the increase of
    `log_z` by the last dead point; `log_volume` the log of the remaining share of the prior; `level` whether all live
    points have the same likelihood.
    """

    n_dead: int
    n_calls: int
    log_z: float
    log_z_remaining: float
    log_ratio_remaining: float
    last_change: float
    log_volume: float
    best_log_likelihood: float
    level: bool = False


StopRule: TypeAlias = Callable[[RoundSummary], "str | None"]


@dataclass(frozen=True)
class RemainingEvidence:
    """Stopping rule: the live points can raise log Z by less than `dlogz`; their contribution is added at the end."""

    dlogz: float = 0.05

    def __post_init__(self) -> None:
        if not 0 < self.dlogz < math.inf:
            raise ParameterError("dlogz", self.dlogz, "greater than 0, finite")

    def __call__(self, state: RoundSummary) -> str | None:
        """Return the reason to stop, or None."""
        excess = state.log_ratio_remaining
        gain = math.log1p(math.exp(excess)) if excess < 700 else excess
        return f"live points can raise log Z by less than {self.dlogz:g}" if gain < self.dlogz else None


_ON_PLATEAU = RemainingEvidence(0.05)


@dataclass(frozen=True)
class EvidenceChange:
    """Stopping rule of the paper: consecutive values of log Z differ by less than `tolerance`, 1e-8.

    On a plateau there is nothing to climb to: once all live points have the same likelihood and can raise log Z by less
    than 0.05, the rule ends the run too. Further deaths would leave copies of a few points.
    """

    tolerance: float = 1e-8

    def __post_init__(self) -> None:
        if not 0 < self.tolerance < math.inf:
            raise ParameterError("tolerance", self.tolerance, "greater than 0, finite")

    def __call__(self, state: RoundSummary) -> str | None:
        """Return the reason to stop, or None."""
        if state.last_change < self.tolerance:
            return f"consecutive values of log Z differ by less than {self.tolerance:g}"
        held = _ON_PLATEAU(state) if state.level else None
        return held and f"all live points have the same likelihood, and {held}"


NestedStop: TypeAlias = Literal["change", "remaining"]

NESTED_STOP: dict[NestedStop, StopRule] = {"change": EvidenceChange(), "remaining": RemainingEvidence()}
"""Rules by name: the paper's, a change of ln Z below 1e-8; and what remains, at most 0.05 of ln Z."""
