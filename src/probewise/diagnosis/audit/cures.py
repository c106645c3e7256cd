"""Cures of a plan: the fewest extra scans, chosen greedily, with which it detects effects and tells them apart."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from probewise._arrays import IntArray
from probewise.diagnosis.audit.detectability import (
    LEAST_NATS,
    LEAST_SHARE,
    ExpectedSensor,
    PlanTemplates,
    ProjectedTemplates,
    nats_from_cosine,
)
from probewise.diagnosis.joining import join_plans
from probewise.diagnosis.light_sensor.candidate_scans import candidate_scans
from probewise.diagnosis.light_sensor.scheduling import Scan, scan_started_after
from probewise.diagnosis.light_sensor.target_swaps import target_swaps
from probewise.effects import NamedEffect
from probewise.progress import Progress, silent
from probewise.recordings.plan import Plan

_MOST_SETTINGS = 48  # bank entries per effect, since a hundred scans are tried at every step
_MOST_SCANS = 5
_WORTHWHILE = 0.15  # least reduction of the summed deficit by an added scan
_WORTHWHILE_EACH = 0.005  # and per reading: at most 200 readings are spent on one effect
_STRIDES = (1, 4)


def choose_cure_scans(
    plan: Plan,
    expected: ExpectedSensor,
    effects: Mapping[str, type[NamedEffect[Any]]],
    ailing: Sequence[str],
    progress: Progress = silent,
) -> list[Scan]:
    """Choose up to five scans to add, one at a time, each with the largest reduction of the deficit per reading.

    They are timed one after another, in the order chosen. The deficit of an effect is 0 if it is detected and told from
    others, up to 1 if aliased, 1 to 2 if invisible.

    Parameters
    ----------
    plan
        The plan.
    expected
        The expected sensor.
    effects
        The vocabulary, by name.
    ailing
        Names of the effects that are aliased or invisible under the plan.
    progress
        Called before every choice.
    """
    every = [*candidate_scans(plan, strides=_STRIDES), *target_swaps(plan)]
    chosen: list[Scan] = []
    current = plan
    while len(chosen) < _MOST_SCANS:
        progress("looking for readings that cure", len(chosen), _MOST_SCANS)
        taken = {command.plan.scan_names for command in chosen}
        offered = [c for c in every if c.plan.scan_names not in taken]
        options = [scan_started_after(command, current) for command in offered]
        if not options:
            break
        together = join_plans([current, *(option.plan for option in options)])
        laid = PlanTemplates.of(expected, together, effects, most=_MOST_SETTINGS)
        now = np.arange(len(current))
        trouble = _total_detectability_deficit(laid, now, ailing)
        worth = []
        for start, end in itertools.pairwise(np.cumsum([len(current), *(len(o.plan) for o in options)]).tolist()):
            gained = trouble - _total_detectability_deficit(laid, np.concatenate([now, np.arange(start, end)]), ailing)
            readings = end - start
            worth.append(gained / readings if gained >= max(_WORTHWHILE, _WORTHWHILE_EACH * readings) else 0.0)
        best = int(np.argmax(worth))
        if worth[best] == 0.0:
            break
        chosen.append(options[best])
        current = join_plans([current, options[best].plan])
    return chosen


def _total_detectability_deficit(laid: PlanTemplates, rows: IntArray, ailing: Sequence[str]) -> float:
    """Return the summed deficit of the ailing effects on these rows: 0 fine, up to 1 aliased, 1 to 2 invisible."""
    detectability = ProjectedTemplates.of(laid, rows).detectable_shares_and_cosines(ailing)
    total = 0.0
    for name in ailing:
        share, like = detectability.get(name, (0.0, {}))
        if share < LEAST_SHARE:
            total += 2.0 - share / LEAST_SHARE
        else:
            total += max(1.0 - nats_from_cosine(max(like.values(), default=0.0)) / LEAST_NATS, 0.0)
    return total
