"""What a finished task leaves in a campaign's file: its keys and their types, as JSON has them.

A file may have been changed by hand, so that its lines are compared with these types before anything is counted.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from typing import Any, TypeAlias, TypedDict, Union, get_args, get_origin, get_type_hints, is_typeddict

from probewise.errors import shown

Intervals: TypeAlias = dict[str, tuple[float, float, float]]
"""By parameter: truth, and the ends of the 95 % interval."""

LogDensities: TypeAlias = dict[str, float]
"""By model ("null", "repaired", "right", "true"): log predictive density of held-out readings, nats."""


class TrialResult(TypedDict):
    """One run of a study: the search, the result, its cost.

    `first_white` is the number of the first reading on white, `bits_at_white` the information gained up to it. Of the
    lengths: largest error, posterior probability that one is off by more than 12 mm, whether each 95 % interval holds
    the truth; the widest posterior sd after each reading. `p_value` None: not tested. `cpu_s`: median of the decisions.
    """

    reached: bool
    readings: int
    first_white: int | None
    bits: float
    bits_at_white: float | None
    error_mm: float
    chance_wrong: float
    held: tuple[bool, bool, bool]
    arm_s: float
    cpu_s: float
    widest_mm: list[float]
    p_value: float | None


class ConcealedResult(TypedDict):
    """One run with a concealed effect: as `TrialResult`, and what the robot says of its sensor.

    `known`: whether the target precision was reached; `p_truth`: probability of the right answer; `credible`: names in
    the credible set; `noticed`: whether a fault is reported; `cpu_s`: median and 95 % quantile of the decisions.
    """

    known: bool
    readings: int
    error_mm: float
    chance_wrong: float
    held: tuple[bool, bool, bool]
    p_truth: float
    credible: list[str]
    noticed: bool
    cpu_s: tuple[float, float]


class Failure(TypedDict):
    """A case that could not be drawn or diagnosed (`at`), and why; what was done before is there too."""

    kind: str
    size: float
    other_noise: bool
    failed: str
    at: str


class Statements(TypedDict):
    """What a diagnosis says; each hypothesis is its names and its probability."""

    verdict: str
    p_value: float
    combination: list[str]
    hypotheses: list[tuple[list[str], float]]
    credible_set: list[str]


class HiddenResult(TypedDict):
    """A concealed effect; `cosines` after the refit, by name of the effects that are like it."""

    name: str
    size_lambda: float
    on_noise: bool
    in_vocabulary: bool
    shows_in: list[str]
    cosines: dict[str, float]


class HiddenInCase(HiddenResult, total=False):
    """Of a pair: its size in sds when the other effect is in the model; of a system: rivals by their loss in nats."""

    size_beside: float
    rival_nats: dict[str, float]


class CaseResult(Statements):
    """A case of any challenge: stratum, truth, what was said, and the processor time of the diagnosis."""

    kind: str
    size: float
    other_noise: bool
    noise_model: str
    readings: int
    truth: list[str]
    hidden: list[HiddenInCase]
    cosine: float | None
    cpu_s: float


class SettledResult(Statements):
    """What a diagnosis says together with the readings that it had advised, and how many these are."""

    readings: int


class ScanDensities(TypedDict):
    """By held-out scan of a sensor."""

    angle: LogDensities
    pattern: LogDensities
    direction: LogDensities


class SensorResult(CaseResult):
    """A case of a sensor; `overlap` of the place with the region of a local effect, else None."""

    plan: str
    ssf: str
    noise_level: str
    alias: str | None
    where: list[str]
    overlap: float | None
    parameters: dict[str, Intervals]
    sensor: Intervals
    held_out: ScanDensities
    settled: SettledResult | None


class RoundResult(SettledResult):
    """A round of an investigation."""

    settled: bool


class RoundsResult(CaseResult):
    """A case of a sensor in rounds; what is said is that of the last."""

    rounds: list[RoundResult]


class RunDensities(TypedDict):
    """By held-out run of a system, in and out of the range of the others."""

    inside: LogDensities
    beyond: LogDensities


class SystemResult(CaseResult):
    """A case of a system; `alternative_nats`: loss of other names that were said, joined by "+"."""

    system: str
    law: bool
    where: list[str]
    parameters: dict[str, Intervals]
    formula: bool
    held_out: RunDensities


_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text", type(None): "null"}


def misfit(value: object, kind: Any, name: str = "result") -> tuple[str, str] | None:
    """Return what of a JSON value is not of a type, and what is allowed; None if it fits.

    `kind` is made of typed dicts, `dict[str, ...]`, lists, tuples (lists of so many), unions, bool, int, float, str.
    """
    origin, parts = get_origin(kind), get_args(kind)
    children: list[tuple[object, Any, str]] = []
    allowed = _WORDS.get(kind, "")
    if is_typeddict(kind):
        if isinstance(value, dict):
            if missing := sorted(kind.__required_keys__ - value.keys()):
                return f"{name}.{missing[0]} is missing", ", ".join(sorted(kind.__required_keys__))
            children = [(value[key], of, f"{name}.{key}") for key, of in get_type_hints(kind).items() if key in value]
        fits, allowed = isinstance(value, dict), "an object"
    elif origin is dict:
        fits, allowed = isinstance(value, dict), "an object"
        children = [(v, parts[1], f"{name}.{key}") for key, v in value.items()] if isinstance(value, dict) else []
    elif origin in (list, tuple):
        fits = isinstance(value, list) and (origin is list or len(value) == len(parts))
        allowed = "a list" if origin is list else f"a list of {len(parts)}"
        if isinstance(value, list) and fits:
            of = parts * len(value) if origin is list else parts
            children = [(v, k, f"{name}[{i}]") for i, (v, k) in enumerate(zip(value, of, strict=True))]
    elif origin in (Union, types.UnionType):
        if value is None and type(None) in parts:
            return None
        return misfit(value, next(part for part in parts if part is not type(None)), name)
    else:
        fits = isinstance(value, (int, float) if kind is float else kind) and isinstance(value, bool) is (kind is bool)
    if not fits:
        return f"{name} is {shown(value)}", allowed
    return next(filter(None, (misfit(*child) for child in children)), None)


def misfit_of_case(result: Mapping[str, Any], kind: Any) -> tuple[str, str] | None:
    """Return as `misfit` for a case of a challenge, whose kind says how many effects it conceals."""
    if "failed" in result:
        return misfit(result, Failure)
    if (found := misfit(result, kind)) is not None:
        return found
    n_hidden = {"clean": 0, "pair": 2}.get(result["kind"], 1)
    if len(result["hidden"]) != n_hidden:
        return f"result.hidden has {len(result['hidden'])} of them", f"{n_hidden} where the kind is {result['kind']}"
    if result["kind"] == "alias" and result["cosine"] is None:
        return "result.cosine is null", "a number where the kind is alias"
    return None
