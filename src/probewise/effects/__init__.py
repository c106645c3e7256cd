"""Effects: physics that a sensor model may leave out, each one function at one stage of the chain.

The paper's model, M = I_min + (I_max - I_min) R, holds the footprint (in its response R) and two levels; these are the
named departures from it. A new effect is one function, decorated with `light_effect`, passed as
``effects={**VOCABULARY, name: effect}``.

Drifts, gradients, scales and the phases of waves count from an `Origin`: time 0 and place (0, 0), or, where all of a
recording lies farther from 0 than ten times its duration (or its size), its first time (or the middle of its places).
"""

from collections.abc import Mapping
from types import MappingProxyType

from probewise.effects import noise, optics, pose, reading
from probewise.effects.effect import AGAIN, Effect, Known, LightEffect, NoiseEffect, light_effect
from probewise.effects.reference import Extent, Origin
from probewise.priors import HeavyTailedPrior, LogHeavyTailedPrior


def _by_name(*effects: LightEffect) -> Mapping[str, LightEffect]:
    return MappingProxyType({effect.name: effect for effect in effects})


VOCABULARY: Mapping[str, LightEffect] = _by_name(
    reading.ambient_gradient,
    reading.ambient_step,
    reading.offset_drift,
    reading.gain_drift,
    reading.battery_sag,
    reading.flicker,
    reading.saturation,
    reading.nonlinearity,
    reading.hysteresis,
    reading.lag,
    pose.backlash,
    pose.position_scale,
    pose.periodic_position_error,
    optics.edge_misplacement,
    optics.scan_misplacement,
    pose.scan_angle_error,
    pose.orientation_error,
    pose.sensor_tilt,
    optics.height_gradient,
    optics.height_offset,
    optics.albedo_gradient,
    optics.albedo_patch,
    optics.edge_blur,
    optics.edge_shadow,
    optics.halo,
    optics.glint,
    noise.quantisation,
    noise.noise_sd,
    noise.signal_dependent_noise,
    noise.correlated_noise,
    noise.outliers,
    noise.dropouts,
    reading.dark_level,
    reading.gain,
)
"""Every effect that the diagnosis considers, by name."""

RARE_EFFECTS: Mapping[str, LightEffect] = _by_name(
    pose.arm_knock,
    reading.gain_jump,
    pose.bent_rails,
    pose.missing_tooth,
    pose.stick_slip,
    optics.reflection,
    pose.slow_turn,
    optics.slow_sinking,
    reading.overshoot,
    reading.polarisation,
)
"""Rare physics outside the vocabulary, by name.

A diagnosis names it where hardly anything else out of vocabulary explains the readings; otherwise it suggests it as a
form of the unknown.
"""

EFFECTS: Mapping[str, LightEffect] = MappingProxyType({**VOCABULARY, **RARE_EFFECTS})
"""Every effect that has a formula here, by name, in the vocabulary or out of it."""

OTHER_FORMS: Mapping[tuple[str, str], LightEffect] = MappingProxyType({("backlash", "of each axis"): pose.play_of_axes})
"""Other formulas of effects in the vocabulary, by name and `Binding.form`."""

PROPOSAL = "formula:"
"""Prefix of the names of formulas that are proposed for a residual which no named effect explains."""


def is_out_of_vocabulary(name: str) -> bool:
    """Return whether an effect is outside the vocabulary: a rare one, or a proposed formula."""
    return name in RARE_EFFECTS or name.startswith(PROPOSAL)


def name_without_copy_suffix(name: str) -> str:
    """Return an effect's name without the suffix of a second copy, "~again"."""
    return name.removesuffix(AGAIN)


def spoken_name(name: str) -> str:
    """Return an effect's name, or those of two at once, without a copy's suffix, as said.

    Spaces stand for underscores, unless the name has a target ("drifts:a_1").
    """
    own = name_without_copy_suffix(name)
    return own if ":" in own else own.replace("_", " ").replace("+", " and ")


def name_of_first_copy(name: str) -> str | None:
    """Return the name of the first copy if `name` is that of a second copy, otherwise None."""
    return name.removesuffix(AGAIN) if name.endswith(AGAIN) else None


NUISANCES: Mapping[str, LightEffect] = _by_name(noise.drifting_noise)
"""Departures of the noise that have no name in the vocabulary; they only keep the tests of the mean valid."""

__all__ = [
    "AGAIN",
    "EFFECTS",
    "NUISANCES",
    "OTHER_FORMS",
    "PROPOSAL",
    "RARE_EFFECTS",
    "VOCABULARY",
    "Effect",
    "Extent",
    "HeavyTailedPrior",
    "Known",
    "LightEffect",
    "LogHeavyTailedPrior",
    "NoiseEffect",
    "Origin",
    "is_out_of_vocabulary",
    "light_effect",
    "name_of_first_copy",
    "name_without_copy_suffix",
    "spoken_name",
]
