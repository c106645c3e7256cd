"""Names of effects and hypotheses for headlines, in plain words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from probewise.effects import (
    EFFECTS,
    NUISANCES,
    PROPOSAL,
    NoisePerRun,
    RandomWalk,
    name_without_copy_suffix,
    spoken_name,
)
from probewise.systems.forms import WORDS

EFFECTS_IN_WORDS: Mapping[str, str] = MappingProxyType(
    {name: effect.words for name, effect in {**EFFECTS, **NUISANCES}.items()}
    | {"ssf_order": "a finer sensitivity function"}
)
"""A noun phrase for each effect, to follow "the model leaves out"."""


FORMS_IN_WORDS: Mapping[str, str] = MappingProxyType(
    {**WORDS, **{noise.name: noise.words for noise in (RandomWalk, NoisePerRun)}}
)
"""A noun phrase for each effect on a user's simulator, with placeholders for its targets."""


def effect_has_words(name: str) -> bool:
    """Return whether an effect has a name in words."""
    kind = name_without_copy_suffix(name).partition(":")[0]
    return name in EFFECTS_IN_WORDS or kind in FORMS_IN_WORDS or name.startswith(PROPOSAL)


def effect_in_words(name: str) -> str:
    """Return an effect's name in words; a user's own effect keeps its name."""
    kind, *targets = name_without_copy_suffix(name).split(":")
    if name.startswith(PROPOSAL):
        return f"a term {targets[-1]} in {'the rate of ' if targets[0] == 'rate' else ''}{targets[1]}"
    if targets and kind in FORMS_IN_WORDS:
        return FORMS_IN_WORDS[kind].format(*targets)
    return {**FORMS_IN_WORDS, **EFFECTS_IN_WORDS}.get(kind, spoken_name(name))


def hypothesis_in_words(effects: Sequence[str]) -> str:
    """Return a hypothesis in words, given its effects: () for clean, ("unknown",) for an effect out of vocabulary."""
    if not effects:
        return "nothing is missing"
    return "something without a name" if tuple(effects) == ("unknown",) else join_names(map(effect_in_words, effects))


def join_names(names: Sequence[str] | map[str]) -> str:
    """Join names as in "A, B and C"."""
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last
