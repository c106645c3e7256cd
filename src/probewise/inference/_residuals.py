"""Residuals, readings minus predictions, with the shapes checked."""

from __future__ import annotations

from probewise._arrays import FloatArray, floats
from probewise.errors import ShapeError


def residuals(readings: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return readings, (n_points,), minus predictions, (n_samples, n_points): (n_samples, n_points).

    ShapeError if the shapes do not match.
    """
    readings, predicted = floats(readings, "readings"), floats(predicted, "predicted")
    if readings.ndim != 1 or predicted.ndim != 2 or predicted.shape[1] != readings.size:
        raise ShapeError(
            f"readings have shape {readings.shape}, predictions {predicted.shape}; "
            "allowed: (n_points,) and (n_samples, n_points)"
        )
    return readings - predicted
