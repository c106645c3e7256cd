"""Checks and the common shape of the arrays that describe a batch of regions."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray, read_only_floats, require_finite
from probewise.errors import ParameterError, ShapeError
from probewise.scene.albedo import Region


class RegionBatch(Region, Protocol):
    """Base of regions whose first field has a row for each hypothesis, after `broadcast_and_freeze_fields`."""

    @property
    def n_regions(self) -> int:
        """Number of hypotheses, or 1 where all share one region."""
        first = next(iter(self.__dataclass_fields__))  # type: ignore[attr-defined]
        return len(getattr(self, first))


def broadcast_and_freeze_fields(region: object, **shapes: tuple[int, ...]) -> None:
    """Broadcast the named arrays of a region to (n_regions, *shape), in place; check that they are finite; freeze them.

    In a shape, -1 is any length. Raises ShapeError for a shape that does not fit, ParameterError for NaN or infinity.
    """
    arrays = {name: np.asarray(getattr(region, name), dtype=np.float64) for name in shapes}
    lengths = set()
    for name, shape in shapes.items():
        array = arrays[name] = arrays[name][None] if arrays[name].ndim == len(shape) else arrays[name]
        if array.ndim != len(shape) + 1 or any(
            want not in (-1, got) for want, got in zip(shape, array.shape[1:], strict=True)
        ):
            raise ShapeError(f"{name} has shape {array.shape}; allowed: (n_regions, {', '.join(map(str, shape))})")
        lengths.add(len(array))
    n_regions = max(lengths, default=1)
    for name, array in arrays.items():
        if len(array) not in (1, n_regions):
            raise ShapeError(f"{name} has {len(array)} rows; allowed: {n_regions}, as the other arrays, or 1")
        require_finite(name, array)
        object.__setattr__(region, name, read_only_floats(np.broadcast_to(array, (n_regions, *array.shape[1:]))))


def require_positive(name: str, values: FloatArray) -> None:
    """Raise ParameterError unless all values are greater than 0."""
    bad = values <= 0
    if bad.any():
        raise ParameterError(name, float(values[bad][0]), "greater than 0")
