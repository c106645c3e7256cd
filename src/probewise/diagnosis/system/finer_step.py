"""The finer integration step that a repaired law needs, and a search brought to it without searching again.

The step is chosen for the residuals of the law without effects. The repaired law's are smaller, and its predictions may
change by more than their noise where the step is halved.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from probewise.diagnosis.fitting.fit import Model
from probewise.diagnosis.names import Names
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import WeighedFit
from probewise.diagnosis.search.weighed_twice import A_NAT
from probewise.diagnosis.system.apparatus import SimulatorApparatus
from probewise.diagnosis.verdict_report.diagnosis import Diagnosis
from probewise.effects import NamedEffect
from probewise.errors import NotConvergedError, ParameterError
from probewise.progress import Progress, silent
from probewise.systems import RunTable, System
from probewise.systems.system import STANDS_STILL, with_converged_step

_N_HALVED = 4  # posterior samples of the repaired law for which the step is halved
_HAS_A_CHANCE = 0.01  # probability from which a combination is refitted at the finer step


def finer_step_for_repair(diagnosis: Diagnosis) -> tuple[float, bool] | None:
    """Return the finer integration step that the repaired law needs, or the finest within reach, and if it is stiff.

    None if the step used was fine enough, or the simulator has no law, or the repair no effects.
    """
    system = cast(SimulatorApparatus, diagnosis.apparatus).system
    model, table = diagnosis.repaired, cast(RunTable, diagnosis.recording.plan)
    effects = cast(Sequence[NamedEffect[Any]], model.chain.effects)
    if system.simulator.law is None or not effects:
        return None
    tolerance = STANDS_STILL * float(np.median(model.noise_sd))
    try:
        theta = model.theta[:_N_HALVED]
        still = with_converged_step(system, table, theta, effects, tolerance=tolerance, or_finest=True)
    except ParameterError:  # a friction or a bound that no step meets exactly
        return None
    needed = still.max_step, still.stiff
    return needed if needed != (system.max_step, system.stiff) else None


def searched_at_step(
    searched: Searched, max_step: float, *, stiff: bool = False, progress: Progress = silent
) -> Searched | None:
    """Return a search with the combinations that have a chance refitted at another step, from their own parameters.

    None if one of them, the most probable first, gains or loses more than a nat: then errors of the integration may
    have led the search, and it has to be made again.

    Parameters
    ----------
    searched
        The search of a law.
    max_step, stiff
        The step, in the unit of time, and whether a linearly implicit method takes it.
    progress
        Called at every refit.
    """
    prepared = searched.prepared
    apparatus = cast(SimulatorApparatus, prepared.apparatus)
    finer = replace(cast(System, prepared.null), max_step=max_step, stiff=stiff)
    fits, unknown = dict(searched.evidences.fits), dict(searched.evidences.unknown)
    with_a_chance = _combinations_with_a_chance(searched)
    asked = [*with_a_chance, *([] if () in with_a_chance else [()])]  # the null is part of every report
    keys = [key for names in asked for key in searched.evidences.fits if key[1] == names]
    for k, key in enumerate(keys):
        progress("refitting at a finer step", k, len(keys))
        held = searched.evidences.fits[key]
        try:
            again = _refitted(searched, held, finer)
        except NotConvergedError:
            return None
        moved = {noise: again.evidence[noise].log_z - e.log_z for noise, e in held.evidence.items()}
        if key[1] in with_a_chance and not abs(again.log_z - held.log_z) < A_NAT:
            return None
        fits[key] = again
        unknown |= {
            (n, names, noise): value + moved[noise]
            for (n, names, noise), value in unknown.items()
            if (n, names) == key and math.isfinite(moved[noise])
        }
    return replace(
        searched,
        prepared=replace(
            prepared,
            null=finer,
            apparatus=replace(apparatus, finer=replace(apparatus.system, max_step=max_step, stiff=stiff)),
        ),
        nulls=dict.fromkeys(searched.nulls, finer),
    ).with_evidences(replace(searched.evidences, fits=fits, unknown=unknown))


def _combinations_with_a_chance(searched: Searched) -> list[Names]:
    """List the refitted combinations with a probability of 0.01 or more, most probable first.

    With or without an unknown effect beside: if that is probable, so are the fits that it is most probable beside.
    """
    chance = searched.posterior.marginal_over_noise
    unknown, beside = chance.get(("unknown",), 0.0), dict[Names, float]()
    for (_, names, _), value in searched.evidences.unknown.items():
        beside[names] = max(value + searched.prior.log_prior_with_unknown(names), beside.get(names, -math.inf))
    most = max(beside.values(), default=0.0)
    refitted = dict.fromkeys(names for _, names in searched.evidences.fits)
    own = {
        names: max(chance.get(names, 0.0), unknown * math.exp(beside.get(names, -math.inf) - most))
        for names in refitted
    }
    return sorted((names for names in refitted if own[names] >= _HAS_A_CHANCE), key=lambda names: -own[names])


def _refitted(searched: Searched, held: WeighedFit, system: System) -> WeighedFit:
    """Refit a combination over another system of the same parameters, from where it was."""
    model = Model(system, held.found.model.effects, held.found.model.plan)
    again = searched.refits.fit_and_weigh(model, held.found.z[None, :], held.law)
    return again.with_variant_factor_and_weights(held.log_share, held.weights)
