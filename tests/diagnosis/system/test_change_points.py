"""When a constant changed: the posterior of the diagnosis against the closed form."""

import numpy as np
import pytest

from probewise.diagnosis import diagnose_system
from probewise.systems import Simulator

YEARS = np.arange(1871.0, 1971.0)


@pytest.fixture(scope="module")
def flow():
    """A river that carries 250 less from 1899 on; noise with sd 130."""
    return 1100.0 - 250.0 * (YEARS > 1898) + np.random.default_rng(11).normal(0.0, 130.0, len(YEARS))


def in_closed_form(readings):
    """Mean and sd of the change point: flat priors of both levels, log-uniform of the sd; marginal likelihood by gap.

    Each half has n levels about its own mean: (n1 n2)^(-1/2) S^(-(n - 2) / 2), S the sum of squares about both.
    """
    log_p, n = [], len(readings)
    for k in range(1, n):
        before, after = readings[:k], readings[k:]
        about = ((before - before.mean()) ** 2).sum() + ((after - after.mean()) ** 2).sum()
        log_p.append(-0.5 * np.log(k * (n - k)) - 0.5 * (n - 2) * np.log(about))
    p = np.exp(np.array(log_p) - max(log_p))
    p /= p.sum()
    middle = 0.5 * (YEARS[1:] + YEARS[:-1])
    mean = float(p @ middle)
    return mean, float(np.sqrt(p @ (middle - mean) ** 2 + 1 / 12))  # it is uniform within a gap


def test_a_step_that_correlated_noise_imitates_is_as_well_known_as_by_the_closed_form(flow):
    river = Simulator(
        "volume",
        "1e8 m3",
        {"mean": ("normal", 1000, 300)},
        simulate=lambda p, data: p["mean"] + 0 * data["year"],
        time="year",
        time_unit="year",
    )
    found = diagnose_system(river, {"year": YEARS, "volume": flow}, rng=np.random.default_rng(1))
    step = next(effect for effect in found.effects if effect.name == "offset_step")
    at = next(parameter for parameter in step.parameters if parameter.name == "at_s")
    mean, sd = in_closed_form(flow)
    assert sd < 3.0
    assert at.mean == pytest.approx(mean, abs=0.5 * sd)
    assert at.sd == pytest.approx(sd, rel=0.4)
