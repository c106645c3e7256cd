"""Utility of a reading for shape and sensor faults jointly, and near the end for ending the run.

Several kinds of hypotheses may explain all readings and differ in the shape. The utility is the expected information
about all kinds together. Once some reading has a chance of 25 % or more to meet the stopping rule, the utility is that
chance: kinds that are aliased but agree on the shape need not be distinguished. Bits about the effect left out are
added, and readings that leave a side of the shape unread count half (`checking`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import FloatArray, IntArray
from probewise.arm.instrument import Reading
from probewise.experiment.aligned_angles import theta_with_aligned_angles
from probewise.experiment.checking import (
    ENOUGH_BITS,
    FAR_SIDE,
    NAMES,
    OutlineReadingDistances,
    available_places_mm,
    expected_bits_about_left_out_effect,
)
from probewise.experiment.configuration import MOST_OFF, Experiment
from probewise.experiment.pace import Pace
from probewise.experiment.posterior import Posterior
from probewise.experiment.stopping_rule import OFF_SDS
from probewise.inquiry import UtilityInput, UtilityMap
from probewise.inquiry.given_reading import WeightsGivenReading
from probewise.recordings.plan import Plan
from probewise.scene import outlines
from probewise.scene.regions import EllipseRegion, PolygonRegion

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
_LABEL = "expected information about the shape and what the sensor leaves out (bits)"
_ENDS = "probability that a reading there ends the run, plus bits about what the sensor leaves out"


def utility_map_and_must_continue(
    experiment: Experiment,
    posterior: Posterior,
    utility_input: UtilityInput,
    utilities: UtilityMap,
    readings: tuple[Reading, ...],
    *,
    rng: np.random.Generator,
    known: bool = False,
) -> tuple[UtilityMap, bool]:
    """Return the utility map for all kinds near the end of a run, and whether the run has to continue all the same.

    Far from the end, or without a goal (a set of shapes), return the given map and False. `known` says whether the
    posterior meets the stopping rule; even so, the run continues for a reading on the far side of the shape, or for one
    with 0.05 bits or more expected about the effect that the sensor model leaves out.

    Candidates are the designs with the largest information, those at edges and centres of sampled shapes, on the far
    side, at cards and at earlier places, and some random ones; all others get utility 0.
    """
    goal = utility_input.goal
    if goal is None:
        return utilities, False
    theta, lengths, weight = _draw_theta_lengths_weights(
        experiment, posterior, _LEAST_OF_NAMES if known else _LEAST_EACH, rng
    )
    spread = weight @ (lengths - weight @ lengths) ** 2
    if np.sqrt(spread.max()) > _NEAR * experiment.stop_sd_mm:
        return utilities, False
    outline = OutlineReadingDistances.from_region(
        utility_input, experiment.shape.region(_mean_shape_theta(experiment, utility_input)), readings
    )
    far = () if outline is None or outline.far_side_design is None else (outline.far_side_design,)
    rows = np.union1d(_candidate_designs(experiment, utility_input, utilities, theta, readings, rng), far).astype(
        np.int64
    )
    plan = Pace.from_readings(readings).plan_with_paced_time(
        _plan_from_arm_to_candidates(utility_input, rows, readings[-1])
    )
    answers = np.concatenate(
        [kind.model.predict(own, plan)[:, 1::2] for kind, own in zip(posterior.kinds, theta, strict=True) if len(own)]
    )
    n_repeats = utility_input.designs.n_repeats[utility_input.rows[rows]]
    names = np.array([kind.left_out for kind, own in zip(posterior.kinds, theta, strict=True) for _ in own])
    seen = (
        np.ones(len(rows), dtype=np.bool_)
        if outline is None
        else outline.leaves_no_far_side_mask(available_places_mm(utility_input)[rows])
    )
    if known and not far:
        utility = _bits_about_names(weight, answers, names, n_repeats, utility_input)
        return _utility_map_of_candidates(utility_input, utilities, rows, utility, NAMES), bool(
            utility.max() >= ENOUGH_BITS
        )
    utility = _expected_bits(weight, answers, n_repeats, utility_input)
    if known:
        # The far side first: it has to be read in any case, and tells something about the names too.
        there = seen if seen.any() else np.isin(rows, far)
        return _utility_map_of_candidates(
            utility_input, utilities, rows, np.where(there, np.maximum(utility, _LEAST_BITS), 0.0), FAR_SIDE
        ), True
    order = np.argsort(-utility, kind="stable")
    best = np.unique(np.concatenate([order[:_ENDING], order[seen[order]][:_ENDING]]))
    chance = _probability_of_meeting_rule(
        lengths,
        weight,
        answers[:, best],
        n_repeats[best],
        utility_input,
        goal.sd,
        OFF_SDS * experiment.stop_sd_mm,
    )
    if chance.max() < _LEAST_CHANCE:
        return _utility_map_of_candidates(utility_input, utilities, rows, utility, _LABEL), False
    # Another reading has to follow where the far side is left; of two that are alike, the one that tells names counts.
    ends = chance * np.where(seen[best], 1.0, _UNSEEN) + _bits_about_names(
        weight, answers[:, best], names, n_repeats[best], utility_input
    )
    return _utility_map_of_candidates(utility_input, utilities, rows[best], ends, _ENDS), False


def _utility_map_of_candidates(
    utility_input: UtilityInput, utilities: UtilityMap, rows: IntArray, utility: FloatArray, label: str
) -> UtilityMap:
    """Return the utility map with these values, (n,), for some available designs and 0 for the others."""
    values = np.zeros(len(utility_input.designs))
    values[utility_input.rows[rows]] = utility
    values.flags.writeable = False
    return UtilityMap(utility_input.designs, values, utilities.reachable, label)


def _mean_shape_theta(experiment: Experiment, utility_input: UtilityInput) -> FloatArray:
    """Return the posterior mean of the shape's parameters, (1, n_params)."""
    theta = utility_input.theta[:, experiment.shape_columns]
    return np.asarray((utility_input.weight @ theta)[None] / utility_input.weight.sum())


def _draw_theta_lengths_weights(
    experiment: Experiment, posterior: Posterior, least: int, rng: np.random.Generator
) -> tuple[list[FloatArray], FloatArray, FloatArray]:
    """Draw hypotheses; return a list of theta, one array per kind, and all lengths, (n, n_lengths), and weights, (n,).

    Improbable kinds get more samples than their probability, with less weight, since they may differ in the shape.
    """
    probability = posterior.probability
    asked = np.where(probability > _COUNTS, probability**_FAIRNESS, 0.0)
    counts = np.where(asked > 0, np.maximum(_HYPOTHESES * asked / asked.sum(), least), 0).astype(int)
    columns = np.array(experiment.goal.columns) if experiment.goal is not None else np.empty(0, dtype=int)
    theta, whole, weight = [], [], []
    for kind, particles, n, p in zip(posterior.kinds, posterior.particles, counts, probability, strict=True):
        own = particles.weighted.samples(int(n), rng=rng) if n else np.empty((0, len(kind.prior.names)))
        theta.append(own)
        if n:
            whole.append(kind.to_whole_theta(own, rng))
            weight.append(np.full(n, p / n))
    share = np.concatenate(weight)
    aligned = theta_with_aligned_angles(experiment, np.concatenate(whole), share)
    return theta, aligned[:, columns], share / share.sum()


def _candidate_designs(
    experiment: Experiment,
    utility_input: UtilityInput,
    utilities: UtilityMap,
    theta: list[FloatArray],
    readings: tuple[Reading, ...],
    rng: np.random.Generator,
) -> IntArray:
    """Choose the candidates; return their indices among the available designs, (n,), sorted."""
    utility = utilities.values[utility_input.rows]
    n_shape = len(experiment.shape.prior.names)
    start = int(experiment.shape_columns[0])
    shapes = np.concatenate([own[:, start : start + n_shape] for own in theta if len(own)])
    some = shapes[rng.choice(len(shapes), _AT_EDGES)]  # equally often, regardless of probability
    places = [np.array([[r.pose.x_mm, r.pose.y_mm] for r in readings])]
    places += [card.informative_places_mm for card in experiment.cards]
    region = experiment.shape.region(some)
    if isinstance(region, EllipseRegion | PolygonRegion):
        edges = outlines(region)
        places.append(np.array([edge[rng.integers(len(edge))] for edge in edges]))
        places.append(np.array([edge[:-1].mean(axis=0) for edge in edges[: _AT_EDGES // 4]]))
    wanted = np.concatenate(places)
    there = np.stack([utility_input.plan.x_mm[utility_input.rows], utility_input.plan.y_mm[utility_input.rows]], axis=1)
    nearest = np.array([int(np.argmin(((there - place) ** 2).sum(axis=1))) for place in wanted])
    best = np.argsort(-utility, kind="stable")[:_BEST]
    return np.unique(np.concatenate([best, nearest, rng.integers(len(there), size=_ANYWHERE)]))


def _plan_from_arm_to_candidates(utility_input: UtilityInput, rows: IntArray, last: Reading) -> Plan:
    """Return a plan with a scan of two rows per candidate: the arm's current place, then the candidate's."""
    n = len(rows)
    at = utility_input.rows[rows]
    taken = utility_input.plan.take(np.repeat(at, 2))
    x_mm, y_mm, time_s = taken.x_mm.copy(), taken.y_mm.copy(), np.repeat(last.time_s, 2 * n)
    x_mm[::2], y_mm[::2] = last.pose.x_mm, last.pose.y_mm
    time_s[1::2] += utility_input.cost_s[rows]
    scan = np.repeat(np.arange(n), 2)
    return replace(taken, x_mm=x_mm, y_mm=y_mm, time_s=time_s, scan=scan, scan_names=tuple(str(k) for k in range(n)))


def _bits_about_names(
    weight: FloatArray,
    answers: FloatArray,
    names: NDArray[np.str_],
    n_repeats: IntArray,
    utility_input: UtilityInput,
) -> FloatArray:
    """Return the expected information about the effect left out, (n_designs,), by the repeats of each design."""
    out = np.empty(answers.shape[1])
    for n, own in _designs_by_repeats(n_repeats):
        out[own] = expected_bits_about_left_out_effect(weight, answers[:, own], names, utility_input.readout, repeats=n)
    return out


def _expected_bits(
    weight: FloatArray, answers: FloatArray, n_repeats: IntArray, utility_input: UtilityInput
) -> FloatArray:
    """Return the expected information, (n_designs,), in bits, by predictions, (n, n_designs), and weights, (n,)."""
    out = np.empty(answers.shape[1])
    for n, own in _designs_by_repeats(n_repeats):
        out[own] = WeightsGivenReading(answers[:, own], weight, utility_input.readout, repeats=n).information_bits
    return out


def _probability_of_meeting_rule(
    lengths: FloatArray,
    weight: FloatArray,
    answers: FloatArray,
    n_repeats: IntArray,
    utility_input: UtilityInput,
    goal_sd_mm: float,
    off_mm: float,
) -> FloatArray:
    """Return the probability, (n_designs,), that the posterior after a design's readings meets the stopping rule."""
    away = lengths - weight @ lengths
    out = np.empty(answers.shape[1])
    for n, own in _designs_by_repeats(n_repeats):
        given = WeightsGivenReading(answers[:, own], weight, utility_input.readout, repeats=n)
        for design, (row, mass) in enumerate(zip(own.tolist(), given.weight_by_cell, strict=True)):
            joint = given.weight_by_hypothesis_and_cell(design)
            ends, off = np.ones(len(mass), dtype=np.bool_), np.zeros(joint.shape, dtype=np.bool_)
            for length in away.T:
                mean = length @ joint / mass
                ends &= length**2 @ joint / mass - mean**2 < goal_sd_mm**2
                off |= np.abs(length[:, None] - mean) > off_mm
            ends &= np.where(off, joint, 0.0).sum(axis=0) < MOST_OFF * mass
            out[row] = mass[ends].sum() / mass.sum()
    return out


def _designs_by_repeats(n_repeats: IntArray) -> Iterator[tuple[int, IntArray]]:
    """Yield each number of repeats, of which the mean counts, and the indices of the designs that have it."""
    for n in np.unique(n_repeats).tolist():
        yield n, np.flatnonzero(n_repeats == n)
