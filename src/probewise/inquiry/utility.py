"""How much a reading at each place would be worth: one small function a utility, behind one seam."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, require_finite
from probewise.errors import ParameterError, ShapeError

__all__ = ["Prospect", "ReadingEntropy", "Utility"]


@dataclass(frozen=True, eq=False)
class Prospect:
    """What may be read at each place, by every hypothesis that is still believed.

    `predicted` holds noise-free readings, shape (n_samples, n_places); `noise_sd` the sd of
    the noise on each, broadcastable to that shape.
    """

    predicted: FloatArray
    noise_sd: FloatArray

    def __post_init__(self) -> None:
        if self.predicted.ndim != 2 or 0 in self.predicted.shape:
            raise ShapeError(f"predicted has shape {self.predicted.shape}; allowed: (n_samples, n_places), none empty")
        require_finite("predicted", self.predicted)


class Utility(Protocol):
    """Worth of a reading at each place; more is better. A frozen dataclass, so that a journal can name it."""

    def __call__(self, prospect: Prospect) -> FloatArray:
        """Value every place, predictions (n_samples, n_places) -> (n_places,)."""
        ...


@dataclass(frozen=True)
class ReadingEntropy:
    """Shannon entropy, in bits, of the readings that the hypotheses predict (paper, the machine learning system).

    The predictions are noise-free and fall into fixed bins, `bin_width` wide and centred on
    its multiples: one LEGO unit rounds as the sensor does. For the naive model there are two
    readings, so the map is the paper's partition: at most one bit, where half of the circles
    contain the place.
    """

    bin_width: float = 1.0

    def __post_init__(self) -> None:
        if not (0 < self.bin_width < np.inf):
            raise ParameterError("bin_width", self.bin_width, "finite, greater than 0")

    def __call__(self, prospect: Prospect) -> FloatArray:
        """Entropy in bits at every place, (n_samples, n_places) -> (n_places,)."""
        return label_entropy(np.rint(prospect.predicted / self.bin_width))


def label_entropy(labels: FloatArray) -> FloatArray:
    """Entropy, in bits, of the labels in each column, (n_samples, n_places) -> (n_places,).

    H = log2(n) - sum_j c_j log2(c_j) / n over the distinct labels j of a column, c_j their
    counts: those are the lengths of the runs of a sorted column, found for all at once.
    """
    n_samples, n_places = labels.shape
    rows = np.sort(labels.T, axis=1)
    starts_run = np.ones((n_places, n_samples), dtype=np.bool_)
    starts_run[:, 1:] = rows[:, 1:] != rows[:, :-1]
    starts = np.flatnonzero(starts_run.ravel())
    counts = np.diff(starts, append=rows.size)
    spent = np.bincount(starts // n_samples, weights=counts * np.log2(counts), minlength=n_places)
    return np.asarray(np.maximum(np.log2(n_samples) - spent / n_samples, 0.0))
