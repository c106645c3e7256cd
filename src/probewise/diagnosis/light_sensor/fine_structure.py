"""Structure of an SSF that is finer than any form fitted to it.

A ring, a ridge's shadow or a sharp rim is neither a mixture of Gaussians nor of the free form: it leaves residuals of
one to three noise sds in all, which are not physics. Narrow Gaussians of small weight, spread over the footprint,
absorb them to first order. They are not part of any fit: the global test checks whether its alarm persists when they
are projected out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.calibration import mixture_moments
from probewise.diagnosis.fitting.coordinates import CalibratedSensor
from probewise.diagnosis.fitting.fit import Model
from probewise.sensor import FAST_NODES, FreeMixture

# In sds of the SSF, in its own metric.
_REACH = 2.4
_APART = 0.6
_WIDTH = 0.35
_SHARE = 0.03  # prior sd of each weight, as a share of the mass


def fine_structure_slopes(model: Model, z: FloatArray, usable: IntArray) -> FloatArray:
    """Return the slopes of the readings by fine structure about an SSF, in coordinates with a standard normal prior.

    Parameters
    ----------
    model
        A sensor calibrated from the recording, without effects.
    z
        Its coordinates, (n_params,).
    usable
        Numbers of the plan's rows to use.

    Returns
    -------
    Slopes, (n_usable, n_places), in reading units; no columns if the model is no `CalibratedSensor`.
    """
    sensor = model.sensor
    if not isinstance(sensor, CalibratedSensor):
        return np.zeros((len(usable), 0))
    theta = sensor.theta(z[None, :])
    of_all = {name: float(values[0]) for name, values in mixture_moments(theta, sensor.n_gaussians).items()}
    sd_u, sd_v = (np.exp(of_all[f"log width along {axis}"]) for axis in ("x'", "y'"))
    cov = of_all["correlation of x' and y'"] * sd_u * sd_v
    covariance = np.array([[sd_u**2, cov], [cov, sd_v**2]])
    center = np.array([of_all["centre x'"], of_all["centre y'"]])
    places = center + _PLACES @ np.linalg.cholesky(covariance).T
    (aa, cc), (_, bb) = np.linalg.inv(_WIDTH**2 * covariance) / 2
    levels = theta[0, 6 * sensor.n_gaussians :]
    narrow = np.array([[1.0, u, v, aa, bb, cc, *levels] for u, v in places])
    chain = replace(sensor.chain(model.plan, (), n_nodes=FAST_NODES), ssf=FreeMixture(1))
    whole = model.predict(z[None, :])[0]  # normalised, so that the total weight is unchanged
    return np.asarray(_SHARE * (chain.predict(narrow, model.plan) - whole)[:, usable].T)


def _hexagonal_grid() -> FloatArray:
    """Return places on a hexagonal grid over a disc, (n, 2)."""
    steps = np.arange(-8, 9)
    i, j = (a.ravel() for a in np.meshgrid(steps, steps))
    places = _APART * np.stack([i + j / 2, j * np.sqrt(3) / 2], axis=-1)
    return np.asarray(places[np.hypot(*places.T) <= _REACH])


_PLACES = _hexagonal_grid()
