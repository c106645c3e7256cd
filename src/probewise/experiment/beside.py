"""Shadow run: the posterior of another sensor model from the same readings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from probewise.experiment.asking import Field
from probewise.experiment.loop import begin, step
from probewise.experiment.setting import Experiment
from probewise.experiment.values import Step
from probewise.inquiry import prior_entropy

__all__ = ["beside"]


def beside(
    steps: Iterable[Step], other: Experiment, field: Field, *, rng: np.random.Generator
) -> Iterator[tuple[Step, Step]]:
    """Yield each step of a run together with the other experiment's step from the same reading.

    Parameters
    ----------
    steps
        Steps of the run, as they arrive (`explore`).
    other
        The same experiment with another sensor model. Its own choices of readings are not carried out.
    field
        Where the arm can go.
    rng
        Random generator of the other's inference; the run has its own.
    """
    prior_bits = prior_entropy(other.prior, rng=rng)
    state = begin(other, field, rng=rng)
    for own in steps:
        state, info = step(replace(state, planned=()), own.reading, other, field, prior_bits=prior_bits, rng=rng)
        yield own, info
