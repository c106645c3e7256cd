"""Prune what is out of vocabulary where the readings do not tell it from a name."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from probewise.diagnosis.names import Names
from probewise.diagnosis.search.constants import ALIASED_NATS
from probewise.diagnosis.search.noises import Noises
from probewise.diagnosis.search.weighed_fit import WeighedFit, expected_nats, out_of_vocabulary

__all__ = ["prune"]
Key = tuple[int, Names]


def prune(candidates: Mapping[Key, WeighedFit], noises: Noises) -> tuple[dict[Key, WeighedFit], set[Names]]:
    """Leave out or put back what has no name beside names of no more effects.

    Where the readings are not expected to tell the two, it is left out. Where they have told it by less, a push of
    three parameters from a tilt of two, it is believed no more than the name is: what it has found beyond that may be
    noise.

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
