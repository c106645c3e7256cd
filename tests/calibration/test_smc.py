from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
import pytest

from probewise._arrays import FloatArray
from probewise.calibration import SMCResult, TemperatureSummary, calibrate, default_prior
from probewise.calibration.compensation import CompensatedShapeProposal
from probewise.calibration.faint_gaussian_reference import FaintGaussianReferenceDensity
from probewise.calibration.order_problems import ProblemsByOrder
from probewise.calibration.order_search import search_prior_of_order
from probewise.calibration.posterior_parts import FootprintPlaceAndSize
from probewise.calibration.quick_fit import fit_orders_quickly
from probewise.calibration.smc import run_smc
from probewise.calibration.whole_coordinates import FAINT
from probewise.errors import ParameterError
from probewise.inference import SensorProblem
from probewise.nested import NestedResult, RoundSummary
from probewise.priors import Uniform
from probewise.recordings import Recording


@pytest.fixture(scope="module")
def compensation(make_compensation: Callable[..., CompensatedShapeProposal]) -> CompensatedShapeProposal:
    return make_compensation(2, np.random.default_rng(40), spread=1e-3)


class _Levels:
    """Readings that fix the levels alone, as well with any Gaussians: the evidence is that of the levels."""

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        return np.asarray(-0.5 * (((theta[:, -2] - 11.0) / 2.0) ** 2 + ((theta[:, -1] - 58.0) / 2.0) ** 2))


def _climbed(
    recording: Recording, compensation: CompensatedShapeProposal, seed: int
) -> tuple[SMCResult, list[TemperatureSummary]]:
    rng = np.random.default_rng(seed)
    below, prior = default_prior(recording, 1), default_prior(recording, 2)
    rest = below.from_unit_cube(rng.random((400, 8)))
    rest[:, -2:] = np.array([11.0, 58.0]) + 2.0 * rng.standard_normal((400, 2))
    problem = cast("SensorProblem", _Levels())
    rungs: list[TemperatureSummary] = []
    found = run_smc(
        problem,
        FaintGaussianReferenceDensity(prior, problem, compensation, 1),
        rest,
        log_z_below=np.full(8, -3.0),
        error_below=0.0,
        rng=rng,
        space=FootprintPlaceAndSize((0.0, 0.0), 50.0).whole_footprint_coordinates(prior, 1),
        n_steps=5,
        progress=rungs.append,
    )
    return found, rungs


def test_a_climb_finds_no_gain_where_there_is_none(
    recording: Recording, compensation: CompensatedShapeProposal
) -> None:
    """The likelihood does not ask for the Gaussians: the evidence is that of the levels, times a part of the prior.

    The lighter of two uniform masses is below a tenth of the other. Four errors.
    """
    found, rungs = _climbed(recording, compensation, 41)
    assert abs(found.log_z + 3.0 - np.log(FAINT)) < 4 * found.log_z_error < 1.0
    assert not found.warnings
    assert found.weight.sum() == pytest.approx(1.0)
    assert [rung.temperature for rung in rungs] == list(found.temperatures[1:])
    assert (rungs[-1].temperature, rungs[-1].log_z) == (1.0, found.log_z)
    assert rungs[-1].n_calls < found.n_calls
    assert "no doubt" not in found.summary()
    assert found.samples(500, rng=np.random.default_rng(1)).shape == (500, 14)


def test_moves_leave_the_posterior_as_it_is(recording: Recording, compensation: CompensatedShapeProposal) -> None:
    """The levels stay normal, the Gaussians as in the prior: means within five errors of independent clouds."""
    found, _ = _climbed(recording, compensation, 42)
    prior = default_prior(recording, 2)
    u = prior.to_unit_cube(found.theta)
    # Centres of all Gaussians are uniform, whichever is the heavier.
    values = np.column_stack([found.theta[:, -2] - 11.0, found.theta[:, -1] - 58.0, u[:, [1, 2, 7, 8]] - 0.5])
    clouds = values.reshape(8, -1, values.shape[1]).mean(axis=1)
    assert (np.abs(clouds.mean(axis=0)) < 5 * clouds.std(axis=0, ddof=1) / np.sqrt(8)).all()


def test_a_climb_that_clouds_disagree_on_is_doubtful(
    recording: Recording, compensation: CompensatedShapeProposal
) -> None:
    found, _ = _climbed(recording, compensation, 43)
    apart = replace(found, log_z_of_clouds=np.array([5.0, *np.zeros(7)]))
    assert any("clouds are worth" in note for note in apart.warnings)
    assert "doubtful" in apart.summary()
    assert any("not reached" in note for note in replace(found, temperatures=np.array([0.0, 0.5])).warnings)
    assert any("accepted" in note for note in replace(found, accepted=0.001).warnings)


def test_other_priors_of_light_are_searched_in_full(recording: Recording) -> None:
    def paper(given: Recording, n: int) -> object:
        return replace(default_prior(given, n), unit_mass_mm2=None)

    def growing(given: Recording, n: int) -> object:
        return replace(default_prior(given, n), i_min=Uniform(-1.0 * n, 40.0))

    for prior, why in ((paper, "not uniform"), (growing, "differs from order to order")):
        problems = ProblemsByOrder(recording, prior)
        search = partial(search_prior_of_order, problems, n_live=50)
        found, notes = fit_orders_quickly(problems, (1, 2), search=search, rng=np.random.default_rng(0))
        assert not found
        assert why in notes[0]


def test_few_readings_are_searched_in_full(recording: Recording) -> None:
    few = Recording(recording.plan.take(np.arange(0, 135, 2)), recording.readings[::2])
    problems = ProblemsByOrder(few, default_prior)
    search = partial(search_prior_of_order, problems, n_live=50)
    found, notes = fit_orders_quickly(problems, (1, 2), search=search, rng=np.random.default_rng(0))
    assert not found
    assert "68 usable readings" in notes[0]


def test_quick_is_yes_or_no(recording: Recording) -> None:
    with pytest.raises(ParameterError, match="quick"):
        calibrate(recording, quick="yes", rng=np.random.default_rng(0))  # type: ignore[arg-type]


@pytest.mark.slow
def test_climbing_and_searching_find_the_same_evidences(recording: Recording) -> None:
    """Within four of both errors."""
    told: list[tuple[int, RoundSummary | TemperatureSummary]] = []
    quick = calibrate(
        recording,
        orders=(1, 2, 3),
        quick=True,
        rng=np.random.default_rng(44),
        progress=lambda n, state: told.append((n, state)),
    )
    full = calibrate(recording, orders=(1, 2, 3), n_live=200, rng=np.random.default_rng(45))
    assert isinstance(quick.fits[1].result, SMCResult)
    assert isinstance(full.fits[1].result, NestedResult)
    for one, other in zip(quick.orders, full.orders, strict=True):
        assert abs(one.log_z - other.log_z) < 4 * np.hypot(one.log_z_error, other.log_z_error)
    assert quick.chosen.n_gaussians == full.chosen.n_gaussians == 1
    assert {n for n, state in told if isinstance(state, TemperatureSummary)} == {1, 2, 3}
