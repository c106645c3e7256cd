"""The utility of every available reading, and the choice of the next (the paper's "inquire")."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.arm.instrument import Instrument, Pose, Reading
from probewise.experiment.configuration import Experiment
from probewise.experiment.journal import PATTERN
from probewise.experiment.missing_readings import chance_of_value
from probewise.inquiry import (
    Goal,
    Grid,
    InformationGain,
    UtilityInput,
    UtilityMap,
    choose,
    choose_several,
    reachable_rows,
    utility_map,
)
from probewise.inquiry.forecast import resampled_rows_and_weights
from probewise.nested import Weighted

_MISSING_REACH = 0.1  # of the field's diagonal: from there on, a missing reading hardly counts


@dataclass(frozen=True, eq=False)
class ArmReachAndTravel:
    """Reach, orientation of the sensor and travel time of an arm at the places of a grid.

    `reachable` marks the places within reach; `orientation_rad` is the sensor's own orientation at each place, to which
    a design's is added; both (n_places,). `travel_s(pose, places_mm)` returns the seconds from a pose to the end of a
    reading at each place.
    """

    reachable: BoolArray
    orientation_rad: FloatArray
    travel_s: Callable[[Pose, FloatArray], FloatArray]

    @classmethod
    def from_instrument(cls, instrument: Instrument, grid: Grid) -> Self:
        """Build from an instrument and the grid of places."""
        return cls(
            np.asarray(instrument.reachable(grid.places_mm), dtype=np.bool_),
            np.asarray(instrument.orientation_rad(grid.places_mm), dtype=np.float64),
            instrument.travel_s,
        )


def predict_readings_and_utilities(
    experiment: Experiment,
    posterior: Weighted,
    drawn: FloatArray,
    field: ArmReachAndTravel,
    *,
    at: Reading | None,
    goal: Goal | None = None,
) -> tuple[UtilityInput, UtilityMap]:
    """Predict every available reading, and compute its utility.

    Parameters
    ----------
    experiment, posterior
        The experiment, and the current posterior.
    drawn
        A few equally weighted posterior samples, (n_samples, n_params).
    field
        The places that the arm reaches, with its travel times.
    at
        The last reading, which says where the arm is. None before the first reading, which costs no travel time.
    goal
        Sd that the lengths have to reach; None: the experiment's own goal.

    Returns
    -------
    The input of utilities (posterior, available designs, their costs in seconds); and the utility of each design.
    """
    designs = experiment.designs
    rows = reachable_rows(field.reachable, experiment.grid.n_places, len(designs.setting_combinations))
    if at is None:
        cost_s = designs.n_repeats.astype(np.float64)
    else:
        here = np.array([[at.pose.x_mm, at.pose.y_mm]])
        read_s = float(field.travel_s(at.pose, here)[0])
        travel_s = field.travel_s(at.pose, experiment.grid.places_mm)
        if not math.isfinite(read_s):  # the true place, just beyond the reach
            read_s = float(travel_s[field.reachable].min())
        cost_s = designs.cost_s(travel_s, read_s)
    plan = designs.plan(PATTERN, time_s=0.0 if at is None else at.time_s)
    standing = np.tile(field.orientation_rad, len(designs.setting_combinations))
    plan = dataclasses.replace(
        plan, orientation_rad=plan.orientation_rad + standing, instrumentation=experiment.instrumentation
    )
    drawn = drawn.copy()
    drawn.flags.writeable = False
    theta, weight = posterior.theta, posterior.weight
    if experiment.trust < 1:  # samples of several kinds: use no more than for one
        some, share = resampled_rows_and_weights(weight, experiment.n_particles)
        theta, weight = theta[some], share / share.sum()
    utility_input = UtilityInput(
        experiment.forecast,
        experiment.readout,
        theta=theta,
        weight=weight,
        drawn=drawn,
        designs=designs,
        plan=plan,
        rows=rows,
        cost_s=cost_s[rows],
        goal=experiment.goal if goal is None else goal,
    )
    return utility_input, utility_map(utility_input, experiment.utility)


def next_poses(
    experiment: Experiment,
    utility_input: UtilityInput,
    utilities: UtilityMap,
    readings: Sequence[Reading] = (),
    *,
    rng: np.random.Generator,
) -> tuple[Pose, ...]:
    """Choose the next pose, or the experiment's `batch` of poses; each comes as often as its design repeats it.

    A batch is chosen for its joint information. Where the map shows another utility, as near the end of a run, only the
    best design of the map is taken. If some of the `readings` so far are missing, the utility above the least of the
    map counts by the chance that a reading is not missing.
    """
    plan, grid = utility_input.plan, experiment.grid
    chance = chance_of_value(
        readings,
        np.stack([plan.x_mm, plan.y_mm], axis=1),
        reach_mm=_MISSING_REACH * math.hypot(grid.width_mm, grid.height_mm),
    )
    if experiment.batch > 1 and utilities.label == InformationGain.label:
        weight = None if chance is None else chance[utility_input.rows]
        rows = choose_several(utility_input, experiment.batch, rng=rng, chance=weight)
    else:
        values = utilities.values
        if chance is not None:
            least = values[utilities.reachable].min()
            values = least + (values - least) * chance
        rows = (choose(values, utilities.reachable, rng=rng),)
    orientation_rad = utility_input.plan.orientation_rad  # the orientation that the sensor will have there
    designs = [(experiment.designs[row], float(orientation_rad[row])) for row in rows]
    return tuple(
        Pose(design.x_mm, design.y_mm, standing, dict(design.settings).get("height_mm"))
        for design, standing in designs
        for _ in range(design.repeats)
    )
