from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from probewise._arrays import FloatArray
from probewise.calibration import SSFPrior, default_prior
from probewise.calibration.reference import Reference, has_reference
from probewise.errors import ParameterError
from probewise.inference import SensorProblem
from probewise.priors import LogUniform, Uniform
from probewise.recordings import Recording


class _Silent:
    """A recording that says nothing: the posterior is the prior, the evidence one."""

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        return np.zeros(len(theta))


def _sorted_draws(prior: SSFPrior, n: int, rng: np.random.Generator) -> FloatArray:
    """Draw from the prior and sort the Gaussians by mass."""
    space = prior.coordinates
    return space.leave(space.enter(prior.from_unit_cube(rng.random((n, len(prior.names))))))[0]


@pytest.fixture
def references(recording: Recording) -> dict[int, Reference]:
    silent = cast("SensorProblem", _Silent())
    return {n: Reference(default_prior(recording, n), silent) for n in (2, 3)}


@pytest.mark.parametrize("n", [2, 3])
def test_weights_turn_draws_of_the_reference_into_those_of_the_prior(
    references: dict[int, Reference], recording: Recording, n: int
) -> None:
    """Mean weight one, and moments of the prior's own draws; four standard errors, so one false alarm in 16 000."""
    rng = np.random.default_rng(31)
    reference = references[n]
    drawn = reference.draw(_sorted_draws(default_prior(recording, n - 1), 10_000, rng), rng=rng)
    weight = np.zeros(len(drawn))
    alive = np.flatnonzero(np.isfinite(drawn).all(axis=1))
    alive = alive[np.isfinite(reference.prior.log_prob(drawn[alive]))]
    weight[alive] = np.exp(-reference.log_likelihood(drawn[alive]))
    assert 0.5 < len(alive) / len(drawn) < 1.0
    assert abs(weight.mean() - 1.0) < 4 * weight.std() / np.sqrt(len(weight))
    plain = _sorted_draws(reference.prior, 10_000, rng)

    def asked(theta: FloatArray) -> FloatArray:
        """The first is narrower along x' than the last, the last sits left of it."""
        return ((theta[:, 3] > theta[:, -5]) & (theta[:, -7] < theta[:, 1])).astype(float)

    found = np.zeros(len(drawn))
    found[alive] = weight[alive] * asked(drawn[alive])
    error = np.hypot(found.std(), asked(plain).std()) / np.sqrt(len(drawn))
    assert abs(found.mean() - asked(plain).mean()) < 4 * error


@pytest.mark.parametrize("n", [2, 3])
def test_a_split_keeps_light_centre_and_covariance(
    references: dict[int, Reference], recording: Recording, n: int
) -> None:
    rng = np.random.default_rng(32)
    rest = _sorted_draws(default_prior(recording, n - 1), 200, rng)
    split = references[n].split(rest, rng=rng)
    alive = np.isfinite(split).all(axis=1)
    assert alive.sum() > 50
    np.testing.assert_allclose(references[n].merged(split[alive]), rest[alive], rtol=1e-6)
    space = references[n].prior.coordinates
    np.testing.assert_allclose(space.leave(space.enter(split[alive]))[0], split[alive], rtol=1e-9)  # sorted already


def test_only_a_uniform_prior_of_light_has_a_reference(recording: Recording) -> None:
    usual = default_prior(recording, 2)
    paper = SSFPrior(2, usual.offset_mm, LogUniform(0.001, 1.0), usual.i_min, Uniform(50.0, 60.0))
    assert has_reference(usual)
    assert not has_reference(paper)
    with pytest.raises(ParameterError, match="prior"):
        Reference(paper, cast("SensorProblem", _Silent()))
