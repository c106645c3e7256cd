"""Read what a command line says of a field and of what lies on it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.experiment import SHAPES
from probewise.priors import Prior
from probewise.scene import Field

__all__ = ["parse_field", "parse_truth"]


def parse_field(text: str) -> Field:
    """Read "WIDTH,HEIGHT" in mm."""
    try:
        width, height = (float(cell) for cell in text.split(","))
    except ValueError as error:
        raise ParameterError("--field", text, "WIDTH,HEIGHT in mm, such as 1048,520") from error
    return Field(width, height)


def parse_truth(
    text: str | None, names: Sequence[str], field: Field, *, rng: np.random.Generator
) -> tuple[str, FloatArray]:
    """Read "[SHAPE:]V,V,...", the parameters of what lies there; without a text draw it from the prior.

    Returns
    -------
    Name of the shape, and its parameters, shape (n_params,).

    Raises
    ------
    ParameterError
        If the text names no shape, lacks a number, or has one that the shape's prior excludes.
    """
    if text is None:
        name = names[int(rng.integers(len(names)))]
        prior = SHAPES[name](field).prior
        return name, prior.from_unit_cube(rng.random((1, len(prior.names))))[0]
    name, _, listed = text.rpartition(":")
    name = name or names[0]
    if name not in SHAPES:
        raise ParameterError("--truth", text, f"a shape of {', '.join(SHAPES)} before the colon")
    prior = SHAPES[name](field).prior
    allowed = f"{len(prior.names)} numbers, {','.join(prior.names)}"
    try:
        theta = np.array([float(cell) for cell in listed.split(",")])
    except ValueError as error:
        raise ParameterError("--truth", text, allowed) from error
    if theta.shape != (len(prior.names),):
        raise ParameterError("--truth", text, allowed)
    for parameter, value, low, high in zip(prior.names, theta.tolist(), *_bounds(prior, theta), strict=True):
        if not low <= value <= high:
            raise ParameterError(
                f"{parameter} of --truth {text}",
                value,
                f"{low:g} to {high:g}, as the {name}'s prior has it; without --truth the seed draws one",
            )
    return name, theta


def _bounds(prior: Prior, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Find the least and the greatest of each parameter where the others are those of theta, all (n_params,)."""
    own = np.eye(len(theta), dtype=np.bool_)
    with np.errstate(invalid="ignore"):  # of a ratio of infinities
        given = prior.to_unit_cube(theta[None])
    low, high = (np.diagonal(prior.from_unit_cube(np.where(own, end, given))) for end in (0.0, 1.0))
    return low, high
