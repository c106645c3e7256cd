"""Read what a command line says of a field and of what lies on it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from probewise.errors import ParameterError
from probewise.experiment import Hidden
from probewise.scene import SHAPES, Field

__all__ = ["parse_field", "parse_truth"]


def parse_field(text: str) -> Field:
    """Read "WIDTH,HEIGHT" in mm."""
    try:
        width, height = (float(cell) for cell in text.split(","))
    except ValueError as error:
        raise ParameterError("--field", text, "WIDTH,HEIGHT in mm, such as 1048,520") from error
    return Field(width, height)


def parse_truth(text: str | None, names: Sequence[str], field: Field, *, rng: np.random.Generator) -> Hidden:
    """Read "[SHAPE:]V,V,...", the parameters of what lies there; without a text draw it from the prior.

    Raises
    ------
    ParameterError
        If the text names no shape, lacks a number, or has one that the shape's prior excludes.
    """
    if text is None:
        return Hidden.drawn({name: SHAPES[name](field) for name in names}, rng=rng)
    name, _, listed = text.rpartition(":")
    name = name or names[0]
    if name not in SHAPES:
        raise ParameterError("--truth", text, f"a shape of {', '.join(SHAPES)} before the colon")
    shape = SHAPES[name](field)
    allowed = f"{len(shape.prior.names)} numbers, {','.join(shape.prior.names)}"
    try:
        theta = np.array([float(cell) for cell in listed.split(",")])
    except ValueError as error:
        raise ParameterError("--truth", text, allowed) from error
    if len(theta) != len(shape.prior.names):
        raise ParameterError("--truth", text, allowed)
    return Hidden.given(name, shape, theta, called=f"--truth {text}")
