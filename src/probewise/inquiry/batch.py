"""Choose several readings at once (a batch)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.inquiry.choice import choose
from probewise.inquiry.forecast import resampled_hypotheses
from probewise.inquiry.prospect import Prospect

_OUTCOMES = 16  # simulated outcomes of the readings chosen so far
_FEW = 600  # hypotheses used to simulate them


def choose_several(prospect: Prospect, n: int, *, rng: np.random.Generator) -> tuple[int, ...]:
    """Choose readings with large joint information, greedily one after another.

    Greedy on the joint information I(y_1 ... y_n) = I(y_1) + I(y_2 | y_1) + ..., within 1 - 1/e of the
    best set (Nemhauser, Wolsey & Fisher 1978). The condition is averaged over simulated outcomes: each is a draw from
    the predictive distribution, with its own posterior.

    Parameters
    ----------
    prospect
        Posterior, designs and sensor.
    n
        Number of readings.
    rng
        Source of randomness.

    Returns
    -------
    Rows of the prospect's designs, in the order in which they were chosen; two may be the same.
    """
    if n < 1:
        raise ParameterError("n", n, "1 or more")
    everywhere = np.ones(len(prospect.rows), dtype=np.bool_)
    chosen = [choose(prospect.information(prospect.weight), everywhere, rng=rng)]
    rows, share = resampled_hypotheses(prospect.weight, _FEW)
    few = replace(prospect, theta=prospect.theta[rows], weight=share / share.sum())
    weights = [few.weight] * _OUTCOMES
    for _ in range(n - 1):
        weights = _weights_after_simulated(few, chosen[-1], weights, rng)
        gain = np.mean([few.information(weight) for weight in weights], axis=0)
        chosen.append(choose(gain, everywhere, rng=rng))
    return tuple(int(prospect.rows[row]) for row in chosen)


def _weights_after_simulated(
    prospect: Prospect, row: int, weights: list[FloatArray], rng: np.random.Generator
) -> list[FloatArray]:
    """Simulate an outcome of design `row` under each posterior, and return the weights of each updated by it."""
    readout = prospect.readout
    level = prospect.forecast.predict(prospect.theta, prospect.plan.take(prospect.rows[[row]]))[:, 0]
    sd = readout.noise_sd / np.sqrt(prospect.designs.n_repeats[prospect.rows[row]])
    out = []
    for weight in weights:
        truth = rng.choice(len(weight), p=weight)
        away = (level[truth] + sd * rng.standard_normal() - level) / sd
        after = weight * np.exp(-0.5 * away**2)
        out.append(after / after.sum())
    return out
