"""The spatial sensitivity function: parameters, fields, and their summaries."""

import numpy as np
import pytest
from mixtures import fixed_mixture, total_variation

from probewise.errors import ParameterError, ShapeError
from probewise.sensor import (
    FixedMixture,
    FreeMixture,
    SSFField,
    footprint_of,
    mean_ssf_field,
    merged_mean_mixture,
    mixture_of_field,
    mixture_parameter_names,
)

TWO = np.array([[1.0, 2.0, -1.0, 0.02, 0.01, 0.004, 0.5, -6.0, 3.0, 0.05, 0.04, -0.01]])


def grid(half_mm, pixel_mm=1.0):
    return np.arange(-half_mm, half_mm + pixel_mm / 2, pixel_mm)


def paper_ssf(x, y, row):
    """The paper's eq. (Ssf) before normalisation, as printed but for B_n."""
    total = 0.0
    for a, u, v, aa, bb, cc in row.reshape(-1, 6):
        total += a * np.exp(-(aa * (x - u) ** 2 + bb * (y - v) ** 2 + 2 * cc * (x - u) * (y - v)))
    return total


def test_parameters_are_named_in_the_papers_order():
    assert " ".join(mixture_parameter_names(2)) == "a_1 u_1 v_1 A_1 B_1 C_1 a_2 u_2 v_2 A_2 B_2 C_2"
    assert FreeMixture(2).names == mixture_parameter_names(2)


def test_the_footprint_is_the_papers_formula_normalised():
    """Numerical moments of eq. (Ssf) against weights, means and covariances."""
    u = grid(60, 0.5)
    x, y = np.meshgrid(u, u)
    values = paper_ssf(x, y, TWO[0])
    values /= values.sum()
    mixture = fixed_mixture(TWO[0])
    mean = np.array([np.sum(values * x), np.sum(values * y)])
    assert mixture.mean_mm == pytest.approx(mean, abs=1e-9)
    cov = np.array(
        [[np.sum(values * (p - mean[i]) * (q - mean[j])) for j, q in enumerate((x, y))] for i, p in enumerate((x, y))]
    )
    assert mixture.cov_mm2 == pytest.approx(cov, abs=1e-7)
    footprint = footprint_of(TWO, 2)
    assert footprint.weight.sum() == pytest.approx(1.0)
    assert np.abs(mean_ssf_field(footprint, u_mm=u, v_mm=u).values - values).max() < 1e-12


@pytest.mark.parametrize("n_gaussians", [1, 2])
def test_the_mixture_of_a_field_keeps_its_moments(n_gaussians):
    field = mean_ssf_field(footprint_of(TWO, 2), u_mm=grid(50), v_mm=grid(50))
    mixture = mixture_of_field(field, n_gaussians=n_gaussians)
    assert mixture.mean_mm == pytest.approx(field.mean_mm, abs=1e-4)
    assert mixture.cov_mm2 == pytest.approx(field.cov_mm2, rel=1e-4, abs=1e-3)


def test_two_lobes_are_not_merged_into_one():
    """Two Gaussians far apart, in samples that differ a little and have them in either order."""
    rng = np.random.default_rng(2)
    one, other = [0.06, -3.0, 0.0, 0.12, 0.12, 0.0], [0.03, 4.0, 2.0, 0.06, 0.12, 0.0]
    theta = np.array([one + other, other + one] * 20)
    theta[:, [1, 2, 7, 8]] += 0.1 * rng.normal(size=(40, 4))
    field = mean_ssf_field(footprint_of(theta, 2), u_mm=grid(60), v_mm=grid(60))
    assert total_variation(merged_mean_mixture(footprint_of(theta, 2), n_gaussians=2), field) < 0.01
    assert len(merged_mean_mixture(footprint_of(theta[[0, 0, 0]], 2), n_gaussians=9).weights) == 2


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: footprint_of(np.array([[1.0, 0, 0, 0.1, 0.1, 0.2]]), 1), "A B - C.2"),
        (
            lambda: footprint_of(np.array([[-1.0, 0, 0, 0.1, 0.1, 0.0]]), 1),
            "mass of the SSF is -10.0.*; allowed: greater than 0",
        ),
        (lambda: footprint_of(np.zeros((1, 5)), 1), r"allowed: \(n_samples, 6\)"),
        (lambda: mixture_parameter_names(0), "n_gaussians is 0; allowed: 1 or more"),
        (lambda: FixedMixture([1.0], [[0.0, 0.0]], [[[1.0, 2.0], [2.0, 1.0]]]), "positive definite"),
        (lambda: FixedMixture([0.0], [[0.0, 0.0]], [np.eye(2)]), "weights"),
        (lambda: FixedMixture([1.0], [[0.0]], [np.eye(2)]), "means_mm has shape"),
        (lambda: SSFField(np.zeros((3, 3)), 1.0, (0.0, 0.0)), "sum of the SSF field is 0.0"),
        (lambda: SSFField(np.ones((3, 3)), 0.0, (0.0, 0.0)), "pixel_mm is 0.0"),
        (lambda: SSFField(np.ones(3), 1.0, (0.0, 0.0)), "SSF field has shape"),
        (lambda: mean_ssf_field(footprint_of(TWO, 2), u_mm=grid(5), v_mm=grid(5, 0.5)), "one spacing for both"),
        (
            lambda: mean_ssf_field(footprint_of(TWO, 2), u_mm=grid(5), v_mm=np.zeros(1)),
            "u_mm has 11 pixels, v_mm 1; allowed",
        ),
    ],
)
def test_an_ssf_that_cannot_be_is_named(build, message):
    with pytest.raises((ParameterError, ShapeError), match=message):
        build()
