"""Known mixtures from the paper's parameters, how far one is from a field, and what each Gaussian of it sees."""

import numpy as np
from scipy.stats import multivariate_normal

from probewise.sensor import ACCURATE_NODES, FixedMixture, footprint_of
from probewise.sensor.gaussian import LabGaussian, mean_albedo_under_one_gaussian


def fixed_mixture(theta):
    """The mixture of one row of the paper's parameters a_1 to C_N, (6 n_gaussians,)."""
    found = footprint_of(np.asarray(theta)[None], len(theta) // 6)
    means = np.stack([found.u_mm, found.v_mm], axis=-1)[0, 0]
    covs = np.stack([found.var_u, found.cov_uv, found.cov_uv, found.var_v], axis=-1)[0, 0]
    return FixedMixture(found.weight[0, 0], means, covs.reshape(-1, 2, 2))


def total_variation(mixture, field):
    """The largest difference of any response, on the field's pixels; mass of the mixture outside counts in full."""
    parts = zip(mixture.weights, mixture.means_mm, mixture.covs_mm2, strict=True)
    density = sum(w * multivariate_normal(mean, cov).pdf(field.centers_mm) for w, mean, cov in parts)
    shares = density * field.pixel_mm**2
    return 0.5 * (np.abs(shares - field.values.ravel()).sum() + max(0.0, 1.0 - shares.sum()))


def mean_albedo_under_gaussians(region, *moments, n_nodes=ACCURATE_NODES):
    """Mean albedo, (n_samples, n_points, n_gaussians), from arrays x, y, var x, var y, cov in the lab frame."""
    arrays, zero = np.broadcast_arrays(*moments), np.zeros((1, 1))
    layers = []
    for g in range(arrays[0].shape[2]):
        x, y, *variances = (a[:, :, g] for a in arrays)
        seen = mean_albedo_under_one_gaussian(region, LabGaussian(x, y, zero, zero, *variances), n_nodes)
        layers.append(np.broadcast_to(seen, np.broadcast_shapes(x.shape, (region.n_regions, 1))))
    return np.stack(layers, axis=-1)
