"""What is finer in an SSF than any form that is fitted to it.

A ring, a ridge's shadow or a sharp rim is no mixture of Gaussians and no free form either: of a noise-free recording
one to three noise sds are left, a little more than nothing, and it is no physics. Small shares of narrow Gaussians,
spread over the footprint, take that up to first order. They are no part of any fit: the test that nothing is missing
asks whether its alarm outlasts them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.calibration import mixture_moments
from probewise.diagnosis.coordinates import CalibratedSensor, known_scene
from probewise.diagnosis.fit import Fit
from probewise.sensor import FAST_NODES, Chain, FreeLevels, FreeMixture

__all__ = ["with_fine_structure"]

# In sds of the SSF, in its own metric.
_REACH = 2.4
_APART = 0.6
_WIDTH = 0.35
_SHARE = 0.03  # prior sd of each, of the mass


def with_fine_structure(found: Fit, usable: IntArray) -> Fit:
    """Give a null's fit the slopes of fine structure too, each a coordinate at 0 of standard normal prior.

    The fit of a model that has no SSF of its own, or what it looks at is not known, stays as it is.

    Parameters
    ----------
    found
        The fit, no effects in its model.
    usable
        Rows of the plan that it was fitted to.
    """
    model, sensor = found.model, found.model.sensor
    if not isinstance(sensor, CalibratedSensor):
        return found
    theta = sensor.theta(found.z[None, :])
    of_all = {name: float(values[0]) for name, values in mixture_moments(theta, sensor.n_gaussians).items()}
    sd_u, sd_v = (np.exp(of_all[f"log width along {axis}"]) for axis in ("x'", "y'"))
    cov = of_all["correlation of x' and y'"] * sd_u * sd_v
    covariance = np.array([[sd_u**2, cov], [cov, sd_v**2]])
    center = np.array([of_all["centre x'"], of_all["centre y'"]])
    places = center + _PLACES @ np.linalg.cholesky(covariance).T
    (aa, cc), (_, bb) = np.linalg.inv(_WIDTH**2 * covariance) / 2
    levels = theta[0, 6 * sensor.n_gaussians :]
    narrow = np.array([[1.0, u, v, aa, bb, cc, *levels] for u, v in places])
    chain = Chain(FreeMixture(1), FreeLevels(), known_scene(model.plan), (), n_nodes=FAST_NODES)
    change = chain.predict(narrow, model.plan)[:, usable] - found.predicted  # in place of as much of the whole
    slopes = np.concatenate([found.slopes, _SHARE * change.T], axis=1)
    return replace(found, slopes=slopes, z=np.concatenate([found.z, np.zeros(len(places))]))


def _hexagons() -> FloatArray:
    """Lay places evenly over a disc, (n, 2)."""
    steps = np.arange(-8, 9)
    i, j = (a.ravel() for a in np.meshgrid(steps, steps))
    places = _APART * np.stack([i + j / 2, j * np.sqrt(3) / 2], axis=-1)
    return np.asarray(places[np.hypot(*places.T) <= _REACH])


_PLACES = _hexagons()
