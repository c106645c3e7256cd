"""Parse options that describe the field, cards and the true shape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from probewise._kinds import did_you_mean
from probewise.errors import ParameterError
from probewise.experiment import HiddenShape
from probewise.scene import SHAPES, Card, Field


def parse_field(text: str) -> Field:
    """Parse "WIDTH,HEIGHT" in mm; raise ParameterError for anything else."""
    try:
        width, height = (float(cell) for cell in text.split(","))
    except ValueError as error:
        raise ParameterError("--field", text, "WIDTH,HEIGHT in mm, such as 1048,520") from error
    return Field(width, height)


def parse_cards(texts: Sequence[str], field: Field) -> tuple[Card, ...]:
    """Parse each "X,Y,WIDTH,HEIGHT,ALBEDO": a card, of known albedo, centred at (X, Y) in mm.

    Raises ParameterError if a text is anything else, or a card is not wholly on the field.
    """
    cards = []
    for text in texts:
        try:
            x_mm, y_mm, width_mm, height_mm, albedo = (float(cell) for cell in text.split(","))
        except ValueError as error:
            allowed = "X,Y,WIDTH,HEIGHT,ALBEDO: centre and size in mm, albedo from 0 to 1, such as 100,80,60,40,1"
            raise ParameterError("--reference", text, allowed) from error
        card = Card(x_mm, y_mm, width_mm, height_mm, albedo)
        low, high = card.corners_mm.min(axis=0), card.corners_mm.max(axis=0)
        if min(low) < 0 or high[0] > field.width_mm or high[1] > field.height_mm:
            raise ParameterError(
                "--reference", text, f"a card on the field of {field.width_mm:g} x {field.height_mm:g} mm"
            )
        cards.append(card)
    return tuple(cards)


def parse_truth(text: str | None, names: Sequence[str], field: Field, *, rng: np.random.Generator) -> HiddenShape:
    """Parse the true shape from "[SHAPE:]V,V,...", its parameters; if `text` is None, draw it from the prior.

    Without SHAPE it is the first of `names`. Raises ParameterError for an unknown shape, a wrong number of values, or
    values that the shape's prior excludes.
    """
    if text is None:
        return HiddenShape.drawn_from_prior({name: SHAPES[name](field) for name in names}, rng=rng)
    name, _, listed = text.rpartition(":")
    name = name or names[0]
    if name not in SHAPES:
        raise ParameterError(
            "--truth", text, f"a shape of {', '.join(SHAPES)} before the colon{did_you_mean(name, SHAPES)}"
        )
    shape = SHAPES[name](field)
    allowed = f"{len(shape.prior.names)} numbers, {','.join(shape.prior.names)}"
    try:
        theta = np.array([float(cell) for cell in listed.split(",")])
    except ValueError as error:
        raise ParameterError("--truth", text, allowed) from error
    if len(theta) != len(shape.prior.names):
        raise ParameterError("--truth", text, allowed)
    return HiddenShape.from_parameters(name, shape, theta, called=f"--truth {text}")
