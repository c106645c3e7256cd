import numpy as np
import pytest

from probewise.calibration import draw_sd, noise_by_scan


@pytest.mark.parametrize(("q", "n"), [(25.0, 100), (0.8, 3), (1e-9, 4), (400.0, 2)])
def test_drawn_sds_follow_the_posterior_on_a_grid(q, n):
    """The posterior sd^(-1-n) exp(-Q / 2 sd^2) between the bounds, tabulated."""
    floor, ceiling = 0.05, 5.0
    residuals = np.full((20_000, n), np.sqrt(q / n))
    drawn = draw_sd(residuals, sd_floor=floor, sd_ceiling=ceiling, rng=np.random.default_rng(5))
    sd = np.geomspace(floor, ceiling, 20_001)
    log_p = -n * np.log(sd) - q / (2 * sd**2)
    mass = np.exp(log_p - log_p.max())
    ladder = np.cumsum(mass) / mass.sum()
    for share in (0.05, 0.5, 0.95):
        at = sd[np.searchsorted(ladder, share)]
        assert abs((drawn <= at).mean() - share) < 0.02 or np.isclose(at, floor, rtol=1e-2)
    assert drawn.min() >= floor
    assert drawn.max() <= ceiling


def test_residuals_beyond_both_bounds_stay_at_the_bound():
    rng = np.random.default_rng(6)
    low = draw_sd(np.zeros((3, 5000)), sd_floor=1.0, sd_ceiling=10.0, rng=rng)
    high = draw_sd(np.full((3, 5000), 1e6), sd_floor=1.0, sd_ceiling=10.0, rng=rng)
    np.testing.assert_allclose(low, 1.0, rtol=1e-2)
    np.testing.assert_allclose(high, 10.0, rtol=1e-2)


def test_every_scan_reports_its_own_noise():
    rng = np.random.default_rng(7)
    scan = np.repeat([0, 1, 2], [200, 200, 0])
    residuals = rng.normal(0, 1, (30, 400)) * np.where(scan == 0, 0.5, 2.0)
    found = noise_by_scan(residuals, scan, ("first", "second", "empty"), sd_floor=0.01, sd_ceiling=50.0, rng=rng)
    assert [(s.scan, s.n_readings) for s in found] == [("first", 200), ("second", 200)]
    assert abs(found[0].mean - 0.5) < 0.05
    assert abs(found[1].mean - 2.0) < 0.2
