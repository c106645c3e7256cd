"""What has a formula and no name in the vocabulary gives way to a name where the readings do not tell the two."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from probewise.diagnosis.search.noises import Noises
from probewise.diagnosis.search.weighed import TOO_ALIKE, Candidate, nats_apart, outside

__all__ = ["give_way"]

Names = tuple[str, ...]
Key = tuple[int, Names]


def give_way(candidates: Mapping[Key, Candidate], noises: Noises) -> tuple[dict[Key, Candidate], set[Names]]:
    """Leave out or put back what has no name beside names of no more effects.

    Where the readings are not expected to tell the two, it is left out. Where they have told it by less, a push of
    three parameters from a tilt of two, it is believed no more than the name is: what it has found beyond that may be
    noise.

    Returns
    -------
    The candidates that stay, and the combinations that do not.
    """

    def believed(candidate: Candidate) -> float:
        return noises.over_all({noise: evidence.log_z for noise, evidence in candidate.evidence.items()})

    leading = {c.names: c for c in sorted(candidates.values(), key=believed) if c.names}
    stay, spoken_for = dict(candidates), set()
    for names, candidate in leading.items():
        if not outside(names):
            continue
        rivals = [c for c in leading.values() if not outside(c.names) and len(c.names) <= len(names)]
        if any(nats_apart(candidate, c) < TOO_ALIKE for c in rivals):
            spoken_for.add(names)
        ahead = believed(candidate) - max((believed(c) for c in rivals), default=-np.inf)
        if 0 < ahead < TOO_ALIKE:
            for key in [key for key in stay if key[1] == names]:
                stay[key] = stay[key].as_share(stay[key].log_share - ahead, stay[key].weights)
    return {key: c for key, c in stay.items() if key[1] not in spoken_for}, spoken_for
