"""Backward elimination: refit the leading combinations without each effect in turn, and extend what remains."""

from __future__ import annotations

from probewise.diagnosis.names import Names
from probewise.diagnosis.search.constants import ELIMINATED, STEERING, SWAPPED
from probewise.diagnosis.search.forward_selection import promising_combinations, proposals_for
from probewise.diagnosis.search.state import SearchState
from probewise.diagnosis.search.weighed_fit import WeighedFit, effects_out_of_vocabulary
from probewise.effects import AGAIN


def eliminate_backward(state: SearchState) -> None:
    """Refit the leading combinations without each of their effects in turn, and extend what remains by other effects.

    An effect selected first may be superfluous. Or it stood in for two effects, and its variant (scans or parameters)
    suits neither. Candidates are stored in the state.
    """
    several = sorted((c for c in state.candidates.values() if len(c.names) > 1), key=lambda c: -state.log_posterior(c))
    named = [c for c in several if not effects_out_of_vocabulary(c.names)]
    rest = [c for c in several if effects_out_of_vocabulary(c.names)]
    # Of an effect that is there twice either may go; what stays is the first of its name.
    dropped = [(c.names, n) for c in [*named[:ELIMINATED], *rest[:1]] for n in c.names if n + AGAIN not in c.names]
    for k, (names, left_out) in enumerate(dropped):
        state.progress("leaving effects out in turn", k, len(dropped))
        others = tuple(name for name in names if name != left_out)
        if others not in state.refitted_combinations | state.undetected:
            state.refit_stepwise(others)
        for candidate in state.candidates_of_combination(names):
            state.refit_subset_from(candidate, left_out)
        held = state.candidates_of_combination(others)
        if held:
            _refit_leading_extensions(state, max(held, key=lambda c: c.log_z), names)


def _refit_leading_extensions(state: SearchState, held: WeighedFit, names: Names) -> None:
    """Refit a candidate with one more effect: the one that makes it `names`, and those that screening favours."""
    proposals = proposals_for(state, held, {})
    chosen = [names, *promising_combinations(state, proposals, width=SWAPPED, behind=STEERING)[:SWAPPED]]
    for added in [proposals[key].added for key in chosen if key in proposals]:
        if (held, added) not in state.extended:
            state.refit_with_effect(held, added)
