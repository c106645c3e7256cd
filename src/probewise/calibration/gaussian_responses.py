"""Responses of readings to single Gaussians of an SSF: a mixture's response is their mean, weighted by light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.inference import SensorProblem


@dataclass(frozen=True, eq=False)
class SingleGaussianResponses:
    """Responses of the usable readings, 0 over black to 1 over white, to one Gaussian.

    `alone`: problem of one Gaussian over the recording.
    """

    alone: SensorProblem

    def responses_to_gaussians(self, gaussian: FloatArray) -> FloatArray:
        """Return the responses to Gaussians, whose amplitude does not matter, (n, 6) -> (n, n_used)."""
        if not len(gaussian):
            return np.empty((0, int(self.alone.recording.usable.sum())))
        levels = np.broadcast_to([0.0, 1.0], (len(gaussian), 2))
        lone = np.concatenate([np.ones((len(gaussian), 1)), gaussian[:, 1:], levels], axis=1)
        seen = self.alone.model.predict(lone, self.alone.recording.plan)
        usable = self.alone.recording.usable
        return seen if usable.all() else seen[:, usable]

    def responses_by_gaussian(self, theta: FloatArray) -> FloatArray:
        """Return the responses to each Gaussian of mixtures, (n, 6 N + 2) -> (n, N, n_used)."""
        n_gaussians = theta.shape[1] // 6
        seen = self.responses_to_gaussians(theta[:, :-2].reshape(-1, 6))
        return seen.reshape(len(theta), n_gaussians, seen.shape[1])


def total_light_by_gaussian(theta: FloatArray) -> FloatArray:
    """Light that each Gaussian holds, up to a common factor, (n, 6 N + 2) -> (n, N)."""
    g = theta[:, :-2].reshape(len(theta), -1, 6)
    return np.asarray(g[..., 0] / np.sqrt(g[..., 3] * g[..., 4] - g[..., 5] ** 2))
