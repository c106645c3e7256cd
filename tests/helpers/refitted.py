"""The state of a search after its nulls, and one effect refitted in it, as a diagnosis does."""

from probewise.diagnosis.search import SearchState, fit_nulls
from probewise.diagnosis.search.hypotheses import NoiseModels, Refits
from probewise.diagnosis.templates import TemplateCache


def state_with_nulls(prepared, on_noise=None):
    """The nulls are fitted, under white noise and the effects on the noise by name."""
    prior = prepared.apparatus.prior_odds(prepared.effects)
    noises = NoiseModels(prepared.recording, on_noise or {}, prior)
    refits = Refits(prepared.null, noises, TemplateCache(prepared.usable_rows))
    on_mean = {name: effect for name, effect in prepared.effects.items() if name not in prepared.noise_effect_names}
    state = SearchState(on_mean, prior, refits)
    fit_nulls(state, prepared, max_order=1)
    return state


def refitted_with(prepared, name):
    """The likeliest candidate with one effect on the mean, under white noise."""
    state = state_with_nulls(prepared)
    return state.refits.refit_with_effect(state.null, state.effects[name])[0]
