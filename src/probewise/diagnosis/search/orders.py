"""Refit combinations at the SSF orders that could rival the one they were found at."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from probewise.diagnosis.fitting.fit import Model
from probewise.diagnosis.search.growing import WORTH_REFITTING
from probewise.diagnosis.search.pool import Pool
from probewise.diagnosis.search.refits import acts
from probewise.diagnosis.search.weighed import Candidate

__all__ = ["at_other_orders"]

Names = tuple[str, ...]

_AT_OTHER_ORDERS = 6  # leading combinations that are refitted at other SSF orders
_LEAST_ELSEWHERE = 1e-4  # probability of such a combination, among those with a formula


def at_other_orders(pool: Pool, by_mean: Mapping[Names, float]) -> None:
    """Refit the most probable combinations wherever that is worth it.

    What has no name may lead at an order at which no name was tried yet: that must not keep the names from it.
    """
    known = sum(p for names, p in by_mean.items() if names != ("unknown",))
    leaders = sorted((names for names in by_mean if names not in ((), ("unknown",))), key=lambda n: -by_mean[n])
    for names in leaders[:_AT_OTHER_ORDERS]:
        held = pool.of(names)
        if held and by_mean[names] >= _LEAST_ELSEWHERE * known:
            source = max(held, key=lambda c: c.log_z)
            for n in _rival_orders(pool, source):
                _carry_over(pool, source, n)


def _rival_orders(pool: Pool, source: Candidate) -> list[int]:
    """List the SSF orders at which what is refitted at one is worth another refit."""
    own = pool.candidates[source.n_gaussians, ()].log_z
    behind = own - WORTH_REFITTING
    return [
        n
        for n, sensor in pool.sensors.items()
        if (n, source.names) not in pool.candidates
        # A freer SSF that does not pay by itself does not pay beside an effect.
        and (sensor.worth < source.worth or pool.candidates[n, ()].log_z > behind)
        and (sensor.worth <= source.worth + 1 or pool.candidates[n, ()].log_z > own)
    ]


def _carry_over(pool: Pool, source: Candidate, n: int) -> None:
    """Refit a candidate's effects at another SSF order; keep it where they are felt."""
    null, sensor = pool.candidates[n, ()], pool.sensors[n]
    own = source.found.z[source.found.model.sensor.n_params :]
    candidate = pool.refits.weighed(
        Model(sensor, source.found.model.effects, source.found.model.plan),
        np.concatenate([null.found.z, own])[None, :],
        pool.refits.law_of(source),
        max_steps=15,
    )
    log_share = source.log_share + pool.coincidence(source.worth) - pool.coincidence(sensor.worth)
    candidate = candidate.as_share(log_share, source.weights)
    if acts(candidate, null):
        pool.keep(candidate)
