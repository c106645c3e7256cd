"""Runs from a given first place, so that two robots with the same first reading can be compared."""

from __future__ import annotations

import dataclasses

import numpy as np

from probewise.arm.instrument import Instrument, Pose
from probewise.errors import ParameterError
from probewise.experiment.acquisition import ArmReachAndTravel
from probewise.experiment.configuration import Experiment
from probewise.experiment.loop import begin, step
from probewise.experiment.state import Exploration, Step
from probewise.inquiry import prior_entropy


def run_from_place(
    first: Pose, instrument: Instrument, experiment: Experiment, *, rng: np.random.Generator, max_readings: int = 100
) -> Exploration:
    """Run the loop of `explore` from a given first place.

    Parameters
    ----------
    first
        Pose of the first reading.
    instrument, experiment
        As for `explore`.
    rng
        Random generator of the whole run.
    max_readings
        Largest number of readings.

    Raises
    ------
    ReachError
        If the arm cannot reach the first place.
    ParameterError
        If `max_readings` is below 1, or no place is more informative than others.
    NotConvergedError
        If no hypothesis could have given the readings.
    """
    if max_readings < 1:
        raise ParameterError("max_readings", max_readings, "1 or more")
    field = ArmReachAndTravel.from_instrument(instrument, experiment.grid)
    prior_bits = prior_entropy(experiment.prior, rng=rng)
    state = dataclasses.replace(begin(experiment, field, rng=rng), next_pose=first, planned=())
    steps: list[Step] = []
    while not steps or steps[-1].stop_reason is None:
        reading = instrument.measure(state.next_pose)
        state, info = step(state, reading, experiment, field, prior_bits=prior_bits, rng=rng, max_readings=max_readings)
        steps.append(info)
    return Exploration(experiment, tuple(steps))
