"""Parameters that describe the same shape: angles a symmetry turn apart, sides swapped where the symmetry says so."""

from __future__ import annotations

import math

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.scene.albedo import Shape
from probewise.scene.any_of import AnyOf
from probewise.scene.shapes import HasSymmetryTurn, SymmetryTurn


def mean_angles(shape: Shape, theta: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the circular mean of each angle of a shape, modulo its symmetry, (n_params,); NaN for other parameters.

    `theta` (n_samples, n_params) are weighted samples, `weight` (n_samples,). For a set of shapes, each angle's mean is
    taken over the samples of its own shape.
    """
    out = np.full(theta.shape[1], np.nan)
    for rows, columns, turn in _rows_columns_and_turns(shape, theta):
        phase = np.exp(2j * math.pi * theta[rows, columns[turn.angle]] / turn.by_rad)
        out[columns[turn.angle]] = float(np.angle(weight[rows] @ phase)) % (2 * math.pi) * turn.by_rad / (2 * math.pi)
    return out


def with_angles_near(shape: Shape, theta: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """Return samples of the same shapes, (n_samples, n_params), each angle within half a symmetry turn of a given one.

    `angles_rad` is (n_params,); NaN leaves a column as it is. Sides are swapped where the symmetry says so. Mean and sd
    of the result are meaningful, while angles of 0.01 and pi - 0.01 may be of nearly the same ellipse.
    """
    out = theta
    for rows, columns, turn in _rows_columns_and_turns(shape, theta):
        near = angles_rad[columns[turn.angle]]
        turns = np.round((theta[rows, columns[turn.angle]] - near) / turn.by_rad) if np.isfinite(near) else np.zeros(1)
        if not turns.any():
            continue
        out = theta.copy() if out is theta else out
        out[rows, columns[turn.angle]] -= turns * turn.by_rad
        if turn.swapped is not None:
            odd = rows[turns % 2 == 1]
            sides = columns[list(turn.swapped)]
            out[np.ix_(odd, sides)] = out[np.ix_(odd, sides[::-1])]
    return out


def _rows_columns_and_turns(shape: Shape, theta: FloatArray) -> list[tuple[IntArray, IntArray, SymmetryTurn]]:
    """List (row numbers, column numbers, symmetry) of each shape among the samples that has an angle."""
    if isinstance(shape, AnyOf):
        which = shape.shape_index(theta)
        parts = zip(shape.shapes.values(), shape.prior.columns_by_shape, strict=True)
        found = [(np.flatnonzero(which == k), columns, part) for k, (part, columns) in enumerate(parts)]
    else:
        found = [(np.arange(len(theta)), np.arange(theta.shape[1]), shape)]
    return [
        (rows, columns, part.symmetry_turn)
        for rows, columns, part in found
        if rows.size and isinstance(part, HasSymmetryTurn)
    ]
