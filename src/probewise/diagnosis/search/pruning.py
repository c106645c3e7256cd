"""Pruning of combinations out of vocabulary in favour of named ones that explain the readings as well."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from probewise.diagnosis.names import Names
from probewise.diagnosis.search.constants import ALIASED_NATS
from probewise.diagnosis.search.noises import NoiseModels
from probewise.diagnosis.search.weighed_fit import WeighedFit, effects_out_of_vocabulary, expected_log_bayes_factor

Key = tuple[int, Names]


def prune_out_of_vocabulary(
    candidates: Mapping[Key, WeighedFit], noises: NoiseModels
) -> tuple[dict[Key, WeighedFit], set[Names]]:
    """Drop or penalise combinations out of vocabulary that compete with named ones of no more effects.

    A combination is dropped if it predicts so much the same as a named one that its expected lead is below three nats.
    If its observed lead is below three nats, its evidence is reduced to that of the best named one.

    Returns
    -------
    The candidates that stay, and the combinations that were dropped.
    """

    def average_log_evidence(candidate: WeighedFit) -> float:
        return noises.average_log_evidence({noise: evidence.log_z for noise, evidence in candidate.evidence.items()})

    leading = {c.names: c for c in sorted(candidates.values(), key=average_log_evidence) if c.names}
    stay, pruned = dict(candidates), set()
    for names, candidate in leading.items():
        if not effects_out_of_vocabulary(names):
            continue
        rivals = [c for c in leading.values() if not effects_out_of_vocabulary(c.names) and len(c.names) <= len(names)]
        if any(expected_log_bayes_factor(candidate, c) < ALIASED_NATS for c in rivals):
            pruned.add(names)
        ahead = average_log_evidence(candidate) - max((average_log_evidence(c) for c in rivals), default=-np.inf)
        if 0 < ahead < ALIASED_NATS:
            for key in [key for key in stay if key[1] == names]:
                stay[key] = stay[key].with_variant_factor_and_weights(stay[key].log_share - ahead, stay[key].weights)
    return {key: c for key, c in stay.items() if key[1] not in pruned}, pruned
