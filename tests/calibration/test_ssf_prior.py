import math
from dataclasses import replace

import numpy as np
import pytest

from probewise.calibration import SSFPrior, blind_axis_rad, default_prior, scan_geometry
from probewise.errors import ParameterError
from probewise.priors import LogUniform, Uniform
from probewise.recordings import HalfPlane, Recording, paper_plan


def _edge_recording(scale_mm=1.0):
    plan = paper_plan()
    plan = replace(plan, x_mm=plan.x_mm * scale_mm)
    return Recording(plan, 10 + 50 / (1 + np.exp(-plan.x_mm / scale_mm / 4)))


@pytest.mark.parametrize("unit_mass_mm2", [None, 1 / 3])
def test_the_density_integrates_to_one_over_a_single_gaussian(unit_mass_mm2):
    """Importance sampling from a wider box, an independent route to the normalisation."""
    prior = SSFPrior(1, Uniform(-2, 2), LogUniform(0.1, 3), Uniform(0, 1), Uniform(4, 5), unit_mass_mm2=unit_mass_mm2)
    rng = np.random.default_rng(1)
    n = 400_000
    low = np.array([0, -2, -2, 0.1, 0.1, -3, 0, 4])
    high = np.array([1, 2, 2, 3, 3, 3, 1, 5])
    box = rng.uniform(low, high, (n, 8))
    weight = np.exp(prior.log_prob(box)) * np.prod(high - low)
    assert abs(weight.mean() - 1) < 5 * weight.std() / math.sqrt(n)


@pytest.mark.parametrize(("column", "value"), [(3, 0.0), (3, -0.1), (4, 0.0), (5, 1e3)])
def test_a_gaussian_that_is_not_positive_definite_has_no_density_and_warns_of_nothing(column, value):
    prior = default_prior(_edge_recording(), 2)
    theta = prior.from_unit_cube(np.random.default_rng(5).random((50, 14)))
    theta[:, column] = value
    assert (prior.log_prob(theta) == -np.inf).all()


def test_the_paper_plan_gives_widths_from_half_a_step_to_a_quarter_of_the_span():
    g = scan_geometry(_edge_recording())
    assert (g.step_mm, g.span_mm, g.albedo_low, g.albedo_high, g.inverted) == (1.0, 100.0, 0.0, 1.0, False)
    prior = default_prior(_edge_recording(), 1)
    assert isinstance(prior.precision, LogUniform)
    assert 1 / math.sqrt(2 * prior.precision.high) == pytest.approx(0.5)
    assert 1 / math.sqrt(2 * prior.precision.low) == pytest.approx(25.0)
    assert len(prior.table_rows()) == 6


def test_levels_are_scaled_from_grey_patterns_to_black_and_white():
    plan = paper_plan()
    grey = dict.fromkeys(plan.pattern_names, HalfPlane(0.0, 0.0, inside=0.8, outside=0.3))
    plan = replace(plan, patterns=grey)
    prior = default_prior(Recording(plan, np.where(plan.x_mm > 0, 90.0, 40.0)), 1)
    assert (prior.i_min.low + prior.i_min.high) / 2 == pytest.approx(10.0)
    assert (prior.i_max.low + prior.i_max.high) / 2 == pytest.approx(110.0)


@pytest.mark.parametrize(
    ("rows", "change", "message"),
    [
        (slice(None), lambda r: np.full_like(r, 7.0), "all 408 usable readings equal 7"),
        (slice(None), lambda r: np.arange(r.size) * 1e-300, "whose squares no float holds'; allowed: another unit"),
        (slice(None), lambda r: np.full_like(r, np.nan), "none usable"),
        (slice(404, 408), lambda r: np.array([20.0, 21.0, 12.0, 11.0]), "one place"),
        ([60, 60, 90], lambda r: np.array([3.0, 4.0, np.nan]), "every usable reading taken at one place"),
        (slice(0, 20), lambda r: np.linspace(10, 11, 20), "both sides"),
    ],
)
def test_a_recording_without_contrast_is_refused(rows, change, message):
    whole = _edge_recording()
    plan = whole.plan.take(np.arange(len(whole))[rows])
    with pytest.raises(ParameterError, match=message):
        default_prior(Recording(plan, change(np.zeros(len(plan)))), 1)


def test_edges_in_one_direction_leave_the_axis_across_them_unseen():
    """Scans at 0 and 180 degrees see x' only, those at 90 and 270 degrees y' only."""
    whole = _edge_recording()
    assert blind_axis_rad(whole) is None
    assert blind_axis_rad(whole.take(np.arange(202))) is None
    assert blind_axis_rad(whole.take(np.r_[0:101, 202:303])) == pytest.approx(math.pi / 2)
    assert blind_axis_rad(whole.take(np.r_[101:202, 303:404])) == pytest.approx(0.0, abs=1e-9)
    assert blind_axis_rad(whole.take(np.r_[0:101, 404:405])) is None
