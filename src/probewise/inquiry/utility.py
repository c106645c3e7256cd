"""How much a reading at each design would be worth: one small function a utility, behind one seam."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.inquiry.labels import Label
from probewise.inquiry.prospect import Prospect

__all__ = ["InformationAbout", "InformationGain", "PerSecond", "ReadingEntropy", "Utility", "label_entropy"]


class Utility(Protocol):
    """Worth of a reading at each design; more is better. A frozen dataclass, so that a journal can name it."""

    @property
    def label(self) -> str:
        """What the worth is, with its unit, for a colour bar."""
        ...

    def __call__(self, prospect: Prospect) -> FloatArray:
        """Value every design that can be taken, (n,)."""
        ...


@dataclass(frozen=True)
class ReadingEntropy:
    """Shannon entropy, in bits, of the readings that a few hypotheses predict (paper, the machine learning system).

    The predictions are noise-free and fall into fixed bins, `bin_width` wide and centred on
    its multiples: one LEGO unit rounds as the sensor does. For the naive model there are two
    readings, so the map is the paper's partition: at most one bit, where half of the circles
    contain the place.
    """

    bin_width: float = 1.0

    label: ClassVar[str] = "entropy (bits)"

    def __post_init__(self) -> None:
        if not (0 < self.bin_width < np.inf):
            raise ParameterError("bin_width", self.bin_width, "finite, greater than 0")

    def __call__(self, prospect: Prospect) -> FloatArray:
        """Entropy in bits at every design, (n,)."""
        return label_entropy(np.rint(prospect.predicted / self.bin_width))


@dataclass(frozen=True)
class InformationGain:
    """Expected information, in bits, about all parameters together (Lindley 1956).

    The entropy of what may be read (uncertain parameters, noise, rounding and range together) less
    the entropy of the noise, which is all that would be left if the parameters were known.
    """

    label: ClassVar[str] = "expected information (bits)"

    def __call__(self, prospect: Prospect) -> FloatArray:
        """Bits at every design, (n,)."""
        return prospect.information(prospect.weight)


@dataclass(frozen=True)
class InformationAbout:
    """Expected information, in bits, about what a label tells apart: a function of the parameters, the kind of shape.

    The entropy of what may be read, less that which is left when the label is known: what the
    hypotheses of one label disagree on among themselves is of no interest.
    """

    of: Label

    @property
    def label(self) -> str:
        """Information, and what about."""
        return f"information about {self.of} (bits)"

    def __call__(self, prospect: Prospect) -> FloatArray:
        """Bits at every design, (n,)."""
        labels = self.of(prospect.names, prospect.theta, prospect.weight)
        bits = prospect.reading_entropy(prospect.weight)
        for value in np.unique(labels):
            weight = np.where(labels == value, prospect.weight, 0.0)
            if weight.sum() > 0:
                bits -= weight.sum() * prospect.reading_entropy(weight)
        return np.maximum(bits, 0.0)


@dataclass(frozen=True)
class PerSecond:
    """Worth of a reading over the seconds that it takes, travel included."""

    of: Utility = field(default_factory=InformationGain)

    @property
    def label(self) -> str:
        """The other's, per second."""
        return f"{self.of.label} per second"

    def __call__(self, prospect: Prospect) -> FloatArray:
        """Worth a second at every design, (n,)."""
        if not (prospect.cost_s > 0).all():
            raise ParameterError(
                "cost_s", float(prospect.cost_s.min()), "greater than 0: a reading takes time where the arm stands, too"
            )
        return self.of(prospect) / prospect.cost_s


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
