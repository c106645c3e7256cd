"""The arm of `probewise explore`, and the hidden shape of a simulated one."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from probewise import experiment as posing
from probewise.cli._arm import open_emulated_arm_and_bench, open_nxt_arm, open_own_instrument
from probewise.cli._explore_inputs import ExploreInputs
from probewise.cli._geometry import parse_truth
from probewise.errors import ParameterError

if TYPE_CHECKING:
    from probewise._arrays import FloatArray
    from probewise.arm import Instrument, Reading


@dataclass(frozen=True)
class ArmAndTruth:
    """An arm over a field, with the true shape if it is simulated.

    `outline_mm` is the true outline, (n_points, 2), `known` the true parameters by the hypotheses' names, and `about`
    the entries for the journal; with a real arm, None and empty.
    """

    arm: Instrument
    outline_mm: FloatArray | None = None
    known: Mapping[str, float] | None = None
    about: Mapping[str, Any] = field(default_factory=dict)


def open_arm_and_truth(arguments: argparse.Namespace, inputs: ExploreInputs, taken: tuple[Reading, ...]) -> ArmAndTruth:
    """Open the chosen arm, to continue after the readings `taken`; with it, if simulated, return its true shape.

    Raises ParameterError, FileError or ArmError if a truth was given with a real arm, or the arm cannot be opened.
    """
    chosen, geometry, start_s = inputs.arm, inputs.geometry, taken[-1].time_s if taken else 0.0
    if chosen.kind in ("nxt", "file"):
        if arguments.truth is not None:
            raise ParameterError("--truth", arguments.truth, "none with a real arm, whose target is unknown")
        if chosen.kind == "file":
            return ArmAndTruth(open_own_instrument(chosen.where, start_s=start_s))
        assert geometry is not None
        return ArmAndTruth(open_nxt_arm(chosen.where, geometry, start_s=start_s))
    hidden = parse_truth(arguments.truth, arguments.shape, inputs.field, rng=inputs.streams.truth)
    world, surface = posing.world_like(inputs.sensor), posing.with_cards(hidden.surface, inputs.cards)
    arm: Instrument
    if chosen.is_lego and geometry is not None:
        built = chosen.true_geometry_file(arguments.geometry)
        seed = inputs.streams.noise + len(taken)  # a resumed run draws no noise a second time
        arm, _ = open_emulated_arm_and_bench(geometry, built, world, surface, seed=seed, start_s=start_s)
    else:
        arm = posing.arm_over(
            world,
            surface,
            inputs.field,
            seed=inputs.streams.noise,
            taken=taken,
            workspace=geometry,
            scale=posing.scale_of(inputs.sensor.instrumentation),
        )
    known = hidden.parameters_by_hypothesis_name(inputs.experiment.names)
    return ArmAndTruth(arm, hidden.outline_mm, known, {"hidden": hidden.journal_entry})
