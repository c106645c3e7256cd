"""The next scans: chosen for what their readings tell of which hypothesis is true.

The index of the true hypothesis and the readings have a mutual information; between hypotheses whose predictions are
normal it has a lower bound in closed form, from the Bhattacharyya distance of each two (Kolchinsky & Tracey 2017,
"Estimating mixture entropy with pairwise distances", Entropy 19, 361: Chernoff's divergence, alpha = 1/2). Scans are
added greedily, each for what it tells a minute, as long as there is something left to tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.fitting.fit import Model
from probewise.diagnosis.scheduling import MOST_READINGS, Command, rows_of
from probewise.recordings.plan import Plan

__all__ = ["NextMeasurement", "Rival", "mutual_information", "next_scans"]

_STRIDES = (2, 4)
_PROMISING = 4  # scans for each two rivals of which more than the mean is predicted
_ENOUGH = 40.0  # squared distance of predictions, in noise sd, beyond which two rivals are told apart all the same
_SETTLED = 0.05  # share of what is open that may stay open
_WORTHWHILE = 0.03  # share of what is open that a further scan has to tell
_ANYTHING = 1e-6  # the same of the first
_LEAST_WEIGHT = 0.05  # of a rival, however improbable: a probability may be wrong


@dataclass(frozen=True, eq=False)
class NextMeasurement:
    """A plan to take next, and how much it is expected to tell.

    `expected_log_bayes_factor`: of the true hypothesis over the one hardest to tell from it, in nats, averaged over
    which is true. `between`: what these are, in words.
    """

    plan: Plan
    description: str
    minutes: float
    expected_log_bayes_factor: float
    between: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Rival:
    """A hypothesis about the mean: its name in words, a model at its best point z (n_params,), and its probability.

    `root` (n_params, n_params): a square root of the covariance there, root root^T.
    """

    label: str
    model: Model
    z: FloatArray
    root: FloatArray
    probability: float

    def predictive(self, plan: Plan, sd: float) -> PredictiveNormal:
        """Predict a plan's readings, in noise sd."""
        mean, slopes = replace(self.model, plan=plan).jacobian(self.z)
        return PredictiveNormal(mean / sd, slopes @ self.root / sd)


@dataclass(frozen=True, eq=False)
class PredictiveNormal:
    """Normal predictions in noise sd: mean (n_points,), covariance 1 + factor factor^T, factor (n_points, n_params)."""

    mean: FloatArray
    factor: FloatArray

    def take(self, rows: IntArray) -> PredictiveNormal:
        """Keep these readings."""
        return PredictiveNormal(self.mean[rows], self.factor[rows])

    @property
    def covariance(self) -> FloatArray:
        """Of the readings, (n_points, n_points)."""
        return np.asarray(np.eye(len(self.mean)) + self.factor @ self.factor.T)


def next_scans(rivals: Sequence[Rival], sd: float, plan: Plan, apparatus: Apparatus) -> NextMeasurement | None:
    """Choose the scans that tell the rivals apart, at most 102 readings; None where nothing can be done, or told.

    Parameters
    ----------
    rivals
        Two or more.
    sd
        Noise of a reading.
    plan
        What was measured.
    apparatus
        What could measure more.
    """
    leader = max(rivals, key=lambda rival: rival.probability)
    level = leader.model.predict(leader.z[None, :])[0]
    offered = apparatus.commands(plan, strides=_STRIDES, level=level)
    weights = np.maximum([rival.probability for rival in rivals], _LEAST_WEIGHT)
    weights /= weights.sum()
    offered = [offered[k] for k in _promising(rivals, sd, offered, plan, apparatus)]
    if not offered:
        return None
    everywhere, rows = apparatus.one_after_another(offered, plan), rows_of(offered)
    predictives = [rival.predictive(everywhere, sd) for rival in rivals]

    chosen: list[int] = []
    taken: IntArray = np.zeros(0, dtype=np.int64)
    told, uncertain = 0.0, float(-np.sum(weights * np.log(weights)))
    while uncertain - told > _SETTLED * uncertain:
        gains = np.zeros(len(offered))
        for k in range(len(offered)):
            together = np.concatenate([taken, rows[k]])
            if k not in chosen and len(together) <= MOST_READINGS:
                gains[k] = mutual_information([predictive.take(together) for predictive in predictives], weights) - told
        gains[~(gains >= (_WORTHWHILE if chosen else _ANYTHING) * uncertain)] = 0.0  # also where a model fails there
        best = int(np.argmax(gains / [option.minutes for option in offered]))
        if gains[best] == 0.0:
            break
        chosen.append(best)
        taken, told = np.concatenate([taken, rows[best]]), told + gains[best]
    if not chosen:
        return None
    scans = [offered[k] for k in chosen]
    return NextMeasurement(
        apparatus.in_turn(scans, plan),
        "; then ".join(scan.description for scan in scans),
        sum(scan.minutes for scan in scans),
        _expected_log_bayes_factor([predictive.take(taken) for predictive in predictives], weights),
        tuple(rival.label for rival in rivals),
    )


def mutual_information(predictives: Sequence[PredictiveNormal], weights: FloatArray) -> float:
    """Bound the mutual information of the hypothesis' index and the readings from below, in nats.

    Parameters
    ----------
    predictives
        What each hypothesis predicts of the same readings.
    weights
        Probabilities (n_hypotheses,), which sum to one.
    """
    covariances = [predictive.covariance for predictive in predictives]
    log_dets = [np.linalg.slogdet(covariance)[1] for covariance in covariances]
    distances = np.zeros((len(predictives), len(predictives)))
    for a, b in combinations(range(len(predictives)), 2):
        middle, apart = (covariances[a] + covariances[b]) / 2, predictives[a].mean - predictives[b].mean
        log_det = np.linalg.slogdet(middle)[1] - (log_dets[a] + log_dets[b]) / 2
        distances[a, b] = distances[b, a] = apart @ np.linalg.solve(middle, apart) / 8 + log_det / 2
    return float(-weights @ logsumexp(-distances, b=weights, axis=1))


def _promising(
    rivals: Sequence[Rival], sd: float, offered: Sequence[Command], plan: Plan, apparatus: Apparatus
) -> list[int]:
    """Keep, for each two rivals, the few scans in which what they predict differs most a minute."""
    if not offered:
        return []
    everywhere, rows = apparatus.one_after_another(offered, plan), rows_of(offered)
    means = np.stack([replace(rival.model, plan=everywhere).predict(rival.z[None, :])[0] for rival in rivals]) / sd
    minutes = np.array([option.minutes for option in offered])
    kept: dict[int, None] = {}
    for a, b in combinations(range(len(rivals)), 2):
        square = (means[a] - means[b]) ** 2
        # Beyond what settles it more is worth nothing.
        worth = np.minimum([square[own].sum() for own in rows], _ENOUGH) / minutes
        kept |= dict.fromkeys(np.argsort(-worth, kind="stable")[:_PROMISING].tolist())
    return list(kept)


def _expected_log_bayes_factor(predictives: Sequence[PredictiveNormal], weights: FloatArray) -> float:
    """Average, over which hypothesis is true, the log Bayes factor to be expected over the hardest of its rivals."""
    covariances = [predictive.covariance for predictive in predictives]
    inverse = [np.linalg.inv(covariance) for covariance in covariances]
    log_dets = [np.linalg.slogdet(covariance)[1] for covariance in covariances]
    hardest = []
    for a, true in enumerate(predictives):
        divergences = []
        for b, other in enumerate(predictives):
            if a != b:
                apart = true.mean - other.mean
                trace = float(np.sum(inverse[b] * covariances[a])) - len(apart)
                divergences.append(0.5 * (trace + log_dets[b] - log_dets[a] + apart @ inverse[b] @ apart))
        hardest.append(min(divergences))
    return max(float(weights @ hardest), 0.0)
