"""Responses to each Gaussian of a mixture by itself: those to the mixture are their mean, weighted by light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray
from probewise.inference import SensorProblem


@dataclass(frozen=True, eq=False)
class LoneResponses:
    """Responses of the usable readings, between 0 over black and 1 over white, to one Gaussian.

    Parameters
    ----------
    alone
        Problem of one Gaussian over the recording.
    """

    alone: SensorProblem

    def to(self, gaussian: FloatArray) -> FloatArray:
        """Respond to Gaussians of any amplitude, (n, 6) -> (n, n_used)."""
        if not len(gaussian):
            return np.empty((0, int(self.alone.recording.usable.sum())))
        levels = np.broadcast_to([0.0, 1.0], (len(gaussian), 2))
        lone = np.concatenate([np.ones((len(gaussian), 1)), gaussian[:, 1:], levels], axis=1)
        seen = self.alone.model.predict(lone, self.alone.recording.plan)
        usable = self.alone.recording.usable
        return seen if usable.all() else seen[:, usable]

    def to_each(self, theta: FloatArray) -> FloatArray:
        """Respond to each Gaussian of mixtures, (n, 6 N + 2) -> (n, N, n_used)."""
        n_gaussians = theta.shape[1] // 6
        seen = self.to(theta[:, :-2].reshape(-1, 6))
        return seen.reshape(len(theta), n_gaussians, seen.shape[1])


def light_of(theta: FloatArray) -> FloatArray:
    """Light of each Gaussian, up to a factor that they have in common, (n, 6 N + 2) -> (n, N)."""
    g = theta[:, :-2].reshape(len(theta), -1, 6)
    return np.asarray(g[..., 0] / np.sqrt(g[..., 3] * g[..., 4] - g[..., 5] ** 2))
