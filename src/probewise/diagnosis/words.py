"""Names of effects, of their parameters and of hypotheses, numbers and units, in plain words."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TypeAlias

from probewise.effects import EFFECTS, NUISANCES, PROPOSAL, name_without_copy_suffix, spoken_name
from probewise.effects.noise import noise_per_run, random_walk
from probewise.systems.forms import WORDS

Names: TypeAlias = tuple[str, ...]
"""The effects of a combination, by name."""

UNKNOWN: Names = ("unknown",)  # the combination of an effect out of vocabulary that is not named

_LEAST_P = 1e-300  # smallest p-value that floating point represents reliably


def p_in_words(p_value: float) -> str:
    """Write a p-value as "p = ..."; one below 1e-300 as "p < 1e-300"."""
    return f"p = {p_value:.2g}" if p_value >= _LEAST_P else f"p < {_LEAST_P:g}"


def substitute_reading_unit(own: str, unit: str) -> str:
    """Return a parameter's unit `own` with the reading's `unit` in place of a leading "reading"."""
    return own.replace("reading", unit or "reading") if own.startswith("reading") else own


EFFECTS_IN_WORDS: Mapping[str, str] = MappingProxyType(
    {name: effect.words for name, effect in {**EFFECTS, **NUISANCES}.items()}
    | {"ssf_order": "a finer sensitivity function"}
)
"""A noun phrase for each effect, to follow "the model leaves out"."""


FORMS_IN_WORDS: Mapping[str, str] = MappingProxyType(
    {**WORDS, **{noise.name: noise.words for noise in (random_walk, noise_per_run)}}
)
"""A noun phrase for each effect on a user's simulator, with placeholders for its targets."""


_PARAMETERS = {
    "a": "size",
    "amp": "amplitude",
    "alias_hz": "frequency",
    "hz": "frequency",
    "tau_s": "time constant",
    "at_s": "time",
    "at_row": "row (from 0)",
}
"""Names of parameters in words; others are their own, without underscores and unit."""
_SIZES = {
    "offset_step": "jump",
    "gain_step": "jump",
    "steps": "jump",
    "offset_drift": "drift",
    "gain_drift": "drift",
    "drifts": "drift",
    "sensitivity": "slope",
    "depends": "slope",
    "interference": "amplitude",
    "periodic_error": "amplitude",
    "periodic_forcing": "amplitude",
    "input_offset": "offset",
    "input_gain": "error of scale",
    "clock_drift": "error of rate",
    "delay": "delay",
    "input_delay": "delay",
}
"""What the parameter `a` (or the time of a delay) of a kind of effect is."""


def parameter_in_words(effect: str, name: str, unit: str) -> str:
    """Return a parameter's name in words, without its unit: what `a` is, "frequency" of hz, "run 3" of values[3]."""
    kind = effect.partition(":")[0]
    if name in ("a", "tau_s") and kind in _SIZES:
        return _SIZES[kind]
    if name == "value" and not effect_has_words(effect):
        return effect  # of a person's own effect
    if of_run := re.fullmatch(r"values\[(.*)\]", name):
        return f"run {of_run[1]}"
    return _PARAMETERS.get(name, name.removesuffix(f"_{unit}").replace("_", " "))


def effect_has_words(name: str) -> bool:
    """Return whether an effect has a name in words."""
    kind = name_without_copy_suffix(name).partition(":")[0]
    return name in EFFECTS_IN_WORDS or kind in FORMS_IN_WORDS or name.startswith(PROPOSAL)


def effect_in_words(name: str) -> str:
    """Return an effect's name in words; a user's own effect keeps its name."""
    kind, _, rest = name_without_copy_suffix(name).partition(":")
    if name.startswith(PROPOSAL):
        side, target, term = rest.split(":", 2)
        return f"a term {term} in {'the rate of ' if side == 'rate' else ''}{target}"
    if rest and kind in FORMS_IN_WORDS:
        words = FORMS_IN_WORDS[kind]
        return words.format(*rest.split(":", words.count("{") - 1))  # a column's name, the last, may have colons
    return {**FORMS_IN_WORDS, **EFFECTS_IN_WORDS}.get(kind, spoken_name(name))


def hypothesis_in_words(effects: Sequence[str], *, nothing: str = "nothing is missing") -> str:
    """Return a hypothesis in words, given its effects: `nothing` without any, ("unknown",) if out of vocabulary."""
    if not effects:
        return nothing
    return "something without a name" if tuple(effects) == UNKNOWN else join_names(effects_in_words(effects))


def effects_in_words(names: Sequence[str]) -> list[str]:
    """List effects in words; two of one name, such as two waves, are one item."""
    counted = Counter(map(effect_in_words, names))
    return [said if n == 1 else _two(said) for said, n in counted.items()]


def _two(said: str) -> str:
    plural, n = re.subn(r"^an? ((?:periodic )?)(\w+)", r"two \1\2s", said)
    return plural if n else f"{said} (twice)"


def combination_label(effects: Sequence[str]) -> str:
    """Return the name of a combination in a credible set: effects joined by "+", or "clean"."""
    return "+".join(sorted(map(name_without_copy_suffix, effects))) or "clean"


def join_names(names: Sequence[str] | map[str]) -> str:
    """Join names as in "A, B and C"."""
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def join_lists(names: Sequence[str], link: str = "and") -> str:
    """Join names as in "A, B and C" or, if one of several is itself a list, as in "A and B; C; or D"."""
    *others, last = names
    if not others:
        return last
    if not any(re.search(r",| and ", name) for name in names):
        return f"{', '.join(others)} {link} {last}"
    return f"{'; '.join(others)}; {link} {last}"
