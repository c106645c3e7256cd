from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from probewise.calibration import Calibration, OrderPosterior, SMCResult, calibrate, default_prior, quick_fit
from probewise.calibration.check_by_search import search_for_missed_part, share_far_from_known
from probewise.calibration.order_problems import ProblemsByOrder
from probewise.calibration.order_search import search_prior_of_order
from probewise.calibration.quick_fit import fit_orders_quickly
from probewise.recordings import Disc, HalfPlane, Plan, Recording
from probewise.world import Blob, World, gaussian_spot


@pytest.fixture(scope="module")
def mirrored() -> Recording:
    """Edges along x and y, and discs about the origin: a footprint at 45 degrees looks like its mirror image."""
    along, still = np.linspace(-15.0, 15.0, 41), np.zeros(41)
    pattern = np.repeat(np.arange(5), [41, 41, 4, 4, 4])
    discs = {f"disc {r} mm": Disc((0.0, 0.0), r, inside=1.0, outside=0.0) for r in (1.5, 2.5, 4.0)}
    patterns = {"x": HalfPlane(0.0, 0.0, 1.0, 0.0), "y": HalfPlane(np.pi / 2, 0.0, 1.0, 0.0), **discs}
    plan = Plan(
        x_mm=np.concatenate([along, still, np.zeros(12)]),
        y_mm=np.concatenate([still, along, np.zeros(12)]),
        orientation_rad=np.zeros(94),
        time_s=np.arange(94.0),
        scan=np.minimum(pattern, 2),
        scan_names=("along x", "along y", "discs"),
        pattern=pattern,
        pattern_names=tuple(patterns),
        patterns=patterns,
    )
    spot = gaussian_spot([Blob(1.0, (0.0, 0.0), (4.0, 1.2), 0.78)])
    return World(spot, noise_sd=0.15).simulate(plan, rng=np.random.default_rng(5))


def test_samples_of_a_part_that_is_not_known_lie_apart() -> None:
    """Of samples like the known ones, one in 500 or so; of those with 40 % in another place, these."""
    rng = np.random.default_rng(1)
    known, like = rng.standard_normal((4000, 8)), rng.standard_normal((1000, 8))
    assert share_far_from_known(known, like, rng=rng) < 0.02
    like[:400] += 5.0
    assert 0.4 <= share_far_from_known(known, like, rng=rng) < 0.42


@pytest.mark.slow
def test_a_search_finds_the_mirror_image_that_a_climb_missed(mirrored: Recording) -> None:
    problems, rng = ProblemsByOrder(mirrored, default_prior), np.random.default_rng(3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quick_fit, "search_for_missed_part", lambda *_, **__: "")
        found, why = fit_orders_quickly(
            problems, (1,), search=partial(search_prior_of_order, problems, n_live=50), rng=rng
        )
    made = found[1].result
    assert not why
    assert isinstance(made, SMCResult)
    correlated = made.theta[:, 5] < 0.0
    assert correlated.all() or not correlated.any()
    assert "lie apart" in search_for_missed_part(problems, 1, made, rng=rng)


@pytest.fixture(scope="module")
def vouched(recording: Recording) -> OrderPosterior:
    problems = ProblemsByOrder(recording, default_prior)
    search = partial(search_prior_of_order, problems, n_live=50)
    return fit_orders_quickly(problems, (1,), search=search, rng=np.random.default_rng(4))[0][1]


def test_a_search_vouches_for_a_climb_that_missed_nothing(vouched: OrderPosterior) -> None:
    assert isinstance(vouched.result, SMCResult)
    assert not vouched.notes


def test_the_order_that_missed_a_peak_and_those_above_are_searched(
    vouched: OrderPosterior, calibration: Calibration, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three the second is chosen; the first stays as it is."""
    searched: list[int] = []

    def search(n: int, _: np.random.Generator) -> OrderPosterior:
        searched.append(n)
        return calibration.chosen.found

    made = vouched.result
    assert isinstance(made, SMCResult)
    low = OrderPosterior(replace(made, log_z_of_clouds=made.log_z_of_clouds - 90.0), None)
    monkeypatch.setattr(quick_fit, "search_for_missed_part", lambda *_, **__: "it lies elsewhere")
    found = quick_fit._check_chosen_order_or_search_in_full(
        ProblemsByOrder(recording, default_prior),
        {1: low, 2: vouched, 3: low},
        np.random.default_rng(0),
        search=search,
        progress=None,
    )
    assert searched == [2, 3]
    assert found[1] is low
    assert all(f"order {n} was searched in full, since the quick way missed" in found[n].notes[-1] for n in (2, 3))


@pytest.mark.slow
def test_both_mirror_images_are_in_the_calibration(mirrored: Recording) -> None:
    """Each holds a half, here of 100 live points whose error is a nat; the note says why the prior was searched."""
    found = calibrate(mirrored, orders=(1,), n_live=100, quick=True, rng=np.random.default_rng(3))
    assert any("missed a peak of order 1" in note for note in found.sensor.notes)
    share = float((found.sensor.samples[:, 5] < 0.0).mean())
    assert 0.05 < share < 0.95
