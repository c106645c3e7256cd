"""Known mixtures from the paper's parameters, and how far a mixture is from a field."""

import numpy as np
from scipy.stats import multivariate_normal

from probewise.sensor import FixedMixture, footprint_of


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
