"""The quick way: climbs to peaks, draws about them, and searches."""

import numpy as np
import pytest

from probewise.calibration import calibrate, default_prior, quick
from probewise.calibration.paper import ProblemsByOrder
from probewise.calibration.peaks import LightContrasts, StudentTDensity, _MixtureAboutPeaks, climb, starts_of_climbs
from probewise.calibration.quick import _NearPosterior, fit_orders_quickly
from probewise.nested import Weighted
from probewise.recordings import paper_plan
from probewise.world import Blob, World, gaussian_spot


@pytest.fixture(scope="module")
def two_lobes():
    """A sensor of two spots of equal light, 8 mm apart."""
    spot = gaussian_spot([Blob(0.5, (3.5, 2.0), (2.5, 3.0)), Blob(0.5, (-3.5, -2.0), (2.5, 3.0))])
    return World(spot, noise_sd=0.4).simulate(paper_plan(), rng=np.random.default_rng(8))


def climbed(recording, order, seed):
    """Climb from the starts of each order up to `order`; return ends and ln L of the last."""
    problems, rng = ProblemsByOrder(recording, default_prior), np.random.default_rng(seed)
    ends = np.empty((0, 8))
    for n in range(1, order + 1):
        problem = problems.problem(n)
        ends, high = climb(problem, problems.problem(1), starts_of_climbs(problem, ends[:3], rng))
    return ends, high


def test_two_lobes_are_climbed(two_lobes):
    assert climbed(two_lobes, 2, 13)[1][0] > climbed(two_lobes, 1, 13)[1][0] + 50
    centres = climbed(two_lobes, 2, 13)[0][0, [1, 2, 7, 8]].reshape(2, 2)
    np.testing.assert_allclose(np.abs(centres), [[3.5, 2.0], [3.5, 2.0]], atol=0.4)


@pytest.mark.parametrize("n", [1, 2])
def test_the_prior_integrates_to_one_by_draws_about_a_peak(recording, n):
    """Draws of a Student-t that is fitted to the prior weigh one on average; five errors."""
    prior, rng = default_prior(recording, n), np.random.default_rng(3)
    space = LightContrasts(prior)
    y = space.enter(prior.from_unit_cube(rng.random((4000, 6 * n + 2))))
    density = StudentTDensity(y.mean(axis=0), np.linalg.cholesky(np.cov(y, rowvar=False)))
    weight = np.exp(-_MixtureAboutPeaks(space, [density], np.ones(1)).draw(40_000, rng)[2])
    error = weight.std() * np.sqrt(len(weight)) / 40_000
    assert abs(weight.sum() / 40_000 - 1.0) < 5 * error < 0.3


def test_a_prior_with_place_and_levels_about_a_peak_is_a_density(recording):
    """Its mean over the prior is one where the prior reaches, and its coordinates lead there and back. Five errors."""
    prior, rng = default_prior(recording, 2), np.random.default_rng(3)
    space = prior.coordinates
    place = space.enter(prior.from_unit_cube(rng.random((4000, 14))))[:, quick._PLACE]
    near = _NearPosterior(prior, StudentTDensity(place.mean(axis=0), 0.5 * np.linalg.cholesky(np.cov(place.T))))
    theta = prior.from_unit_cube(rng.random((100_000, 14)))
    weight = np.exp(-near.log_prior_ratio(space.leave(space.enter(theta))[0]))
    x = near.draw(20_000, rng=rng)
    back, log_density = near.leave(x)
    inside = np.isfinite(log_density)
    error = np.hypot(weight.std() / np.sqrt(len(weight)), 0.5 / np.sqrt(len(x)))
    assert abs(weight.mean() - inside.mean()) < 5 * error < 0.1
    np.testing.assert_allclose(near.enter(back[inside]), x[inside], atol=1e-6)
    np.testing.assert_allclose(space.leave(x[inside])[1] - near.log_prior_ratio(back[inside]), log_density[inside])


@pytest.fixture
def with_evidences(monkeypatch):
    """Return a function that gives each order its evidence, by draws and by nested sampling."""

    def give(log_z):
        def made(problem, *_, **__):
            names, n = problem.prior.names, problem.prior.n_gaussians
            theta = np.tile([*n * [1.0, 0.5, 1.5, 0.05, 0.05, 0.0], 11.0, 58.0], (300, 1))
            even = np.full(300, -np.log(300.0))
            found = Weighted(names, theta, np.zeros(300), even, log_z[n], 1.0, 300.0, 1, pareto_k=0.0)
            return found, lambda theta: np.zeros(len(theta))

        monkeypatch.setattr(quick, "weigh_draws_about_peaks", made)
        monkeypatch.setattr(quick, "_sample_near_peaks", made)
        monkeypatch.setattr(quick, "_run_silently", lambda *_: None)

    return give


def test_orders_are_fitted_until_the_evidence_has_clearly_fallen(recording, with_evidences, monkeypatch):
    """A fall by 2 is not clear with an error of 1; one by 4 is."""
    monkeypatch.setattr(quick, "_missed_part_in_words", lambda *_: "")
    with_evidences({1: -100.0, 2: -102.0, 3: -104.0, 4: -90.0})
    found = calibrate(recording, orders=(1, 2, 3, 4), quick=True, rng=np.random.default_rng(2))
    assert [o.n_gaussians for o in found.orders] == [1, 2, 3]
    assert found.chosen.n_gaussians == 1
    assert any("order 4 not tried" in note for note in found.sensor.notes)


def test_the_order_that_missed_a_peak_and_those_above_are_searched(calibration, recording, with_evidences, monkeypatch):
    """Of three the second is chosen; the first stays as it is."""
    searched = []

    def search(n, _):
        searched.append(n)
        return calibration.chosen.found

    with_evidences({1: -1000.0, 2: 900.0, 3: 899.0})
    monkeypatch.setattr(quick, "_missed_part_in_words", lambda *_: "it lies elsewhere")
    problems, rng = ProblemsByOrder(recording, default_prior), np.random.default_rng(0)
    found, note = fit_orders_quickly(problems, (1, 2, 3), search=search, rng=rng)
    assert searched == [2, 3]
    assert not note
    assert not found[1].notes
    assert all(f"order {n} was searched in full, since the quick way missed" in found[n].notes[-1] for n in (2, 3))


def test_few_readings_are_searched_in_full(recording):
    problems = ProblemsByOrder(recording.take(np.arange(60)), default_prior)
    found = fit_orders_quickly(problems, (1,), search=None, rng=np.random.default_rng(1))
    assert found == ({}, "searched in full: 60 usable readings, fewer than 80")
