"""Look over the robot's shoulder: what another sensor model makes of the readings that it did not choose."""

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
        Of the run, as they come (`explore`).
    other
        The same question asked of another sensor model. What it would read next it never gets, unless the run
        asks for it too.
    field
        Where the arm can go.
    rng
        Source of randomness of the other's inference; the run has its own.
    """
    prior_bits = prior_entropy(other.prior, rng=rng)
    state = begin(other, field, rng=rng)
    for own in steps:
        state, info = step(replace(state, planned=()), own.reading, other, field, prior_bits=prior_bits, rng=rng)
        yield own, info
