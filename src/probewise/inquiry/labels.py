"""Labels of hypotheses: classes about which a reading may be chosen to inform."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError


class Label(Protocol):
    """A labelling of hypotheses, as whole numbers; hypotheses of one label need not be distinguished."""

    def __call__(self, names: tuple[str, ...], theta: FloatArray, weight: FloatArray) -> IntArray:
        """Return labels of weighted hypotheses: (n_samples, n_params), (n_samples,) -> (n_samples,)."""
        ...


@dataclass(frozen=True)
class ParameterValue:
    """Labels by the value of the parameter `name`, in `n_bins` bins of equal posterior probability."""

    name: str
    n_bins: int = 16

    def __post_init__(self) -> None:
        _require_enough_bins(self.n_bins)

    def __str__(self) -> str:
        return self.name

    def __call__(self, names: tuple[str, ...], theta: FloatArray, weight: FloatArray) -> IntArray:
        """Return the bin of each hypothesis's parameter: (n_samples, n_params), (n_samples,) -> (n_samples,)."""
        if self.name not in names:
            raise ParameterError("parameter", self.name, f"one of {', '.join(names)}")
        return _equal_weight_bin_of_each_value(theta[:, names.index(self.name)], weight, self.n_bins)


@dataclass(frozen=True)
class WhichShape:
    """Labels by the number of the shape, for hypotheses of a set of shapes (parameter "shape")."""

    def __str__(self) -> str:
        return "the shape"

    def __call__(self, names: tuple[str, ...], theta: FloatArray, weight: FloatArray) -> IntArray:
        """Return the number of each hypothesis's shape in the set, (n_samples,)."""
        if "shape" not in names:
            raise ParameterError("names", names, "shape among them: the hypotheses of two shapes or more")
        return np.floor(theta[:, names.index("shape")]).astype(np.int64)


def _require_enough_bins(n_bins: int) -> None:
    if n_bins < 2:
        raise ParameterError("n_bins", n_bins, "2 or more")


def _equal_weight_bin_of_each_value(values: FloatArray, weight: FloatArray, n_bins: int) -> IntArray:
    """Return the bin of each value, for bins of equal weight numbered from the lowest."""
    order = np.argsort(values, kind="stable")
    before = np.cumsum(weight[order]) - 0.5 * weight[order]
    out = np.empty(len(values), dtype=np.int64)
    out[order] = np.minimum(n_bins * before / weight.sum(), n_bins - 1).astype(np.int64)
    return out
