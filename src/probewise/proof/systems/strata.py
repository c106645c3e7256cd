"""The strata of a challenge on systems: half of the cases are clean."""

from __future__ import annotations

from probewise.proof.sensors.strata import Stratum

SYSTEMS_WHEEL: tuple[Stratum, ...] = (
    *[Stratum("clean")] * 6,
    *[Stratum("clean", other_noise=True)] * 4,
    Stratum("single", 6.0),
    *[Stratum("single", 8.0)] * 2,
    *[Stratum("single", 12.0)] * 2,
    Stratum("single", 20.0),
    *[Stratum("pair", 12.0)] * 2,
    *[Stratum("outside", 20.0)] * 2,
)
"""Twenty cycles are 400 cases."""

_STRIDE = 7  # coprime to the length of the cycle, so that successive cases differ in kind


def system_stratum_of(number: int) -> tuple[Stratum, int]:
    """Return the stratum of case `number`, and how many earlier cases have its kind and `other_noise`, at any size."""
    order = [SYSTEMS_WHEEL[k * _STRIDE % len(SYSTEMS_WHEEL)] for k in range(len(SYSTEMS_WHEEL))]

    def have_same_kind_and_noise(a: Stratum, b: Stratum) -> bool:
        return (a.kind, a.other_noise) == (b.kind, b.other_noise)

    turn, slot = divmod(number, len(order))
    own = order[slot]
    return own, turn * sum(have_same_kind_and_noise(s, own) for s in order) + sum(
        have_same_kind_and_noise(s, own) for s in order[:slot]
    )
