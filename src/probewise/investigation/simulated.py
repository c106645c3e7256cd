"""Simulated recording for investigations: plans are carried out in a world with concealed effects."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from probewise.arm import Reading, readings_of_recording
from probewise.errors import ParameterError, did_you_mean
from probewise.recordings.plan import Plan
from probewise.world import World, concealed, unlisted
from probewise.world.stages import Concealed

NOTHING = "nothing"
_LARGEST = 1e9  # largest magnitude of a parameter of an effect


@dataclass(frozen=True)
class SimulatedRecorder:
    """A `Take` function (for `RoundsFolder`) that simulates a round's plan in a world.

    The noise of a round follows from the seed and the round's number.
    """

    world: World
    seed: int

    def __call__(self, number: int, plan: Plan, asked: str, taken: Sequence[Reading]) -> Iterator[Reading]:
        """Yield the readings of a round's plan after those already taken."""
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number,)))
        recording = self.world.simulate(plan, rng=rng)
        yield from readings_of_recording(recording)[len(taken) :]


def parse_concealed(text: str) -> tuple[Concealed, ...]:
    """Parse concealed effects: NAME:VALUE,VALUE, several joined by +, or "nothing" for none.

    Raises
    ------
    ParameterError
        If an effect is unknown, or its values are too few, too many, or no numbers up to 1e9.
    """
    return () if text == NOTHING else tuple(_parse_one_effect(part) for part in text.split("+"))


def _parse_one_effect(text: str) -> Concealed:
    name, _, numbers = text.partition(":")
    kinds = _effect_classes_with_numeric_parameters()
    if name not in kinds:
        meant = did_you_mean(name, kinds)
        raise ParameterError(
            "--truth", name, f"{NOTHING}, or an effect of probewise.world.concealed with its values{meant}"
        )
    kind = kinds[name]
    wanted = ",".join(field.name for field in fields(kind))
    allowed = f"{name}:{wanted}, all of them numbers of magnitude up to {_LARGEST:g}"
    try:
        values = [float(number) for number in numbers.split(",")]
        effect = kind(*values)
    except (TypeError, ValueError) as error:
        raise ParameterError("--truth", text, allowed) from error
    if not all(abs(value) <= _LARGEST for value in values):  # nor NaN
        raise ParameterError("--truth", text, allowed)
    return effect  # type: ignore[no-any-return]


def _effect_classes_with_numeric_parameters() -> dict[str, Any]:
    every = [kind for module in (concealed, unlisted) for kind in vars(module).values() if hasattr(kind, "stage")]
    of_numbers = [kind for kind in every if all(field.type == "float" for field in fields(kind))]
    return {kind.name: kind for kind in of_numbers}
