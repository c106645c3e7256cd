"""The evidence of a hypothesis by both methods: Laplace's approximation and nested sampling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from probewise.effects import name_without_copy_suffix

A_NAT = 1.0


@dataclass(frozen=True)
class Weighing:
    """Log evidence of one hypothesis by both methods, with the same model, priors and noise.

    `effects` on the mean and on the noise, sorted; `n_gaussians` of the SSF; `laplace` and `nested`: the log evidences
    in nats; `error`: standard error of `nested`; `doubts`: warnings of the nested runs.
    """

    effects: tuple[str, ...]
    n_gaussians: int
    laplace: float
    nested: float
    error: float
    doubts: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Effects joined by "+", or "clean"."""
        return "+".join(sorted(map(name_without_copy_suffix, self.effects))) or "clean"

    @property
    def gap(self) -> float:
        """Log evidence by nested sampling minus that by Laplace, in nats."""
        return self.nested - self.laplace

    @property
    def agree(self) -> bool:
        """Whether the two log evidences differ by at most a nat plus one standard error of nested sampling."""
        return abs(self.gap) <= A_NAT + self.error


def sentence_with_agreement(reason: str, weighings: Sequence[Weighing]) -> str:
    """Extend a verdict's reason by whether nested sampling agrees, by how many nats not, and its first warning."""
    if not weighings:
        return reason
    apart = ", ".join(f"{w.label} by {_signed(w.gap)} nats" for w in weighings if not w.agree)
    doubt = next((f"{w.label}: {doubt}" for w in weighings for doubt in w.doubts), None)
    if not apart:
        said = "nested sampling agrees to within a nat plus its standard error"
    elif doubt is not None:
        said = f"nested sampling would move {apart}, and probabilities are left as they were"
    else:
        said = f"nested sampling moves {apart}, and the probabilities are by its evidence"
    return f"{reason.rstrip('.')}; {said}{'' if doubt is None else f', but its runs gave a warning ({doubt})'}."


def _signed(nats: float) -> str:
    return f"{nats:+.1f}".replace("-", "−")
