"""Backward elimination: drop each effect of the leading combinations in turn, and select forward from there."""

from __future__ import annotations

from probewise.diagnosis.names import Names
from probewise.diagnosis.search.constants import ELIMINATED, STEERING, SWAPPED
from probewise.diagnosis.search.forward_selection import promising, proposals_for
from probewise.diagnosis.search.state import SearchState
from probewise.diagnosis.search.weighed_fit import WeighedFit, out_of_vocabulary
from probewise.effects import AGAIN


def eliminate_backward(state: SearchState) -> None:
    """Refit the leading combinations without each of their effects in turn, and select forward from there.

    An effect selected first may be superfluous. Or it stood in for another one as well, and its variant (scans or
    place) suits neither.
    """
    several = sorted((c for c in state.candidates.values() if len(c.names) > 1), key=lambda c: -state.odds(c))
    named = [c for c in several if not out_of_vocabulary(c.names)]
    rest = [c for c in several if out_of_vocabulary(c.names)]
    # Of an effect that is there twice either may go; what stays is the first of its name.
    dropped = [(c.names, n) for c in [*named[:ELIMINATED], *rest[:1]] for n in c.names if n + AGAIN not in c.names]
    for k, (names, left_out) in enumerate(dropped):
        state.progress("leaving effects out in turn", k, len(dropped))
        others = tuple(name for name in names if name != left_out)
        if others not in state.refitted | state.undetected:
            state.reach(others)
        for candidate in state.of(names):
            state.refit_without(candidate, left_out)
        held = state.of(others)
        if held:
            _select_again(state, max(held, key=lambda c: c.log_z), names)


def _select_again(state: SearchState, held: WeighedFit, names: Names) -> None:
    """Extend a candidate to these names, and by the effects that lead beside it."""
    proposals = proposals_for(state, held, {})
    chosen = [names, *promising(state, proposals, width=SWAPPED, behind=STEERING)[:SWAPPED]]
    for added in [proposals[key].added for key in chosen if key in proposals]:
        if (held, added) not in state.extended:
            state.refit(held, added)
