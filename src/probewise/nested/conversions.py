"""Convert results for anesthetic and ArviZ, both optional packages."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.nested.dead_points import DeadPoints


def to_anesthetic(result: DeadPoints) -> Any:
    """Convert to `anesthetic.NestedSamples`: parameters, `logL` and `logL_birth` of every dead point.

    anesthetic recomputes the number of live points from births and deaths, and knows no labels. On a plateau of the
    likelihood the levels are therefore made distinct by single units in the last place, in the order of the labels.
    anesthetic does not know impossible hypotheses (zero likelihood) either: its prior is that of the possible ones. To
    restore the evidence, `log_start` (log of the possible share of the prior) is added to every level.

    Raises
    ------
    ImportError
        If anesthetic is not installed.
    """
    anesthetic = _import_optional("anesthetic")
    death, birth = _log_likelihoods_without_ties(result)
    return anesthetic.NestedSamples(
        data=np.array(result.theta), columns=list(result.names), logL=death, logL_birth=birth, label="probewise"
    )


def to_arviz(result: DeadPoints, attributes: Mapping[str, object], *, rng: np.random.Generator, n: int) -> Any:
    """Convert to ArviZ's container: `n` equally weighted samples as one chain, and attributes of the run.

    Parameters
    ----------
    result
        The dead points to draw from.
    attributes
        Attributes of the container, for instance the evidence, its error and software versions.
    rng
        Source of randomness, for drawing the samples.
    n
        Number of samples.

    Returns
    -------
    arviz.InferenceData, or xarray.DataTree from ArviZ 1.0 on
        Group `posterior` has a variable for each parameter. Group `sample_stats` has each sample's log likelihood
        `log_l`, the level `log_l_birth` above which it was drawn, and its `row` in the result. All have dimensions
        (chain, draw).

    Raises
    ------
    ImportError
        If arviz is not installed.
    ParameterError
        If the result has no parameters.
    """
    arviz = _import_optional("arviz")
    if not result.names:
        raise ParameterError("names", result.names, "one parameter or more; without any there are no samples")
    rows = result.draw_rows(n, rng=rng)
    groups = {
        "posterior": {name: result.theta[None, rows, i] for i, name in enumerate(result.names)},
        "sample_stats": {
            "log_l": result.log_likelihood[None, rows],
            "log_l_birth": result.log_birth[None, rows],
            "row": rows[None, :],
        },
    }
    # ArviZ 1.0 takes all groups as one mapping, earlier versions one argument per group.
    if "data" in inspect.signature(arviz.from_dict).parameters:
        return arviz.from_dict(groups, attrs={"/": dict(attributes)})
    return arviz.from_dict(**groups, attrs=dict(attributes))


def _log_likelihoods_without_ties(result: DeadPoints) -> tuple[FloatArray, FloatArray]:
    """Return log likelihoods at death and birth, (n_dead,) each, plus `log_start`; ties are broken by label."""
    order = np.lexsort((result.label, result.log_likelihood))
    strict = result.log_likelihood[order] + result.log_start
    for i in range(1, len(strict)):
        if strict[i] <= strict[i - 1]:
            strict[i] = np.nextafter(strict[i - 1], np.inf)
    death = np.empty_like(strict)
    death[order] = strict
    # A birth level is a dead point's level and label: how many dead points lie at or below it?
    both_level = np.concatenate([result.log_likelihood, result.log_birth])
    both_label = np.concatenate([result.label, result.birth_label])
    kind = np.repeat([0, 1], result.n_dead)
    ranked = np.lexsort((kind, both_label, both_level))
    n_below = np.cumsum(ranked < result.n_dead)
    born = ranked >= result.n_dead
    at = np.empty(result.n_dead, dtype=np.int64)
    at[ranked[born] - result.n_dead] = n_below[born]
    return death, np.where(at > 0, strict[at - 1], -np.inf)


def _import_optional(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{name} is an optional package that cannot be imported ({error}); install it with: pip install {name}"
        ) from error
