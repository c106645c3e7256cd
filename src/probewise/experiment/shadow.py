"""Shadow run: the posterior of another sensor model from the same readings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from probewise.experiment.acquisition import ArmReachAndTravel
from probewise.experiment.configuration import Experiment
from probewise.experiment.loop import begin, step
from probewise.experiment.state import Step
from probewise.inquiry import prior_entropy


def shadow_run(
    steps: Iterable[Step], other: Experiment, field: ArmReachAndTravel, *, rng: np.random.Generator
) -> Iterator[tuple[Step, Step]]:
    """Yield each step of a run together with the other experiment's step from the same reading.

    Parameters
    ----------
    steps
        Steps of the run, as they arrive (`explore`).
    other
        The same experiment with another sensor model. Its own choices of readings are not carried out.
    field
        Reach of the arm, and travel times.
    rng
        Random generator of the other experiment's inference; the run has its own.
    """
    prior_bits = prior_entropy(other.prior, rng=rng)
    state = begin(other, field, rng=rng)
    for own in steps:
        state, info = step(replace(state, planned=()), own.reading, other, field, prior_bits=prior_bits, rng=rng)
        yield own, info
