"""The strata of a challenge: kinds and sizes of cases, in a repeating cycle of 60."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

CaseKind: TypeAlias = Literal["clean", "single", "pair", "outside", "alias", "ssf_order"]
"""What a case conceals: nothing, one effect, two, one out of vocabulary, an aliased one, or one more Gaussian."""


@dataclass(frozen=True)
class Stratum:
    """A case's kind (`CaseKind`), lambda of each effect (0 for clean), and whether its noise is one of OTHER_NOISE."""

    kind: CaseKind
    size: float = 0.0
    other_noise: bool = False


WHEEL: tuple[Stratum, ...] = (
    *[Stratum("clean")] * 20,
    *[Stratum("clean", other_noise=True)] * 5,
    *[Stratum("single", 8.0)] * 12,
    Stratum("single", 8.0, other_noise=True),
    *[Stratum("single", 5.0)] * 2,
    *[Stratum("single", 6.0)] * 2,
    *[Stratum("single", 12.0)] * 3,
    *[Stratum("single", 20.0)] * 5,
    *[Stratum("pair", 12.0)] * 3,
    *[Stratum("outside", 12.0)] * 3,
    *[Stratum("outside", 20.0)] * 2,
    Stratum("alias", 12.0),
    Stratum("ssf_order", 12.0),
)
"""The cycle of 60 cases. A hundred cycles have 2,500 clean cases (500 of them with other noise), 2,500 of one effect
(1,300 at lambda 8, of these 100 with other noise; 500 at 20), 300 pairs, 500 outside the vocabulary, 100 aliases and
100 with one more Gaussian.
"""

_STRIDE = 23  # coprime to the length of the cycle, so that successive cases differ in kind


def stratum_of(number: int) -> tuple[Stratum, int]:
    """Return the stratum of case `number`, and how many cases of that stratum have smaller numbers."""
    cycle, slot = divmod(number, len(WHEEL))
    order = [WHEEL[k * _STRIDE % len(WHEEL)] for k in range(len(WHEEL))]
    stratum = order[slot]
    return stratum, cycle * order.count(stratum) + order[:slot].count(stratum)
