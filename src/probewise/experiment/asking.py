"""Inquire: what every reading that the arm can take would be worth, and which to take."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise.arm.instrument import Instrument, Pose, Reading
from probewise.experiment.journal import PATTERN
from probewise.experiment.setting import Experiment
from probewise.inquiry import Grid, Prospect, UtilityMap, choose, choose_several, reachable_rows, utility_map
from probewise.inquiry.forecast import thinned
from probewise.nested.importance import Weighted

__all__ = ["Field", "inquire", "next_poses"]


@dataclass(frozen=True, eq=False)
class Field:
    """Where the arm can go and how its sensor then stands, and seconds from a pose to places, reading included.

    `reachable` and `orientation_rad` have shape (n_places,); a design's own orientation is added to the latter.
    """

    reachable: BoolArray
    orientation_rad: FloatArray
    travel_s: Callable[[Pose, FloatArray], FloatArray]

    @classmethod
    def under(cls, instrument: Instrument, grid: Grid) -> Self:
        """Ask an instrument."""
        return cls(
            np.asarray(instrument.reachable(grid.places_mm), dtype=np.bool_),
            np.asarray(instrument.orientation_rad(grid.places_mm), dtype=np.float64),
            instrument.travel_s,
        )


def inquire(
    experiment: Experiment, posterior: Weighted, drawn: FloatArray, field: Field, *, at: Reading | None
) -> tuple[Prospect, UtilityMap]:
    """Value every reading that the arm can take.

    Parameters
    ----------
    experiment, posterior
        What is asked, what is believed.
    drawn
        A few equally weighted hypotheses of it, (n_samples, n_params).
    field
        Where the arm can go.
    at
        The last reading, where the arm stands now; None before the first, when every place counts as near.
    """
    designs = experiment.designs
    rows = reachable_rows(field.reachable, experiment.grid.n_places, len(designs.combinations))
    if at is None:
        cost_s = designs.n_repeats.astype(np.float64)
    else:
        here = np.array([[at.pose.x_mm, at.pose.y_mm]])
        read_s = float(field.travel_s(at.pose, here)[0])
        cost_s = designs.cost_s(field.travel_s(at.pose, experiment.grid.places_mm), read_s)
    plan = designs.plan(PATTERN, time_s=0.0 if at is None else at.time_s)
    standing = np.tile(field.orientation_rad, len(designs.combinations))
    plan = dataclasses.replace(
        plan, orientation_rad=plan.orientation_rad + standing, instrumentation=experiment.instrumentation
    )
    drawn = drawn.copy()
    drawn.flags.writeable = False
    theta, weight = posterior.theta, posterior.weight
    if experiment.trust < 1:  # the samples of many kinds: no more than of one are asked
        some, share = thinned(weight, experiment.n_particles)
        theta, weight = theta[some], share / share.sum()
    prospect = Prospect(
        experiment.forecast,
        experiment.readout,
        theta,
        weight,
        drawn,
        designs,
        plan,
        rows,
        cost_s[rows],
        experiment.goal,
    )
    return prospect, utility_map(prospect, experiment.utility)


def next_poses(
    experiment: Experiment, prospect: Prospect, outlook: UtilityMap, *, rng: np.random.Generator
) -> tuple[Pose, ...]:
    """Choose the next readings: one, or as many as are chosen at a time, each as often as its design repeats it."""
    if experiment.batch > 1:
        rows = choose_several(prospect, experiment.batch, rng=rng)
    else:
        rows = (choose(outlook.values, outlook.reachable, rng=rng),)
    orientation_rad = prospect.plan.orientation_rad  # as the sensor will really stand there
    designs = [(experiment.designs[row], float(orientation_rad[row])) for row in rows]
    return tuple(
        Pose(design.x_mm, design.y_mm, standing, dict(design.settings).get("height_mm"))
        for design, standing in designs
        for _ in range(design.repeats)
    )
