"""Utilities (acquisition functions) of readings, behind one interface."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.inquiry.labels import Label
from probewise.inquiry.utility_input import UtilityInput


class Utility(Protocol):
    """Utility of a reading at each design; larger is better. A frozen dataclass, so that a journal can record it."""

    @property
    def label(self) -> str:
        """Label with unit, for a colour bar."""
        ...

    def __call__(self, utility_input: UtilityInput) -> FloatArray:
        """Return the utility of every available design, (n,)."""
        ...


@dataclass(frozen=True)
class ReadingEntropy:
    """Shannon entropy, in bits, of the readings that a few hypotheses predict (paper, the machine learning system).

    The predictions are noise-free and fall into fixed bins, `bin_width` wide and centred on its multiples: one LEGO
    unit rounds as the sensor does. For the naive model there are two readings, so the map is the paper's partition: at
    most one bit, where half of the circles contain the place.
    """

    bin_width: float = 1.0

    label: ClassVar[str] = "entropy (bits)"

    def __post_init__(self) -> None:
        if not (0 < self.bin_width < np.inf):
            raise ParameterError("bin_width", self.bin_width, "finite, greater than 0")

    def __call__(self, utility_input: UtilityInput) -> FloatArray:
        """Return the entropy in bits at every available design, (n,)."""
        return label_entropy(np.rint(utility_input.predicted / self.bin_width))


@dataclass(frozen=True)
class InformationGain:
    """Expected information, in bits, about all parameters together (Lindley 1956).

    The entropy of the predictive distribution (parameters, noise, rounding and range) minus the expected entropy given
    the parameters, which is due to noise.
    """

    label: ClassVar[str] = "expected information (bits)"

    def __call__(self, utility_input: UtilityInput) -> FloatArray:
        """Return the bits at every available design, (n,)."""
        return utility_input.information(utility_input.weight)


@dataclass(frozen=True)
class InformationAbout:
    """Expected information, in bits, about a label: a function of the parameters, or the kind of shape.

    The entropy of the predictive distribution minus its expected entropy given the label: differences among hypotheses
    of the same label do not count.
    """

    of: Label

    @property
    def label(self) -> str:
        """Label of the information and its target."""
        return f"information about {self.of} (bits)"

    def __call__(self, utility_input: UtilityInput) -> FloatArray:
        """Return the bits at every available design, (n,)."""
        labels = self.of(utility_input.names, utility_input.theta, utility_input.weight)
        bits = utility_input.reading_entropy(utility_input.weight)
        for value in np.unique(labels):
            weight = np.where(labels == value, utility_input.weight, 0.0)
            if weight.sum() > 0:
                bits -= weight.sum() * utility_input.reading_entropy(weight)
        return np.maximum(bits, 0.0)


@dataclass(frozen=True)
class PerSecond:
    """The utility `of` a reading per second, including travel; ParameterError if a cost is not above 0."""

    of: Utility = field(default_factory=InformationGain)

    @property
    def label(self) -> str:
        """Label of the other utility, per second."""
        return f"{self.of.label} per second"

    def __call__(self, utility_input: UtilityInput) -> FloatArray:
        """Return the utility per second at every design, (n,)."""
        if not (utility_input.cost_s > 0).all():
            raise ParameterError(
                "cost_s",
                float(utility_input.cost_s.min()),
                "greater than 0: a reading takes time where the arm stands, too",
            )
        return self.of(utility_input) / utility_input.cost_s


def label_entropy(labels: FloatArray) -> FloatArray:
    """Return the entropy, in bits, of the labels in each column, (n_samples, n_places) -> (n_places,).

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
