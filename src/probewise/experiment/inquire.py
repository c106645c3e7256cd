"""Inquire: the utility of every available reading, and the choice of the next (paper, "the inquiry engine").

Far from the end, the utility is the experiment's own, by the plain sensor, unless that is surely incomplete. Near the
end of a run with doubt in its sensor, several kinds of hypotheses may explain all readings and differ in the shape.
Then the utility is the expected information about all kinds together; once some reading has a chance of 25 % or more to
meet the stopping rule, that chance: kinds that are aliased but agree on the shape need not be distinguished. Bits about
the effect left out are added.

Before such a run ends, two things are checked. A dozen readings that fit the sensor without faults cannot exclude most
faults, and one further reading would show some. And if a shape was read from one side only, its far side follows from
the sensor model alone: with an unknown fault, the result may be wrong by any amount.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.arm.instrument import Instrument, Pose, Reading
from probewise.experiment.journal import PATTERN
from probewise.experiment.kinds import Posterior
from probewise.experiment.rivals import Pace
from probewise.experiment.setup import MOST_OFF, Experiment
from probewise.experiment.stopping import OFF_SDS, Judgement, theta_with_aligned_angles
from probewise.inquiry import (
    Goal,
    Grid,
    InformationGain,
    Readout,
    UtilityInput,
    UtilityMap,
    choose,
    choose_several,
    utility_map,
)
from probewise.inquiry.entropy import reachable_rows
from probewise.inquiry.forecast import resampled_rows_and_weights
from probewise.inquiry.predictive import WeightsGivenReading
from probewise.inquiry.readout import entropy_bits
from probewise.inquiry.utilities import by_repeats
from probewise.nested import Weighted
from probewise.recordings.plan import Plan
from probewise.scene import outlines
from probewise.scene.regions import EllipseRegion, PolygonRegion, Region

ENOUGH_BITS = 0.05
"""Expected information about the name of what is left out for which a reading is taken after the shape is known."""

NAMES = "expected information about what the sensor leaves out (bits)"
FAR_SIDE = "expected information (bits) on the side of the shape that no reading has seen"
INFORMATION = "expected information about the shape and what the sensor leaves out (bits)"
ENDS = "probability that a reading there ends the run, plus bits about what the sensor leaves out"

_COMPLETE = 0.05  # probability that the sensor model is complete, from which on that is open
_MUCH_BITS = 0.25  # about the name, for which a reading is taken where that is not open
_MISSING_REACH = 0.1  # of the field's diagonal: from there on, a missing reading hardly counts
_SAME_MM = 1.0  # closer than this, two places count as one
_NODES = 12  # of the reading expected under a name
_CELL = 0.5  # noise sds: cells of the reading; twice as wide, they lose four times as much
_FAR = 0.75  # of the shape's diameter: two opposite readings at the edge of a circle leave 0.71
_AT_EDGE = 1.0  # spacings of the grid within which a reading is at the edge
_NEAR = 15.0  # times the target sd: beyond it, the ordinary information is used
_HYPOTHESES = 800
_FAIRNESS = 0.75  # power of a kind's probability in its share of the drawn hypotheses
_LEAST_EACH = 30
_LEAST_OF_NAMES = 120  # for their moments: with 30, their scatter alone tells 0.03 bits at the best of the candidates
_COUNTS = 1e-5  # least probability of a kind to be included
_BEST = 60  # places with the largest information about all parameters
_AT_EDGES = 40
_ANYWHERE = 20
_LEAST_CHANCE = 0.25  # probability of ending the run from which only that counts
_ENDING = 60  # most informative places, tested for ending the run, and most informative on the far side
_LEAST_BITS = 1e-3  # of a reading of the far side, which is taken even if it promises nothing
_UNSEEN = 0.5  # worth of knowing the lengths where the far side is still to be read


def inquire(
    experiment: Experiment,
    kinds: Posterior,
    posterior: Weighted,
    drawn: FloatArray,
    judged: Judgement,
    field: ArmReachAndTravel,
    readings: tuple[Reading, ...],
    *,
    rng: np.random.Generator,
) -> tuple[UtilityInput, UtilityMap]:
    """Compute the utility of every available reading after a judgement.

    `kinds`, `posterior` and `drawn` (n_samples, n_params) are as `infer` returns them. Return the input of utilities
    (posterior, available designs, their costs in seconds), and the utility of each design.
    """
    goal = experiment.goal
    if goal is not None and judged.arm_error is not None:  # what the arm's error leaves to the readings
        lengths = np.array(goal.columns) - experiment.shape_columns[0]
        left = goal.sd**2 - float(judged.arm_error.sd[lengths].max()) ** 2
        goal = replace(goal, sd=math.sqrt(left)) if left > 0 else goal
    given, utilities = predict_readings_and_utilities(experiment, posterior, drawn, field, at=readings[-1], goal=goal)
    if experiment.trust == 1:
        return given, utilities
    raised = kinds.with_raised_fault_odds()
    return given, utilities_near_end(experiment, raised, given, utilities, readings, rng=rng, known=judged.may_stop)


def must_continue(utilities: UtilityMap, kinds: Posterior) -> bool:
    """Return whether a run goes on for a check, though it knows the shape: of its far side, or of the sensor.

    Once the sensor model is surely not complete, the shape is known under every effect that may be left out: which of
    them it is need not be told, and only a reading that tells much of it is taken.
    """
    least = ENOUGH_BITS if kinds.left_out.get("", 0.0) >= _COMPLETE else _MUCH_BITS
    return utilities.label == FAR_SIDE or (utilities.label == NAMES and utilities.highest_utility >= least)


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
    goal: Goal | None,
) -> tuple[UtilityInput, UtilityMap]:
    """Predict every available reading, and compute the experiment's utility of it.

    `at` is the last reading, which says where the arm is; None before the first reading, which costs no travel time.
    `goal` is the sd that the lengths have to reach. For the rest, see `inquire`.
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
    plan = replace(plan, orientation_rad=plan.orientation_rad + standing, instrumentation=experiment.instrumentation)
    drawn = drawn.copy()
    drawn.flags.writeable = False
    theta, weight = posterior.theta, posterior.weight
    if experiment.trust < 1:  # samples of several kinds: use no more than for one
        some, share = resampled_rows_and_weights(weight, experiment.n_particles)
        theta, weight = theta[some], share / share.sum()
    given = UtilityInput(
        experiment.forecast,
        experiment.readout,
        theta=theta,
        weight=weight,
        drawn=drawn,
        designs=designs,
        plan=plan,
        rows=rows,
        cost_s=cost_s[rows],
        goal=goal,
    )
    return given, utility_map(given, experiment.utility)


def next_poses(
    experiment: Experiment,
    given: UtilityInput,
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
    plan = given.plan
    chance = _worth_beside_earlier_readings(experiment, readings, np.stack([plan.x_mm, plan.y_mm], axis=1))
    if experiment.batch > 1 and utilities.label == InformationGain.label:
        weight = None if chance is None else chance[given.rows]
        rows = choose_several(given, experiment.batch, rng=rng, chance=weight)
    else:
        values = utilities.values
        if chance is not None:
            least = values[utilities.reachable].min()
            values = least + (values - least) * chance
        rows = (choose(values, utilities.reachable, rng=rng),)
    poses = []
    for row in rows:
        design, standing = experiment.designs[row], float(plan.orientation_rad[row])  # as the sensor will be there
        pose = Pose(design.x_mm, design.y_mm, standing, dict(design.settings).get("height_mm"))
        poses += [pose] * design.repeats
    return tuple(poses)


def _worth_beside_earlier_readings(
    experiment: Experiment, readings: Sequence[Reading], places_mm: FloatArray
) -> FloatArray | None:
    """Return the factor of a reading's worth at each place, (n_places, 2) -> (n_places,); None: 1 everywhere.

    If a reading is missing, it is the chance that one there is not: the share of values among the readings so far,
    each weighted by one over its squared distance. One value at a tenth of the field's diagonal is added, so that a
    missing reading hardly counts farther away than that.

    With doubt in the sensor, a reading within a footprint of n others counts 1/(1 + n): kinds that fail in a way that
    none of them has would say that it tells more, again and again.
    """
    missing = np.array([math.isnan(reading.value) for reading in readings], dtype=np.bool_)
    crowded = experiment.trust < 1 and len(readings) > 0
    if not missing.any() and not crowded:
        return None
    square = ((places_mm[:, None] - _places_of(readings)) ** 2).sum(axis=2)
    worth = np.ones(len(places_mm))
    if missing.any():
        reach_mm = _MISSING_REACH * math.hypot(experiment.grid.width_mm, experiment.grid.height_mm)
        weight = reach_mm**2 / (square + _SAME_MM**2)
        worth = (1.0 + weight[:, ~missing].sum(axis=1)) / (1.0 + weight.sum(axis=1))
    if crowded:
        worth = worth * (1.0 / (1.0 + (square < experiment.footprint_mm**2).sum(axis=1)))
    return np.asarray(worth)


def utilities_near_end(
    experiment: Experiment,
    kinds: Posterior,
    given: UtilityInput,
    utilities: UtilityMap,
    readings: tuple[Reading, ...],
    *,
    rng: np.random.Generator,
    known: bool = False,
) -> UtilityMap:
    """Return the utility map for all kinds near the end of a run.

    Without a goal (a set of shapes), or far from the end while the sensor may be complete, return the given map: by the
    plain sensor, each reading since a light rose would promise an edge beside it. `known` says whether the posterior
    meets the stopping rule. Then the utility is that of a reading on the far side of the shape, if no reading has seen
    that, or the expected information about the effect that the sensor model leaves out; see `must_continue`.

    Candidates are the designs with the largest information, those at edges and centres of sampled shapes, on the far
    side, at cards and at earlier places, and some random ones; all others get utility 0.
    """
    if given.goal is None:
        return utilities
    theta, lengths, weight = _draw_theta_lengths_weights(
        experiment, kinds, _LEAST_OF_NAMES if known else _LEAST_EACH, rng
    )
    spread = weight @ (lengths - weight @ lengths) ** 2
    may_be_complete = kinds.left_out.get("", 0.0) >= _COMPLETE
    if may_be_complete and np.sqrt(spread.max()) > _NEAR * experiment.stop_sd_mm:
        return utilities
    mean = (given.weight @ given.theta[:, experiment.shape_columns])[None] / given.weight.sum()
    unseen, shows_far_side = far_side(given, experiment.shape.region(mean), readings)
    far = () if unseen is None else (unseen,)
    rows = _candidate_designs(experiment, given, utilities, theta, readings, rng)
    rows = np.union1d(rows, far).astype(np.int64)
    plan = _plan_from_arm_to_candidates(given, rows, readings)
    answers = np.concatenate(
        [kind.model.predict(own, plan)[:, 1::2] for kind, own in zip(kinds.kinds, theta, strict=True) if len(own)]
    )
    n_repeats = given.designs.n_repeats[given.rows[rows]]
    names = np.array([kind.left_out for kind, own in zip(kinds.kinds, theta, strict=True) for _ in own])
    seen = shows_far_side(_places_mm(given)[rows])

    def map_of(some: IntArray, utility: FloatArray, label: str) -> UtilityMap:
        """Return the utility map with these values, (n,), for some available designs and 0 for the others."""
        values = np.zeros(len(given.designs))
        values[given.rows[some]] = utility
        values.flags.writeable = False
        return UtilityMap(given.designs, values, utilities.reachable, label)

    def bits_about_names(own: FloatArray, n: int) -> FloatArray:
        return expected_bits_about_left_out_effect(weight, own, names, given.readout, repeats=n)

    def information_bits(own: FloatArray, n: int) -> FloatArray:
        return WeightsGivenReading.of(own, weight, given.readout, repeats=n).information_bits

    if known and not far:
        return map_of(rows, by_repeats(bits_about_names, answers, n_repeats), NAMES)
    utility = by_repeats(information_bits, answers, n_repeats)
    if known:
        # The far side first: it has to be read in any case, and tells something about the names too.
        there = seen if seen.any() else np.isin(rows, far)
        return map_of(rows, np.where(there, np.maximum(utility, _LEAST_BITS), 0.0), FAR_SIDE)
    order = np.argsort(-utility, kind="stable")
    best = np.unique(np.concatenate([order[:_ENDING], order[seen[order]][:_ENDING]]))
    off_mm, goal_sd_mm = OFF_SDS * experiment.stop_sd_mm, given.goal.sd

    def chances(own: FloatArray, n: int) -> FloatArray:
        after = WeightsGivenReading.of(own, weight, given.readout, repeats=n)
        return after.probability_of_knowing(lengths - weight @ lengths, goal_sd_mm, off=off_mm, most_off=MOST_OFF)

    of_best = answers[:, best], n_repeats[best]
    chance = by_repeats(chances, *of_best)
    if chance.max() < _LEAST_CHANCE:
        return map_of(rows, utility, INFORMATION)
    # Another reading has to follow where the far side is left; of two that are alike, the one that tells names counts.
    ends = chance * np.where(seen[best], 1.0, _UNSEEN) + by_repeats(bits_about_names, *of_best)
    return map_of(rows[best], ends, ENDS)


def _draw_theta_lengths_weights(
    experiment: Experiment, kinds: Posterior, least: int, rng: np.random.Generator
) -> tuple[list[FloatArray], FloatArray, FloatArray]:
    """Draw hypotheses; return a list of theta, one array per kind, and all lengths, (n, n_lengths), and weights, (n,).

    Improbable kinds get more samples than their probability, with less weight, since they may differ in the shape.
    """
    assert experiment.goal is not None
    probability = kinds.probability
    wanted = np.where(probability > _COUNTS, probability**_FAIRNESS, 0.0)
    counts = np.where(wanted > 0, np.maximum(_HYPOTHESES * wanted / wanted.sum(), least), 0).astype(int)
    theta, whole, weight = [], [], []
    for kind, particles, n, p in zip(kinds.kinds, kinds.particles, counts, probability, strict=True):
        own = particles.weighted.samples(int(n), rng=rng) if n else np.empty((0, len(kind.prior.names)))
        theta.append(own)
        if n:
            whole.append(kind.member.to_whole_theta(own, rng))
            weight.append(np.full(n, p / n))
    share = np.concatenate(weight)
    aligned = theta_with_aligned_angles(experiment, np.concatenate(whole), share)
    return theta, aligned[:, np.array(experiment.goal.columns)], share / share.sum()


def _candidate_designs(
    experiment: Experiment,
    given: UtilityInput,
    utilities: UtilityMap,
    theta: list[FloatArray],
    readings: tuple[Reading, ...],
    rng: np.random.Generator,
) -> IntArray:
    """Choose the candidates; return their indices among the available designs, (n,), sorted."""
    start, n_shape = int(experiment.shape_columns[0]), len(experiment.shape.prior.names)
    shapes = np.concatenate([own[:, start : start + n_shape] for own in theta if len(own)])
    some = shapes[rng.choice(len(shapes), _AT_EDGES)]  # equally often, regardless of probability
    places = [_places_of(readings), *(card.informative_places_mm for card in experiment.cards)]
    region = experiment.shape.region(some)
    if isinstance(region, EllipseRegion | PolygonRegion):
        edges = outlines(region)
        places.append(np.array([edge[rng.integers(len(edge))] for edge in edges]))
        places.append(np.array([edge[:-1].mean(axis=0) for edge in edges[: _AT_EDGES // 4]]))
    there = _places_mm(given)
    nearest = [int(np.argmin(((there - place) ** 2).sum(axis=1))) for place in np.concatenate(places)]
    best = np.argsort(-utilities.values[given.rows], kind="stable")[:_BEST]
    return np.unique(np.concatenate([best, nearest, rng.integers(len(there), size=_ANYWHERE)]))


def _plan_from_arm_to_candidates(given: UtilityInput, rows: IntArray, readings: Sequence[Reading]) -> Plan:
    """Return a plan with a scan of two rows per candidate: the arm's current place, then the candidate's."""
    n, last = len(rows), readings[-1]
    at = given.rows[rows]
    taken = given.plan.take(np.repeat(at, 2))
    x_mm, y_mm, time_s = taken.x_mm.copy(), taken.y_mm.copy(), np.repeat(last.time_s, 2 * n)
    x_mm[::2], y_mm[::2] = last.pose.x_mm, last.pose.y_mm
    time_s[1::2] += given.cost_s[rows]
    scan = np.repeat(np.arange(n), 2)
    names = tuple(str(k) for k in range(n))
    plan = replace(taken, x_mm=x_mm, y_mm=y_mm, time_s=time_s, scan=scan, scan_names=names)
    return Pace.from_readings(readings).plan_with_paced_time(plan)


def expected_bits_about_left_out_effect(
    weight: FloatArray, answers: FloatArray, names: NDArray[np.str_], readout: Readout, *, repeats: int = 1
) -> FloatArray:
    """Return the expected information of a reading about the name of the effect left out, bits, (n_designs,).

    It is the smaller of two estimates, which both err upwards: one Gaussian per name, where a few predictions lie far
    from the others; a histogram of the readings, where a name has few hypotheses. The parameters of shape and effect do
    not count. `weight`, sum 1, and `names` are of each hypothesis, (n,), `answers` the predicted readings, (n,
    n_designs), and `repeats` the number of readings at each design, of which the mean counts.
    """
    each = [names == name for name in np.unique(names)]
    by_gaussians = _expected_bits_by_gaussians(weight, answers, each, readout.noise_sd / math.sqrt(repeats))
    by_cells = _expected_bits_by_cells(weight, answers, each, readout, repeats)
    return np.asarray(np.maximum(np.minimum(by_gaussians, by_cells), 0.0))


def _expected_bits_by_gaussians(
    weight: FloatArray, answers: FloatArray, each: Sequence[BoolArray], noise_sd: float
) -> FloatArray:
    """Return bits about the name, (n_designs,), if the predictions of each name are Gaussian.

    `each` holds the mask of each name's hypotheses, (n,).
    """
    share, mean, sd = [], [], []
    for own in each:
        part = float(weight[own].sum())
        average = weight[own] @ answers[own] / part
        share.append(part)
        mean.append(average)
        sd.append(np.sqrt(weight[own] @ (answers[own] - average) ** 2 / part + noise_sd**2))
    p, middle, width = np.array(share)[:, None], np.array(mean), np.array(sd)
    # The entropy of the mixture, by Gauss-Hermite nodes about each name's Gaussian.
    nodes, node_weight = np.polynomial.hermite_e.hermegauss(_NODES)
    node_weight = node_weight / node_weight.sum()
    nats = np.zeros(answers.shape[1])
    for k, part in enumerate(share):
        at = middle[k] + width[k] * nodes[:, None]
        log_density = -0.5 * ((at[:, None] - middle) / width) ** 2 - np.log(width)
        most = log_density.max(axis=1)
        of_all = most + np.log((p * np.exp(log_density - most[:, None])).sum(axis=1))
        nats += part * (node_weight @ (log_density[:, k] - of_all))
    return np.asarray(nats / math.log(2.0))


def _expected_bits_by_cells(
    weight: FloatArray, answers: FloatArray, each: Sequence[BoolArray], readout: Readout, repeats: int
) -> FloatArray:
    """Return bits about the name, (n_designs,): entropy of the histogram of readings minus its mean given the name."""
    given = WeightsGivenReading.of(answers, weight, readout, fine=_CELL, repeats=repeats)
    bits = entropy_bits(given.weight_by_cell)
    for own in each:
        part = float(weight[own].sum())
        bits -= part * entropy_bits(given.weighted_sum_by_cell(own / part))
    return np.asarray(bits)


def far_side(
    given: UtilityInput, region: Region, readings: Sequence[Reading]
) -> tuple[int | None, Callable[[FloatArray], BoolArray]]:
    """Return the design on the side of one region that no reading has seen, and which places would show that side.

    The design is the available one at the place on the outline within reach that is farthest from the readings at the
    outline: None if one of these is nearer to that place than 0.75 of the diameter. The function marks places, (n, 2)
    -> (n,), at which one more reading would leave none. A reading farther than one spacing of the grid from the outline
    has seen nothing of it. Of a region that is no ellipse or polygon, or out of reach, there is no far side.
    """
    there, grid = _places_mm(given), given.designs.grid
    spacing = max(grid.width_mm / (grid.n_x - 1), grid.height_mm / (grid.n_y - 1))
    edge = outlines(region)[0] if isinstance(region, EllipseRegion | PolygonRegion) else np.empty((0, 2))
    away = np.linalg.norm(edge[:, None] - there, axis=2)
    within = away.min(axis=1, initial=np.inf) <= spacing
    if not within.any():
        return None, lambda places_mm: np.ones(len(places_mm), dtype=np.bool_)
    edge, nearest = edge[within], away.argmin(axis=1)[within]
    most = _FAR * float(np.linalg.norm(edge[:, None] - edge, axis=2).max())

    def distances(places_mm: FloatArray) -> FloatArray:
        """Return the distance of each place on the outline from readings, (n_edge, n), infinite for those elsewhere."""
        apart = np.linalg.norm(edge[:, None] - places_mm, axis=2)
        return np.where(apart.min(axis=0) <= _AT_EDGE * spacing, apart, np.inf)

    taken = _places_of([reading for reading in readings if not math.isnan(reading.value)])
    read = distances(taken).min(axis=1, initial=np.inf)
    farthest = int(read.argmax())
    far = int(nearest[farthest]) if read[farthest] > most else None
    return far, lambda places_mm: np.minimum(distances(places_mm), read[:, None]).max(axis=0) <= most


def _places_mm(given: UtilityInput) -> FloatArray:
    """Return x and y of the available designs, (n, 2)."""
    return np.stack([given.plan.x_mm[given.rows], given.plan.y_mm[given.rows]], axis=1)


def _places_of(readings: Sequence[Reading]) -> FloatArray:
    """Return x and y of readings, (n, 2)."""
    return np.array([[reading.pose.x_mm, reading.pose.y_mm] for reading in readings]).reshape(-1, 2)
