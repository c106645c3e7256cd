"""What a finished task leaves in a campaign's file, which may have been changed by hand: keys and their types in JSON.

A schema is a dict of keys (one that ends with "?" may be missing), {str: schema} for any keys, [schema] for a list,
(schema, ...) for a list of so many, (schema, None) for null too, or bool, int, float, str.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

from probewise.errors import shown

Schema: TypeAlias = Any

_RUN = {
    "readings": int,
    "error_mm": float,  # of the worst length
    "chance_wrong": float,  # posterior probability that a length is off by more than 12 mm
    "held": (bool, bool, bool),  # whether the 95 % interval of each length holds the truth
}
TRIAL: Schema = {
    "reached": bool,  # the target precision
    **_RUN,
    "first_white": (int, None),  # number of the first reading on white
    "bits": float,
    "bits_at_white": (float, None),  # gained up to it
    "arm_s": float,
    "cpu_s": float,  # median of the decisions
    "widest_mm": [float],  # posterior sd after each reading
    "p_value": (float, None),  # null: not tested
}
CONCEALED_TRIAL: Schema = {
    "known": bool,  # to the target precision
    **_RUN,
    "p_truth": float,  # probability of the right answer
    "credible": [str],  # names in the credible set
    "noticed": bool,  # a fault is reported
    "cpu_s": (float, float),  # median and 95 % quantile of the decisions
}

_FAILURE = {"kind": str, "size": float, "other_noise": bool, "failed": str, "at": str}
_STATEMENTS = {
    "verdict": str,
    "p_value": float,
    "combination": [str],
    "hypotheses": [([str], float)],  # names, and their probability
    "credible_set": [str],
}
_HIDDEN = {
    "name": str,
    "size_lambda": float,
    "on_noise": bool,
    "in_vocabulary": bool,
    "shows_in": [str],
    "cosines": {str: float},  # after the refit, with effects that are like it
    "size_beside?": float,  # of a pair: in sds, when the other effect is in the model
    "rival_nats?": {str: float},  # of a system: what rivals lose
}
_CASE = {
    "kind": str,
    "size": float,
    "other_noise": bool,
    "noise_model": str,
    "readings": int,
    "truth": [str],
    "hidden": [_HIDDEN],
    "cosine": (float, None),
    "cpu_s": float,
    **_STATEMENTS,
}
_SETTLED = {"readings": int, **_STATEMENTS}  # of readings that were advised
_INTERVALS = {str: (float, float, float)}  # by parameter: truth, and the ends of the 95 % interval
_LOG_DENSITIES = {str: float}  # of held-out readings, by model ("null", "repaired", "right", "true"), nats

SENSOR_CASE: Schema = {
    **_CASE,
    "plan": str,
    "ssf": str,
    "noise_level": str,
    "alias": (str, None),
    "where": [str],
    "overlap": (float, None),  # of the place with the region of a local effect
    "parameters": {str: _INTERVALS},
    "sensor": _INTERVALS,
    "held_out": dict.fromkeys(("angle", "pattern", "direction"), _LOG_DENSITIES),
    "settled": (_SETTLED, None),
}
ROUNDS_CASE: Schema = {**_CASE, "rounds": [{"settled": bool, **_SETTLED}]}  # what is said is that of the last
SYSTEM_CASE: Schema = {
    **_CASE,
    "system": str,
    "law": bool,
    "where": [str],
    "parameters": {str: _INTERVALS},
    "formula": bool,
    "held_out": dict.fromkeys(("inside", "beyond"), _LOG_DENSITIES),
}

_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}


def misfit(value: Any, schema: Schema, name: str = "result") -> tuple[str, str] | None:
    """Return what of a JSON value does not fit a schema, and what is allowed; None if it fits."""
    children: list[tuple[Any, Schema, str]] = []
    if isinstance(schema, dict):
        fits, allowed = isinstance(value, dict), "an object"
        if fits and str in schema:
            children = [(own, schema[str], f"{name}.{key}") for key, own in value.items()]
        elif fits:
            needed = sorted(key for key in schema if not key.endswith("?"))
            if missing := [key for key in needed if key not in value]:
                return f"{name}.{missing[0]} is missing", ", ".join(needed)
            of = {key.removesuffix("?"): each for key, each in schema.items()}
            children = [(value[key], each, f"{name}.{key}") for key, each in of.items() if key in value]
    elif isinstance(schema, tuple) and schema[-1] is None:
        return None if value is None else misfit(value, schema[0], name)
    elif isinstance(schema, list | tuple):
        n = len(schema)
        fits = isinstance(value, list) and (isinstance(schema, list) or len(value) == n)
        allowed = "a list" if isinstance(schema, list) else f"a list of {n}"
        if fits:
            children = [(own, schema[k % n], f"{name}[{k}]") for k, own in enumerate(value)]
    else:
        kinds = (int, float) if schema is float else schema
        fits, allowed = isinstance(value, kinds) and isinstance(value, bool) is (schema is bool), _WORDS[schema]
    if not fits:
        return f"{name} is {shown(value)}", allowed
    return next(filter(None, (misfit(*child) for child in children)), None)


def misfit_of_case(result: Mapping[str, Any], schema: Schema) -> tuple[str, str] | None:
    """Return as `misfit` for a case of a challenge, whose kind says how many effects it conceals."""
    if "failed" in result:
        return misfit(result, _FAILURE)
    if (found := misfit(result, schema)) is not None:
        return found
    n_hidden = {"clean": 0, "pair": 2}.get(result["kind"], 1)
    if len(result["hidden"]) != n_hidden:
        return f"result.hidden has {len(result['hidden'])} of them", f"{n_hidden} where the kind is {result['kind']}"
    if result["kind"] == "alias" and result["cosine"] is None:
        return "result.cosine is null", "a number where the kind is alias"
    return None
