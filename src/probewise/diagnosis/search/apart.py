"""Take leading combinations apart, and grow them again from what is left."""

from __future__ import annotations

from probewise.diagnosis.search.growing import wishes_of, worth_refitting
from probewise.diagnosis.search.pool import Pool
from probewise.diagnosis.search.weighed import STEERING, Candidate, outside

__all__ = ["take_apart"]

Names = tuple[str, ...]

_TAKEN_APART = 3  # leading combinations, of which each effect is left out in turn
_SWAPPED = 2  # that lead beside what is left, what was left out or another


def take_apart(pool: Pool) -> None:
    """Refit the leading combinations less one effect, and grow them again from there.

    What screening put first may be superfluous, or have stood for another effect while there was but one. And the
    scans that an effect is bound to, or the place it is at, were chosen while it stood for both.
    """
    several = sorted((c for c in pool.candidates.values() if len(c.names) > 1), key=lambda c: -pool.odds(c))
    named, rest = [c for c in several if not outside(c.names)], [c for c in several if outside(c.names)]
    for candidate in [*named[:_TAKEN_APART], *rest[:1]]:
        for left_out in candidate.names:
            others = tuple(name for name in candidate.names if name != left_out)
            if others not in pool.refitted | pool.not_felt:
                pool.reach(others)
            held = pool.of(others)
            if held:
                _grow_again(pool, max(held, key=lambda c: c.log_z), candidate.names)


def _grow_again(pool: Pool, held: Candidate, names: Names) -> None:
    """Refit a candidate with what makes it these names, and with what leads beside it."""
    wishes = wishes_of(pool, held, {})
    chosen = [names, *worth_refitting(pool, wishes, width=_SWAPPED, behind=STEERING)[:_SWAPPED]]
    for added in [wishes[key].added for key in chosen if key in wishes]:
        if (held, added) not in pool.grown:
            pool.refit(held, added)
