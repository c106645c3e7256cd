"""The integration step of a law at which predictions stand still, and the method that takes it.

The step is halved until that no longer changes predictions. An explicit method is tried first; where it needs many
steps, as for a stiff law, so is a linearly implicit one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects import NamedEffect
from probewise.errors import ParameterError
from probewise.systems.motion import LawWithEffects, evaluations_per_step
from probewise.systems.system import System
from probewise.systems.table import RunTable

STANDS_STILL = 0.02
"""Noise sds, rms, that predictions may move by when the step of the integration is halved."""

_MOST_STEPS = 4096  # integration steps over the longest run, in addition to one per row
_CHEAPER = 2.0  # evaluations of the explicit method for one of a linearly implicit one, from which that is taken
_CONVERGING = 4.0  # factor by which halving the step reduces the change at least, if the law is smooth


def with_converged_step(
    system: System,
    table: RunTable,
    theta: FloatArray,
    effects: Sequence[NamedEffect[Any]] = (),
    *,
    tolerance: float,
    or_finest: bool = False,
) -> System:
    """Return a system with a step so short that halving it changes predictions by a tolerance (rms) at most.

    Where a linearly implicit method needs less than half the evaluations, the system is `stiff`.

    Parameters
    ----------
    system
        The system; one without a law is returned as it is.
    table
        The rows.
    theta
        Parameters of the system and of the effects, (n_samples, n_params); samples without finite predictions do
        not count, unless half the step makes them finite.
    effects
        Effects added to the law.
    tolerance
        Tolerance, in the unit of a reading.
    or_finest
        Return the finest step within reach, instead of an error, if predictions converge but still change by more.

    Raises
    ------
    ParameterError
        If predictions still change with 4,096 more steps than rows in the longest run.
    """
    if system.simulator.law is None:
        return system
    found: System | ParameterError
    try:
        found = _halved_until_still(system, table, theta, effects, tolerance=tolerance, or_finest=or_finest)
        cost = _cost_of_integration(found, table)
    except ParameterError as error:
        found, cost = error, math.inf
    stiff = replace(system, max_step=max(system.max_step, system.steps(table).places.typical_gap), stiff=True)
    if found is not system and not system.stiff and cost > _CHEAPER * _cost_of_integration(stiff, table):
        try:
            return _halved_until_still(stiff, table, theta, effects, tolerance=tolerance, most=cost / _CHEAPER)
        except ParameterError:  # it is not still either, or not at that cost
            pass
    if isinstance(found, ParameterError):
        raise found
    return found


def _halved_until_still(
    system: System,
    table: RunTable,
    theta: FloatArray,
    effects: Sequence[NamedEffect[Any]],
    *,
    tolerance: float,
    or_finest: bool = False,
    most: float = math.inf,
) -> System:
    """Return a system with the step halved as `with_converged_step` says, by its own method.

    Raises
    ------
    ParameterError
        If predictions still change with 4,096 more steps than rows in the longest run, or at a cost above `most`.
    """
    now = system
    coarse, before = now.chain(table, effects).predict(theta, table), np.inf
    while True:
        finer = replace(now, max_step=now.max_step / 2)
        fine = finer.chain(table, effects).predict(theta, table)
        there = np.isfinite(coarse) & np.isfinite(fine)
        ran_away = np.isfinite(fine) & ~np.isfinite(coarse)  # at the longer step alone
        moved = np.inf
        if there.any() and not ran_away.any():
            with np.errstate(over="ignore"):  # of predictions that are about to run away
                moved = float(np.sqrt(np.mean((coarse - fine)[there] ** 2)))
        if moved <= tolerance:
            return now
        if or_finest and moved < before / _CONVERGING and not _has_affordable_steps(finer, table):
            return now
        now, coarse, before = finer, fine, moved
        if not _has_affordable_steps(now, table) or _cost_of_integration(now, table) > most:
            raise ParameterError(
                "rates",
                f"readings still change by {moved:.3g} {system.simulator.unit} (rms) when the step of "
                f"{2 * now.max_step:.3g} {system.simulator.time_unit} is halved",
                "a law that some thousand steps integrate; set a shorter max_step_s, or write simulate with your own "
                "integrator",
            )


def _cost_of_integration(system: System, table: RunTable) -> float:
    """Return the number of evaluations of the rates, of all samples and runs together."""
    law = system.simulator.law
    assert law is not None
    schedule = system.steps(table).schedule
    return float(schedule.n_steps.sum() * evaluations_per_step(LawWithEffects(law), schedule.method))


def _has_affordable_steps(system: System, table: RunTable) -> bool:
    """Return whether the integration takes at most 4,096 steps more than there are rows in the longest run."""
    steps = system.steps(table)
    return bool(steps.schedule.n_steps.sum() <= _MOST_STEPS + len(steps.places.row_by_position_and_run))
