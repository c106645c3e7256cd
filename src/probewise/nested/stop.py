"""Say when a run is done: rules that look at its state and give a reason, or None to go on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from probewise.errors import ParameterError

__all__ = ["EvidenceChange", "RemainingEvidence", "State", "StopRule"]


@dataclass(frozen=True)
class State:
    """Show how far a run has come; handed to `progress` and to the stop rule after every round.

    `log_z` counts the dead points alone; `log_z_remaining` is the most that the live points can
    add, the best likelihood times the volume left, and `log_ratio_remaining` the log of its ratio to what
    `log_z` counts; `last_change` is what the last dead point added to `log_z`; `log_volume` the log share
    of the prior still alive.
    """

    n_dead: int
    n_calls: int
    log_z: float
    log_z_remaining: float
    log_ratio_remaining: float
    last_change: float
    log_volume: float
    best_log_likelihood: float


StopRule: TypeAlias = Callable[[State], "str | None"]


@dataclass(frozen=True)
class RemainingEvidence:
    """Stop when the live points can raise log Z by less than `dlogz` (their own share is added at the end)."""

    dlogz: float = 0.05

    def __post_init__(self) -> None:
        if not 0 < self.dlogz < math.inf:
            raise ParameterError("dlogz", self.dlogz, "greater than 0, finite")

    def __call__(self, state: State) -> str | None:
        """Give the reason, or None."""
        excess = state.log_ratio_remaining
        gain = math.log1p(math.exp(excess)) if excess < 700 else excess
        return f"live points can raise log Z by less than {self.dlogz:g}" if gain < self.dlogz else None


@dataclass(frozen=True)
class EvidenceChange:
    """Stop when consecutive values of log Z differ by less than `tolerance`: the paper's rule, 1e-8."""

    tolerance: float = 1e-8

    def __post_init__(self) -> None:
        if not 0 < self.tolerance < math.inf:
            raise ParameterError("tolerance", self.tolerance, "greater than 0, finite")

    def __call__(self, state: State) -> str | None:
        """Give the reason, or None."""
        if state.last_change < self.tolerance:
            return f"consecutive values of log Z differ by less than {self.tolerance:g}"
        return None
