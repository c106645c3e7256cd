"""The confusion matrix: which answers were given for which concealed effect."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from probewise._arrays import IntArray
from probewise.proof.challenge.scoring import (
    NOISE,
    acts_on_mean,
    leading_hypothesis,
    names_match,
    right_names_of_each_effect,
)
from probewise.proof.sensors import SINGLES

OUTSIDE, SEVERAL = "outside", "several"


def confusion_counts(
    results: Sequence[Mapping[str, Any]], *, label: Callable[[str], str] = str
) -> tuple[tuple[str, ...], tuple[str, ...], IntArray]:
    """Count answers by truth, over cases of kind "clean", "single" and "outside".

    An answer that is an alias of the truth counts as the truth. Only names that occur have a row or a column. `label`
    maps a name to that of its row and column, e.g. to merge several.

    Returns
    -------
    Truths, in the order of the vocabulary; answers; counts, (n_truths, n_answers).
    """
    counts: Counter[tuple[str, str]] = Counter()
    for result in results:
        if result["kind"] in ("clean", "single", "outside"):
            truth = {"clean": "clean", "outside": OUTSIDE}.get(result["kind"]) or result["hidden"][0]["name"]
            counts[label(truth), label(_stated_name(result, truth))] += 1
    order = ["clean", *SINGLES, OUTSIDE]
    said_order = ["clean", *SINGLES, "unknown", SEVERAL]
    said = {s for _, s in counts}
    columns = tuple([s for s in said_order if s in said] + sorted(said - set(said_order)))
    concealed = {t for t, _ in counts}
    truths = tuple([t for t in order if t in concealed] + sorted(concealed - set(order)))
    return truths, columns, np.array([[counts[t, s] for s in columns] for t in truths]).reshape(len(truths), -1)


def _stated_name(result: Mapping[str, Any], truth: str) -> str:
    """Return the name for which a leading hypothesis counts: `truth` if right, "clean", its one name, or `SEVERAL`.

    If the concealed effects act on the mean, names of noise effects are ignored.
    """
    names = leading_hypothesis(result, clean=True)[0]
    if acts_on_mean(result):
        names = tuple(name for name in names if name not in NOISE)
    if truth not in ("clean", OUTSIDE) and names_match(
        names, right_names_of_each_effect(result, merged=True, noise=not acts_on_mean(result))
    ):
        return truth
    return SEVERAL if len(names) > 1 else "".join(names) or "clean"
