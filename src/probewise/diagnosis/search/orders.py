"""Refit combinations at the SSF orders (numbers of Gaussians) that could rival the one they were found at."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from probewise.diagnosis.fitting.fit import Model
from probewise.diagnosis.names import Names
from probewise.diagnosis.search.constants import MOST_AT_OTHER_ORDERS, REFITTED_AT_OTHER_ORDERS, REFITTED_WITHIN
from probewise.diagnosis.search.refits import is_significantly_better
from probewise.diagnosis.search.state import SearchState
from probewise.diagnosis.search.weighed_fit import WeighedFit


def refit_at_other_orders(state: SearchState, by_mean: Mapping[Names, float]) -> None:
    """Refit the most probable combinations of effects on the mean at other numbers of Gaussians (SSF orders).

    Refits with significant effects are stored in `state`. `by_mean` is the posterior probability of each combination,
    whatever the noise. An unknown effect may lead at an order at which no named effect was tried; named ones must then
    be tried there.
    """
    known = sum(p for names, p in by_mean.items() if names != ("unknown",))
    leaders = sorted((names for names in by_mean if names not in ((), ("unknown",))), key=lambda n: -by_mean[n])
    for k, names in enumerate(leaders[:MOST_AT_OTHER_ORDERS]):
        state.progress("refitting at other numbers of Gaussians", k, min(len(leaders), MOST_AT_OTHER_ORDERS))
        held = state.candidates_of_combination(names)
        if held and by_mean[names] >= REFITTED_AT_OTHER_ORDERS * known:
            source = max(held, key=lambda c: c.log_z)
            for n in _orders_to_refit(state, source):
                _refit_at_order(state, source, n)


def _orders_to_refit(state: SearchState, source: WeighedFit) -> list[int]:
    """List the other numbers of Gaussians with which a candidate's effects should be refitted."""
    own = state.candidates[source.n_gaussians, ()].log_z
    behind = own - REFITTED_WITHIN
    return [
        n
        for n, sensor in state.sensors.items()
        if (n, source.names) not in state.candidates
        # A freer SSF that the evidence rejects by itself is also rejected with an effect.
        and (sensor.effective_n_gaussians < source.ssf_degrees_of_freedom or state.candidates[n, ()].log_z > behind)
        and (sensor.effective_n_gaussians <= source.ssf_degrees_of_freedom + 1 or state.candidates[n, ()].log_z > own)
    ]


def _refit_at_order(state: SearchState, source: WeighedFit, n: int) -> None:
    """Refit a candidate's effects with `n` Gaussians; store the fit if it is significantly better than that null."""
    null, sensor = state.candidates[n, ()], state.sensors[n]
    own = source.found.z[source.found.model.sensor.n_params :]
    candidate = state.refits.fit_and_weigh(
        Model(sensor, source.found.model.effects, source.found.model.plan),
        np.concatenate([null.found.z, own])[None, :],
        state.refits.likeliest_law(source),
        max_steps=15,
    )
    log_share = (
        source.log_share
        + state.complexity_penalty(source.ssf_degrees_of_freedom)
        - state.complexity_penalty(sensor.effective_n_gaussians)
    )
    candidate = candidate.with_variant_factor_and_weights(log_share, source.weights)
    if is_significantly_better(candidate, null):
        state.store_candidate(candidate)
