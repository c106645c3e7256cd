"""Inquire: the utility of every available reading, and the choice of the next (paper, section 2.3).

Far from the end, and while no rival was searched, the utility is the experiment's, with the sensor model alone, unless
that is surely incomplete. Near the end of a run with doubt in its sensor, several kinds of hypotheses may explain all
readings and differ in the shape. Then the utility is the expected information about all kinds together; once some
reading has a chance of 25 % or more to meet the stopping rule, that chance: kinds that are aliased but agree on the
shape need not be distinguished. Bits about the left-out effect are added.

Before such a run ends, two things are checked. A dozen readings that fit the sensor model cannot exclude most left-out
effects, and one further reading would show some. And if a shape was read from one side only, its far side follows from
the sensor model alone: with an unknown effect left out, the result may be wrong by any amount.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.arm.carry_out import PATTERN
from probewise.arm.instrument import Instrument, Pose, Reading
from probewise.experiment.evidence import sleeping_mask
from probewise.experiment.judgement import MOST_PROBABILITY_WRONG, WRONG_SDS, Judgement, theta_with_aligned_angles
from probewise.experiment.kinds import PosteriorByKind
from probewise.experiment.rivals import Pace
from probewise.experiment.setup import Experiment
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
"""Expected information about the left-out effect for which a reading is taken after the target is reached."""

LEFT_OUT_LABEL = "expected information about what the sensor leaves out (bits)"
FAR_SIDE_LABEL = "expected information (bits) on the side of the shape that no reading has seen"
INFORMATION_LABEL = "expected information about the shape and what the sensor leaves out (bits)"
ENDS_RUN_LABEL = "probability that a reading there ends the run, plus bits about what the sensor leaves out"

_LEAST_COMPLETE = 0.05  # probability of a complete sensor model, below which it is surely incomplete
_MUCH_BITS = 0.25  # the same where the sensor model is surely incomplete
_MISSING_REACH = 0.1  # of the field's diagonal: from there on, a missing reading hardly counts
_SAME_MM = 1.0  # closer than this, two places count as one
_N_NODES = 12  # of the reading expected under a left-out effect
_CELL_SDS = 0.5  # noise sds: cells of the reading; twice as wide, they lose four times as much
_FAR_SIDE_DIAMETERS = 0.75  # of the shape's diameter: two opposite readings at the edge of a circle leave 0.71
_EDGE_SPACINGS = 1.0  # spacings of the grid within which a reading is at the edge
_NEAR_TARGET_SDS = 15.0  # times the target sd: beyond it, the ordinary information is used
_N_HYPOTHESES = 800
_PROBABILITY_POWER = 0.75  # power of a kind's probability in its share of the drawn hypotheses
_LEAST_PER_KIND = 30
_LEAST_FOR_LEFT_OUT = 120  # for moments: with 30, their scatter alone tells 0.03 bits at the best of the candidates
_LEAST_KIND_PROBABILITY = 1e-5  # least probability of a kind to be included
_N_BEST_CANDIDATES = 60  # places with the largest information about all parameters
_N_EDGE_CANDIDATES = 40
_N_RANDOM_CANDIDATES = 20
_LEAST_CHANCE = 0.25  # probability of ending the run, from which on it replaces the information
_N_ENDING_CANDIDATES = 60  # most informative places, tested for ending the run, and most informative on the far side
_LEAST_BITS = 1e-3  # of a reading of the far side, which is taken even if it promises nothing
_UNSEEN_FACTOR = 0.5  # on the probability of reaching the target if the far side is still to be read


def inquire(
    experiment: Experiment,
    by_kind: PosteriorByKind,
    posterior: Weighted,
    drawn: FloatArray,
    judged: Judgement,
    reach: ArmReachAndTravel,
    readings: tuple[Reading, ...],
    *,
    rng: np.random.Generator,
) -> tuple[UtilityInput, UtilityMap]:
    """Compute the utility of every available reading after a judgement.

    `by_kind`, `posterior` and `drawn` (n_samples, n_params) are as `infer` returns them. Return the input of utilities
    (posterior, available designs, their costs in seconds), and the utility of each design.
    """
    goal = experiment.goal
    if goal is not None and judged.arm_error is not None:  # what the arm's error leaves to the readings
        lengths = np.array(goal.columns) - experiment.shape_columns[0]
        left = goal.sd**2 - float(judged.arm_error.sd[lengths].max()) ** 2
        goal = replace(goal, sd=math.sqrt(left)) if left > 0 else goal
    inputs, utilities = predict_readings_and_utilities(experiment, posterior, drawn, reach, at=readings[-1], goal=goal)
    asleep = by_kind.doubts_sensor and all(sleeping_mask(by_kind) | [not kind.left_out for kind in by_kind.kinds])
    if experiment.trust == 1 or (asleep and not judged.target_reached):
        return inputs, utilities
    of_all, mean, reached = by_kind.with_raised_left_out_odds(), judged.mean, judged.target_reached
    return inputs, utilities_near_end(
        experiment, of_all, inputs, utilities, readings, mean=mean, rng=rng, target_reached=reached
    )


def must_continue(utilities: UtilityMap, by_kind: PosteriorByKind) -> bool:
    """Return whether a run that has reached its target goes on for a check: of the far side, or of the sensor.

    Once the sensor model is surely incomplete, the shape is known under every effect that may be left out; which one
    it is matters less, and only a reading with much information about it is taken.
    """
    least = ENOUGH_BITS if by_kind.left_out.get("", 0.0) >= _LEAST_COMPLETE else _MUCH_BITS
    label = utilities.label
    return label == FAR_SIDE_LABEL or (label == LEFT_OUT_LABEL and utilities.highest_utility >= least)


@dataclass(frozen=True, eq=False)
class ArmReachAndTravel:
    """Reach, orientation of the sensor and travel time of an arm at the places of a grid.

    `reachable` marks the places within reach; `orientation_rad` is that of a sensor that is not turned; both
    (n_places,). `travel_s(pose, places_mm)` returns the seconds from a pose to the end of a reading at each place.
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
    reach: ArmReachAndTravel,
    *,
    at: Reading | None,
    goal: Goal | None,
) -> tuple[UtilityInput, UtilityMap]:
    """Predict every available reading, and compute the experiment's utility of it.

    `at` is the last reading, which says where the arm is; None before the first reading, which costs no travel time.
    `goal` is the sd that the lengths have to reach. For the rest, see `inquire`.
    """
    designs = experiment.designs
    rows = reachable_rows(reach.reachable, experiment.grid.n_places, len(designs.setting_combinations))
    if at is None:
        cost_s = designs.n_repeats.astype(np.float64)
    else:
        here = np.array([[at.pose.x_mm, at.pose.y_mm]])
        read_s = float(reach.travel_s(at.pose, here)[0])
        travel_s = reach.travel_s(at.pose, experiment.grid.places_mm)
        if not math.isfinite(read_s):  # the true place, just beyond the reach
            read_s = float(travel_s[reach.reachable].min())
        cost_s = designs.cost_s(travel_s, read_s)
    plan = designs.plan(PATTERN, time_s=0.0 if at is None else at.time_s)
    standing = np.tile(reach.orientation_rad, len(designs.setting_combinations))
    plan = replace(plan, orientation_rad=plan.orientation_rad + standing, instrumentation=experiment.instrumentation)
    drawn = drawn.copy()
    drawn.flags.writeable = False
    theta, weight = posterior.theta, posterior.weight
    if experiment.trust < 1:  # samples of several kinds: use no more than for one
        some, share = resampled_rows_and_weights(weight, experiment.n_particles)
        theta, weight = theta[some], share / share.sum()
    inputs = UtilityInput(
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
    return inputs, utility_map(inputs, experiment.utility)


def next_poses(
    experiment: Experiment,
    inputs: UtilityInput,
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
    plan = inputs.plan
    chance = _worth_beside_earlier_readings(experiment, readings, np.stack([plan.x_mm, plan.y_mm], axis=1))
    if experiment.batch > 1 and utilities.label == InformationGain.label:
        weight = None if chance is None else chance[inputs.rows]
        rows = choose_several(inputs, experiment.batch, rng=rng, chance=weight)
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

    With doubt in the sensor, a reading within a footprint of n others counts 1/(1 + n): if no kind describes how the
    sensor fails, they would predict much information there again and again.
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
    by_kind: PosteriorByKind,
    inputs: UtilityInput,
    utilities: UtilityMap,
    readings: tuple[Reading, ...],
    *,
    mean: FloatArray,
    rng: np.random.Generator,
    target_reached: bool = False,
) -> UtilityMap:
    """Return the utility map for all kinds near the end of a run.

    Without a goal (a set of shapes), or far from the end while the sensor may be complete, return the given map: by the
    plain sensor, each reading since a light rose would promise an edge beside it. If the target is reached, the utility
    is that of a reading on the far side of the shape, if no reading has seen that, or the expected information about
    the effect that the sensor model leaves out; see `must_continue`.

    Candidates are the designs with the largest information, those at edges and centres of sampled shapes, on the far
    side, at cards and at earlier places, and some random ones; all others get utility 0.
    """
    if inputs.goal is None:
        return utilities
    theta, lengths, weight = _draw_theta_lengths_weights(
        experiment, by_kind, _LEAST_FOR_LEFT_OUT if target_reached else _LEAST_PER_KIND, rng
    )
    spread = weight @ (lengths - weight @ lengths) ** 2
    may_be_complete = by_kind.left_out.get("", 0.0) >= _LEAST_COMPLETE
    if may_be_complete and np.sqrt(spread.max()) > _NEAR_TARGET_SDS * experiment.stop_sd_mm:
        return utilities
    region = experiment.shape.region(mean[None])
    unseen, shows_far_side = far_side(_places_mm(inputs), inputs.designs.grid, region, readings)
    far = () if unseen is None else (unseen,)
    rows = np.union1d(_candidate_designs(experiment, inputs, utilities, theta, readings, rng), far).astype(np.int64)
    plan, kinds = _plan_from_arm_to_candidates(inputs, rows, readings), list(zip(by_kind.kinds, theta, strict=True))
    predicted = np.concatenate([kind.model.predict(some, plan)[:, 1::2] for kind, some in kinds if len(some)])
    n_repeats = inputs.designs.n_repeats[inputs.rows[rows]]
    left_out = np.array([kind.left_out for kind, some in kinds for _ in some])
    seen = shows_far_side(_places_mm(inputs)[rows])

    def map_of(some: IntArray, utility: FloatArray, label: str) -> UtilityMap:
        """Return the utility map with these values, (n,), for some available designs and 0 for the others."""
        values = np.zeros(len(inputs.designs))
        values[inputs.rows[some]] = utility
        values.flags.writeable = False
        return UtilityMap(inputs.designs, values, utilities.reachable, label)

    def bits_about_left_out(predicted: FloatArray, n: int) -> FloatArray:
        return expected_bits_about_left_out(weight, predicted, left_out, inputs.readout, repeats=n)

    def information_bits(predicted: FloatArray, n: int) -> FloatArray:
        return WeightsGivenReading.of(predicted, weight, inputs.readout, repeats=n).information_bits

    if target_reached and not far:
        return map_of(rows, by_repeats(bits_about_left_out, predicted, n_repeats), LEFT_OUT_LABEL)
    utility = by_repeats(information_bits, predicted, n_repeats)
    if target_reached:
        # The far side first: it has to be read in any case, and also informs about the left-out effect.
        there = seen if seen.any() else np.isin(rows, far)
        return map_of(rows, np.where(there, np.maximum(utility, _LEAST_BITS), 0.0), FAR_SIDE_LABEL)
    order = np.argsort(-utility, kind="stable")
    best = np.unique(np.concatenate([order[:_N_ENDING_CANDIDATES], order[seen[order]][:_N_ENDING_CANDIDATES]]))
    goal_sd_mm, wrong = inputs.goal.sd, {"off": WRONG_SDS * experiment.stop_sd_mm, "most_off": MOST_PROBABILITY_WRONG}

    def chances(predicted: FloatArray, n: int) -> FloatArray:
        after = WeightsGivenReading.of(predicted, weight, inputs.readout, repeats=n)
        return after.probability_of_reaching_target(lengths - weight @ lengths, goal_sd_mm, **wrong)

    of_best = predicted[:, best], n_repeats[best]
    chance = by_repeats(chances, *of_best)
    if chance.max() < _LEAST_CHANCE:
        return map_of(rows, utility, INFORMATION_LABEL)
    # Another reading has to follow where the far side is left; of two that are alike, bits about the effect decide.
    ends = chance * np.where(seen[best], 1.0, _UNSEEN_FACTOR) + by_repeats(bits_about_left_out, *of_best)
    return map_of(rows[best], ends, ENDS_RUN_LABEL)


def _draw_theta_lengths_weights(
    experiment: Experiment, by_kind: PosteriorByKind, least: int, rng: np.random.Generator
) -> tuple[list[FloatArray], FloatArray, FloatArray]:
    """Draw hypotheses; return a list of theta, one array per kind, and all lengths, (n, n_lengths), and weights, (n,).

    Improbable kinds get more samples than their probability, with less weight, since they may differ in the shape.
    """
    assert experiment.goal is not None
    probability = by_kind.probability
    wanted = np.where(probability > _LEAST_KIND_PROBABILITY, probability**_PROBABILITY_POWER, 0.0)
    counts = np.where(wanted > 0, np.maximum(_N_HYPOTHESES * wanted / wanted.sum(), least), 0).astype(int)
    theta, whole, weight = [], [], []
    for kind, particles, n, p in zip(by_kind.kinds, by_kind.particles, counts, probability, strict=True):
        drawn = particles.weighted.samples(int(n), rng=rng) if n else np.empty((0, len(kind.prior.names)))
        theta.append(drawn)
        if n:
            whole.append(kind.member.to_whole_theta(drawn, rng))
            weight.append(np.full(n, p / n))
    share = np.concatenate(weight)
    aligned = theta_with_aligned_angles(experiment, np.concatenate(whole), share)
    return theta, aligned[:, np.array(experiment.goal.columns)], share / share.sum()


def _candidate_designs(
    experiment: Experiment,
    inputs: UtilityInput,
    utilities: UtilityMap,
    theta: list[FloatArray],
    readings: tuple[Reading, ...],
    rng: np.random.Generator,
) -> IntArray:
    """Choose the candidates; return their indices among the available designs, (n,), sorted."""
    start, n_shape = int(experiment.shape_columns[0]), len(experiment.shape.prior.names)
    shapes = np.concatenate([some[:, start : start + n_shape] for some in theta if len(some)])
    some = shapes[rng.choice(len(shapes), _N_EDGE_CANDIDATES)]  # equally often, regardless of probability
    places = [_places_of(readings), *(card.informative_places_mm for card in experiment.cards)]
    region = experiment.shape.region(some)
    if isinstance(region, EllipseRegion | PolygonRegion):
        edges = outlines(region)
        places.append(np.array([edge[rng.integers(len(edge))] for edge in edges]))
        places.append(np.array([edge[:-1].mean(axis=0) for edge in edges[: _N_EDGE_CANDIDATES // 4]]))
    there = _places_mm(inputs)
    nearest = [int(np.argmin(((there - place) ** 2).sum(axis=1))) for place in np.concatenate(places)]
    best = np.argsort(-utilities.values[inputs.rows], kind="stable")[:_N_BEST_CANDIDATES]
    return np.unique(np.concatenate([best, nearest, rng.integers(len(there), size=_N_RANDOM_CANDIDATES)]))


def _plan_from_arm_to_candidates(inputs: UtilityInput, rows: IntArray, readings: Sequence[Reading]) -> Plan:
    """Return a plan with a scan of two rows per candidate: the arm's current place, then the candidate's."""
    n, last = len(rows), readings[-1]
    at = inputs.rows[rows]
    taken = inputs.plan.take(np.repeat(at, 2))
    x_mm, y_mm, time_s = taken.x_mm.copy(), taken.y_mm.copy(), np.repeat(last.time_s, 2 * n)
    x_mm[::2], y_mm[::2] = last.pose.x_mm, last.pose.y_mm
    time_s[1::2] += inputs.cost_s[rows]
    scan = np.repeat(np.arange(n), 2)
    names = tuple(str(k) for k in range(n))
    plan = replace(taken, x_mm=x_mm, y_mm=y_mm, time_s=time_s, scan=scan, scan_names=names)
    return Pace.from_readings(readings).plan_with_paced_time(plan)


def expected_bits_about_left_out(
    weight: FloatArray, predicted: FloatArray, left_out: NDArray[np.str_], readout: Readout, *, repeats: int = 1
) -> FloatArray:
    """Return the expected information of a reading about which effect is left out, bits, (n_designs,).

    It is the smaller of two estimates, which both err upwards: one Gaussian per effect, where a few predictions lie far
    from the others; a histogram of the readings, where an effect has few hypotheses. The parameters of shape and effect
    do not count. `weight`, sum 1, and `left_out`, the effect's name, are of each hypothesis, (n,), `predicted` are the
    readings, (n, n_designs), and `repeats` is the number of readings at each design, of which the mean counts.
    """
    masks = [left_out == name for name in np.unique(left_out)]
    by_gaussians = _expected_bits_by_gaussians(weight, predicted, masks, readout.noise_sd / math.sqrt(repeats))
    # By cells: the entropy of the readings' histogram, less that given each effect.
    weights = WeightsGivenReading.of(predicted, weight, readout, fine=_CELL_SDS, repeats=repeats)
    by_cells = entropy_bits(weights.weight_by_cell)
    for rows in masks:
        part = float(weight[rows].sum())
        by_cells -= part * entropy_bits(weights.weighted_sum_by_cell(rows / part))
    return np.asarray(np.maximum(np.minimum(by_gaussians, by_cells), 0.0))


def _expected_bits_by_gaussians(
    weight: FloatArray, predicted: FloatArray, masks: Sequence[BoolArray], noise_sd: float
) -> FloatArray:
    """Return bits about the left-out effect, (n_designs,), if the predictions under each effect are Gaussian.

    `masks` holds the mask of each effect's hypotheses, (n,).
    """
    share, mean, sd = [], [], []
    for rows in masks:
        part = float(weight[rows].sum())
        average = weight[rows] @ predicted[rows] / part
        share.append(part)
        mean.append(average)
        sd.append(np.sqrt(weight[rows] @ (predicted[rows] - average) ** 2 / part + noise_sd**2))
    p, middle, width = np.array(share)[:, None], np.array(mean), np.array(sd)
    # The entropy of the mixture, by Gauss-Hermite nodes about each effect's Gaussian.
    nodes, node_weight = np.polynomial.hermite_e.hermegauss(_N_NODES)
    node_weight = node_weight / node_weight.sum()
    nats = np.zeros(predicted.shape[1])
    for k, part in enumerate(share):
        at = middle[k] + width[k] * nodes[:, None]
        log_density = -0.5 * ((at[:, None] - middle) / width) ** 2 - np.log(width)
        most = log_density.max(axis=1)
        of_all = most + np.log((p * np.exp(log_density - most[:, None])).sum(axis=1))
        nats += part * (node_weight @ (log_density[:, k] - of_all))
    return np.asarray(nats / math.log(2.0))


def leaves_far_side(
    experiment: Experiment, posterior: Weighted, reach: ArmReachAndTravel, readings: Sequence[Reading]
) -> bool:
    """Return whether a run with doubt in its sensor goes on in any case: no reading has seen the shape's far side."""
    if experiment.trust == 1 or experiment.goal is None:
        return False
    region = experiment.shape.region((posterior.weight @ posterior.theta[:, experiment.shape_columns])[None])
    return far_side(experiment.grid.places_mm[reach.reachable], experiment.grid, region, readings)[0] is not None


def far_side(
    there: FloatArray, grid: Grid, region: Region, readings: Sequence[Reading]
) -> tuple[int | None, Callable[[FloatArray], BoolArray]]:
    """Return the place on the side of a region that no reading has seen, and which places would show that side.

    The place is the number of that of `there`, the places within reach, (n_places, 2), which is nearest to the point of
    the outline that is farthest from the readings at the outline: None if one of these is nearer to that point than
    0.75 of the diameter. The function marks places, (n, 2) -> (n,), at which one more reading would leave none. A
    reading farther than one spacing of the grid from the outline does not count. Of a region that is no ellipse or
    polygon, or out of reach, there is no far side.
    """
    spacing = max(grid.width_mm / (grid.n_x - 1), grid.height_mm / (grid.n_y - 1))
    edge = outlines(region)[0] if isinstance(region, EllipseRegion | PolygonRegion) else np.empty((0, 2))
    away = np.linalg.norm(edge[:, None] - there, axis=2)
    within = away.min(axis=1, initial=np.inf) <= spacing
    if not within.any():
        return None, lambda places_mm: np.ones(len(places_mm), dtype=np.bool_)
    edge, nearest = edge[within], away.argmin(axis=1)[within]
    most = _FAR_SIDE_DIAMETERS * float(np.linalg.norm(edge[:, None] - edge, axis=2).max())

    def distances(places_mm: FloatArray) -> FloatArray:
        """Return the distance of each place on the outline from readings, (n_edge, n), infinite for those elsewhere."""
        apart = np.linalg.norm(edge[:, None] - places_mm, axis=2)
        return np.where(apart.min(axis=0) <= _EDGE_SPACINGS * spacing, apart, np.inf)

    taken = _places_of([reading for reading in readings if not math.isnan(reading.value)])
    read = distances(taken).min(axis=1, initial=np.inf)
    farthest = int(read.argmax())
    far = int(nearest[farthest]) if read[farthest] > most else None
    return far, lambda places_mm: np.minimum(distances(places_mm), read[:, None]).max(axis=0) <= most


def _places_mm(inputs: UtilityInput) -> FloatArray:
    return np.stack([inputs.plan.x_mm[inputs.rows], inputs.plan.y_mm[inputs.rows]], axis=1)


def _places_of(readings: Sequence[Reading]) -> FloatArray:
    return np.array([[reading.pose.x_mm, reading.pose.y_mm] for reading in readings]).reshape(-1, 2)
