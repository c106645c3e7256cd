"""Names of effects and hypotheses for headlines, in plain words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from probewise.effects import EFFECTS, NUISANCES, PROPOSAL, public_name, spoken_name

EFFECTS_IN_WORDS: Mapping[str, str] = MappingProxyType(
    {name: effect.words for name, effect in {**EFFECTS, **NUISANCES}.items()}
    | {"ssf_order": "a finer sensitivity function"}
)
"""A noun phrase for each effect, to follow "the model leaves out"."""


FORMS_IN_WORDS: Mapping[str, str] = MappingProxyType(
    {
        "offset_step": "a jump of all readings",
        "gain_step": "a jump of the readings' gain",
        "offset_per_run": "an offset of its own in each run",
        "gain_per_run": "a gain of its own in each run",
        "delay": "readings that come late",
        "settling": "readings that settle at the start of each run",
        "interference": "a wave in the readings",
        "random_walk": "a zero that wanders",
        "noise_per_run": "noise that differs from run to run",
        "clock_drift": "a clock that runs fast or slow",
        "sensitivity": "readings that depend on {0}",
        "input_offset": "an offset of {0}",
        "input_gain": "a wrong scale of {0}",
        "input_delay": "a late effect of {0}",
        "input_saturation": "a limit of {0}",
        "dead_zone": "a dead zone of {0}",
        "periodic_error": "a periodic error of {0}",
        "backlash": "backlash (play) of {0}",
        "drifts": "a drift of {0}",
        "steps": "a jump of {0}",
        "differs": "{0} that differs from run to run",
        "depends": "{0} that depends on {1}",
        "damping": "damping of {0}",
        "drag": "drag on {0}",
        "friction": "dry friction of {0}",
        "forcing": "a constant force on {0}",
        "periodic_forcing": "a periodic force on {0}",
        "cubic": "a cubic term of {1} in the rate of {0}",
        "quadratic": "a quadratic term of {1} in the rate of {0}",
        "coupling": "a coupling of {1} to {0}",
        "limit": "a bound of {0}",
    }
)
"""A noun phrase for each effect on a user's simulator, with placeholders for its targets."""


def is_in_words(name: str) -> bool:
    """Return whether an effect has a name in words."""
    kind = public_name(name).partition(":")[0]
    return name in EFFECTS_IN_WORDS or kind in FORMS_IN_WORDS or name.startswith(PROPOSAL)


def effect_in_words(name: str) -> str:
    """Name an effect in words; a user's own effect keeps its name."""
    kind, *targets = public_name(name).split(":")
    if name.startswith(PROPOSAL):
        return f"a term {targets[-1]} in {'the rate of ' if targets[0] == 'rate' else ''}{targets[1]}"
    if targets and kind in FORMS_IN_WORDS:
        return FORMS_IN_WORDS[kind].format(*targets)
    return {**FORMS_IN_WORDS, **EFFECTS_IN_WORDS}.get(kind, spoken_name(name))


def hypothesis_in_words(effects: Sequence[str]) -> str:
    """Name a hypothesis: a set of effects, () for clean, ("unknown",) for an effect out of vocabulary."""
    if not effects:
        return "nothing is missing"
    return "something without a name" if tuple(effects) == ("unknown",) else listed(map(effect_in_words, effects))


def listed(names: Sequence[str] | map[str]) -> str:
    """Join names: A, B and C."""
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last
