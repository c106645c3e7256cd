"""Prune combinations out of vocabulary that are aliased with named ones."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from probewise.diagnosis.names import Names
from probewise.diagnosis.search.constants import ALIASED_NATS
from probewise.diagnosis.search.noises import Noises
from probewise.diagnosis.search.weighed_fit import WeighedFit, expected_nats, out_of_vocabulary

Key = tuple[int, Names]


def prune(candidates: Mapping[Key, WeighedFit], noises: Noises) -> tuple[dict[Key, WeighedFit], set[Names]]:
    """Drop or penalise combinations out of vocabulary that compete with named ones of no more effects.

    If the readings are not expected to separate the two, the unnamed one is dropped. If its observed lead is smaller
    than that, its evidence is reduced to that of the named one: the lead may be noise.

    Returns
    -------
    The candidates that stay, and the combinations that do not.
    """

    def believed(candidate: WeighedFit) -> float:
        return noises.over_all({noise: evidence.log_z for noise, evidence in candidate.evidence.items()})

    leading = {c.names: c for c in sorted(candidates.values(), key=believed) if c.names}
    stay, pruned = dict(candidates), set()
    for names, candidate in leading.items():
        if not out_of_vocabulary(names):
            continue
        rivals = [c for c in leading.values() if not out_of_vocabulary(c.names) and len(c.names) <= len(names)]
        if any(expected_nats(candidate, c) < ALIASED_NATS for c in rivals):
            pruned.add(names)
        ahead = believed(candidate) - max((believed(c) for c in rivals), default=-np.inf)
        if 0 < ahead < ALIASED_NATS:
            for key in [key for key in stay if key[1] == names]:
                stay[key] = stay[key].as_share(stay[key].log_share - ahead, stay[key].weights)
    return {key: c for key, c in stay.items() if key[1] not in pruned}, pruned
