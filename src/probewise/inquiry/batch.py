"""The choice of several readings at once (a batch)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.inquiry.choice import choose
from probewise.inquiry.forecast import resampled_rows_and_weights
from probewise.inquiry.utility_input import UtilityInput

_OUTCOMES = 16  # simulated outcomes of the readings chosen so far
_FEW = 600  # hypotheses used to simulate them


def choose_several(
    utility_input: UtilityInput, n: int, *, rng: np.random.Generator, chance: FloatArray | None = None
) -> tuple[int, ...]:
    """Choose readings with large joint information, greedily one after another.

    Greedy on the joint information I(y_1 ... y_n) = I(y_1) + I(y_2 | y_1) + .... With exact terms it reaches at least
    1 - 1/e (63 %) of the information of the best set (Nemhauser, Wolsey & Fisher 1978). Here each conditional
    information is averaged over simulated outcomes: each is a draw from the predictive distribution, with its own
    posterior.

    Parameters
    ----------
    utility_input
        Posterior, designs and sensor.
    n
        Number of readings, 1 or more; else ParameterError.
    rng
        Source of randomness.
    chance
        Probability that a reading at each of `utility_input.rows` returns a value, (n,), by which its information
        counts; None: all do.

    Returns
    -------
    Indices of designs, from `utility_input.rows`, in the order in which they were chosen; two may be the same.
    """
    if n < 1:
        raise ParameterError("n", n, "1 or more")
    everywhere = np.ones(len(utility_input.rows), dtype=np.bool_)
    weighing = np.ones(1) if chance is None else chance
    chosen = [choose(utility_input.information(utility_input.weight) * weighing, everywhere, rng=rng)]
    rows, share = resampled_rows_and_weights(utility_input.weight, _FEW)
    few = replace(utility_input, theta=utility_input.theta[rows], weight=share / share.sum())
    weights = [few.weight] * _OUTCOMES
    for _ in range(n - 1):
        weights = _weights_after_simulated_reading(few, chosen[-1], weights, rng)
        gain = np.mean([few.information(weight) for weight in weights], axis=0)
        chosen.append(choose(gain * weighing, everywhere, rng=rng))
    return tuple(int(utility_input.rows[row]) for row in chosen)


def _weights_after_simulated_reading(
    utility_input: UtilityInput, row: int, weights: list[FloatArray], rng: np.random.Generator
) -> list[FloatArray]:
    """Simulate one reading per posterior at design `utility_input.rows[row]`; return the posteriors' weights after it.

    `weights`: of each posterior, (n_samples,).
    """
    readout = utility_input.readout
    level = utility_input.forecast.predict(utility_input.theta, utility_input.plan.take(utility_input.rows[[row]]))[
        :, 0
    ]
    sd = readout.noise_sd / np.sqrt(utility_input.designs.n_repeats[utility_input.rows[row]])
    out = []
    for weight in weights:
        truth = rng.choice(len(weight), p=weight)
        away = (level[truth] + sd * rng.standard_normal() - level) / sd
        after = weight * np.exp(-0.5 * away**2)
        out.append(after / after.sum())
    return out
