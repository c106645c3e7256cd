"""Score, weigh, combine: find the set of effects that explains the recording.

Every subset of effects on the mean, under every noise model and several SSF orders, and whatever has no
name beside each of them. Templates screen, a beam of the best is refitted jointly and non-linearly,
Laplace weighs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.evidence.templates import TemplateMemory
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.noise.law import steps_within_scans
from probewise.diagnosis.residuals.bases import unknown_templates, unlike_named
from probewise.diagnosis.residuals.covariates import covariates_of, slope_along_the_move
from probewise.diagnosis.search.backward_elimination import eliminate_backward
from probewise.diagnosis.search.forward_selection import EXTENDED_WITHIN, select_forward
from probewise.diagnosis.search.noises import Noises
from probewise.diagnosis.search.nulls import fit_nulls
from probewise.diagnosis.search.odds import PriorOdds
from probewise.diagnosis.search.orders import at_other_orders
from probewise.diagnosis.search.pruning import prune
from probewise.diagnosis.search.refits import Refits
from probewise.diagnosis.search.state import SearchState
from probewise.diagnosis.search.unknown import Unknown
from probewise.diagnosis.search.weighed_fit import Search, weighed
from probewise.effects import UNNAMED, NamedEffect, NoiseEffect
from probewise.recordings.plan import Recording
from probewise.sensor import Stage

__all__ = ["search"]

_WITH_UNKNOWN = 4  # refitted candidates that something unknown is weighed beside
_MATTERS = 0.02  # probability by screening alone, from which on a combination is refitted
_MOST_THAT_MATTER = 6


def search(
    recording: Recording,
    effects: Mapping[str, NamedEffect[Any]],
    *,
    sensor: Null | None,
    prior: PriorOdds | None = None,
    max_order: int = 3,
    beam: int = 8,
    depth: int = 3,
) -> Search:
    """Weigh every combination of effects.

    Parameters
    ----------
    recording
        What was read.
    effects
        The vocabulary to search, by name.
    sensor
        What is believed of the sensor, or of any other model; None: calibrated from the recording alone.
    prior
        Prior odds.
    max_order
        Largest number of Gaussians tried without a sensor; one more where that is not far behind.
    beam, depth
        How many combinations of each size above one are refitted, and the largest size.
    """
    prior = prior or PriorOdds.over(effects)
    on_noise = {name: cast(NoiseEffect, e) for name, e in effects.items() if e.stage is Stage.NOISE}
    noises = Noises(recording, on_noise, prior)
    templates = TemplateMemory(np.flatnonzero(recording.usable))
    on_mean = {name: effect for name, effect in effects.items() if name not in on_noise}
    state = SearchState(on_mean, prior, noises, templates, Refits(sensor, noises, templates))
    fit_nulls(state, sensor, max_order=max_order)
    null = state.null
    unknown = _unknown(state)

    def weighed_up() -> Search:
        return weighed(
            Search(
                recording,
                effects,
                noises.models,
                noises.certain,
                state.sensors,
                state.candidates,
                state.screened(),
                unknown.log_z,
                prior,
                unknown.covariates,
                unknown.bases,
                unknown.shares,
                null.found,
                templates,
            )
        )

    select_forward(state, beam=beam, depth=depth)
    eliminate_backward(state)
    # Beside a form of the SSF that the readings refute, it is the form that is missing.
    unknown.weigh([c for c in state.nulls if c.log_z > state.null.log_z - EXTENDED_WITHIN])
    for _ in range(_MOST_THAT_MATTER):
        by_mean = weighed_up().by_mean
        settled = {(), ("unknown",)} | state.undetected | state.refitted
        names = max((key for key in by_mean if key not in settled), key=lambda key: by_mean[key], default=())
        if by_mean.get(names, 0.0) <= _MATTERS or not names:
            break
        state.reach(names)
    if sensor is None:
        at_other_orders(state, weighed_up().by_mean)
    state.candidates, state.pruned = prune(state.candidates, noises)
    refitted = [c for c in state.candidates.values() if c.names]
    unknown.weigh(sorted(refitted, key=lambda c: -c.log_z)[:_WITH_UNKNOWN])
    unknown.prune(state.candidates.values())
    return weighed_up()


def _unknown(state: SearchState) -> Unknown:
    """Lay out what has no name about the best null."""
    null, recording = state.null, state.noises.recording
    usable = np.flatnonzero(recording.usable)
    level, model, z = null.found.predicted, null.found.model, null.found.z[None, :]
    slope = slope_along_the_move(lambda moved: model.predict(z, moved)[0], model.plan)[usable]
    covariates = covariates_of(recording.plan, usable, level, slope)
    starts = np.flatnonzero(steps_within_scans(recording) == 0)
    bases = unknown_templates(covariates, level - level.min(), slope, starts)
    named = [effect for name, effect in state.effects.items() if name not in UNNAMED]
    problem = Linearised.of(null.found, state.refits.law_of(null))
    return Unknown(
        unlike_named(bases, state.templates.bank(null.found, named), problem),
        tuple(covariates),
        state.noises,
        lambda worth: state.complexity_penalty(worth, state.prior.unknown_complexity_penalty),
    )
