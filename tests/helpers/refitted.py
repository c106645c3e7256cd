"""One effect, refitted as a diagnosis does it."""

from probewise.diagnosis.evidence.templates import TemplateCache
from probewise.diagnosis.search.noises import NoiseModels
from probewise.diagnosis.search.nulls import fit_nulls
from probewise.diagnosis.search.refits import Refits
from probewise.diagnosis.search.state import SearchState


def refitted_with(prepared, name):
    """The likeliest candidate with one effect on the mean, under white noise."""
    prior = prepared.apparatus.prior_odds(prepared.effects)
    refits = Refits(prepared.null, NoiseModels(prepared.recording, {}, prior), TemplateCache(prepared.usable_rows))
    on_mean = {name: effect for name, effect in prepared.effects.items() if name not in prepared.noise_effect_names}
    state = SearchState(on_mean, prior, refits.noises, refits.templates, refits)
    fit_nulls(state, prepared, max_order=1)
    return state.refits.refit_with_effect(state.null, state.effects[name])[0]
