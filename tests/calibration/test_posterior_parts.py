"""Parts of a posterior by the number of bright Gaussians."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probewise._arrays import FloatArray
from probewise.calibration import SMCResult
from probewise.calibration.posterior_parts import (
    evidence_shares,
    join_smc_results_of_parts,
    split_posterior_by_n_bright,
)

_N = 8 * 4 * 20


def climbed(light: float, log_z: float) -> SMCResult:
    """Samples of two Gaussians of which the second holds a fixed ratio of the light of the first."""
    theta = np.tile([1.0, 0.0, 0.0, 1.0, 1.0, 0.0, light, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0], (_N, 1))
    return SMCResult(
        names=tuple(f"p{k}" for k in range(14)),
        theta=theta,
        log_likelihood=np.full(_N, log_z),
        log_weight=np.full(_N, -np.log(_N)),
        log_z_of_clouds=np.full(8, log_z),
        start_error=0.1,
        temperatures=np.array([0.0, 1.0]),
        accepted=0.2,
        n_calls=10,
    )


def _bright_share(theta: FloatArray) -> float:
    return float((theta[:, 6] > 0.1).mean())


def test_parts_are_joined_by_their_evidence() -> None:
    """A quarter of the evidence; counts are rounded at random in each of 32 blocks: four sds of their mean."""
    both = join_smc_results_of_parts({1: climbed(0.01, np.log(3.0)), 2: climbed(0.5, 0.0)}, np.random.default_rng(1))
    assert both.log_z == pytest.approx(np.log(4.0))
    assert abs(_bright_share(both.theta) - 0.25) < 4 * 0.5 / 20 / np.sqrt(32)
    assert both.n_calls == 20
    assert both.start_error == pytest.approx(0.1 * np.hypot(0.75, 0.25))


def test_a_posterior_is_split_as_it_was_joined() -> None:
    both = join_smc_results_of_parts({1: climbed(0.01, np.log(3.0)), 2: climbed(0.5, 0.0)}, np.random.default_rng(2))
    parts = split_posterior_by_n_bright(both, np.random.default_rng(3))
    assert set(parts) == {1, 2}
    shares = evidence_shares(parts)
    assert shares[2] == pytest.approx(_bright_share(both.theta))
    assert _bright_share(parts[2].theta) == 1.0
    assert parts[1].log_z == pytest.approx(np.log(4.0 * shares[1]))


def test_a_part_that_is_not_reached_is_a_doubt_of_all() -> None:
    stuck = replace(climbed(0.01, 1.0), temperatures=np.array([0.0, 0.3]))
    assert join_smc_results_of_parts({1: stuck, 2: climbed(0.5, 0.0)}, np.random.default_rng(4)).warnings
