"""A hypothesis weighed twice: by Laplace's approximation and by nested sampling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Weighing", "with_agreement"]

A_NAT = 1.0


@dataclass(frozen=True)
class Weighing:
    """Log evidence of one hypothesis, both ways; the same model, priors and law of the noise.

    `effects` on the mean and on the noise, sorted; `n_gaussians` of the SSF; `error` of the nested run, one
    standard error; `doubts` are what that run has against itself.
    """

    effects: tuple[str, ...]
    n_gaussians: int
    laplace: float
    nested: float
    error: float
    doubts: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Its name."""
        return "+".join(self.effects) or "clean"

    @property
    def gap(self) -> float:
        """What nested sampling finds beyond Laplace, nats."""
        return self.nested - self.laplace

    @property
    def agree(self) -> bool:
        """Whether the two are within a nat, beyond the nested run's own error."""
        return abs(self.gap) <= A_NAT + self.error


def with_agreement(reason: str, weighings: Sequence[Weighing]) -> str:
    """Add to a sentence whether nested sampling agrees, and where not, by how much."""
    if not weighings:
        return reason
    apart = ", ".join(f"{w.label} by {w.gap:+.1f} nats".replace("-", "−") for w in weighings if not w.agree)
    if not apart:
        said = "nested sampling agrees within a nat"
    elif any(w.doubts for w in weighings):
        said = f"nested sampling would move {apart}, but doubts itself, so probabilities are left as they were"
    else:
        said = f"nested sampling moves {apart}, and the probabilities are by its evidence"
    return f"{reason.rstrip('.')}; {said}."
