"""Value a reading by how much narrower it leaves the shape, whatever the sensor leaves out.

Several kinds of hypotheses may agree on every reading so far and differ in the shape. What tells
them apart is worth a reading as far as it narrows the lengths under all of them together; what tells only which
of them is true, where they agree on the shape, is worth nothing. So the value is the expected fall of the
lengths' variance under the mixture, in bits of a Gaussian: half the log of the ratio, summed over lengths.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.arm.instrument import Reading
from probewise.experiment.posterior import Posterior
from probewise.experiment.setting import Experiment
from probewise.inquiry import Prospect, UtilityMap
from probewise.inquiry.given_reading import GivenReading
from probewise.recordings.plan import Plan
from probewise.scene import outlines
from probewise.scene.regions import EllipseRegion, PolygonRegion

__all__ = ["settling"]

_NEAR = 15.0  # times the sd that is asked for: farther off than that, bits about everything serve as well
_HYPOTHESES = 400
_LEAST_EACH = 6
_COUNTS = 1e-5  # probability of a kind that is asked
_BEST = 60  # places, by the information about everything
_AT_EDGES = 40
_ANYWHERE = 20
_LABEL = "expected bits about the shape, whatever the sensor leaves out"


def settling(
    experiment: Experiment,
    posterior: Posterior,
    prospect: Prospect,
    outlook: UtilityMap,
    readings: tuple[Reading, ...],
    *,
    rng: np.random.Generator,
) -> UtilityMap:
    """Value designs by what they tell about the lengths under all kinds; before the shape is met, the map as it is.

    Asked are the designs that are best by the information about everything, those at edges and in the middle of
    shapes that are believed, places that were read before, and some anywhere.
    """
    if experiment.goal is None:
        return outlook
    theta, lengths, weight = _drawn(experiment, posterior, rng)
    spread = weight @ (lengths - weight @ lengths) ** 2
    if np.sqrt(spread.max()) > _NEAR * experiment.stop_sd_mm:
        return outlook
    rows = _candidates(experiment, prospect, outlook, theta, readings, rng)
    plan = _plan(prospect, rows, readings[-1])
    answers = np.concatenate(
        [kind.model.predict(own, plan)[:, 1::2] for kind, own in zip(posterior.kinds, theta, strict=True) if len(own)]
    )
    bits = _bits(lengths, weight, spread, answers, prospect)
    values = np.zeros(len(prospect.designs))
    values[prospect.rows[rows]] = bits
    values.flags.writeable = False
    return UtilityMap(prospect.designs, values, outlook.reachable, _LABEL)


def _drawn(
    experiment: Experiment, posterior: Posterior, rng: np.random.Generator
) -> tuple[list[FloatArray], FloatArray, FloatArray]:
    """Draw hypotheses: those of each kind, and of all of them the lengths, (n, n_lengths), and the weights, (n,).

    Improbable kinds are asked more often than they are probable: they may be those that differ in the shape.
    """
    probability = posterior.probability
    asked = np.where(probability > _COUNTS, np.sqrt(probability), 0.0)
    counts = np.where(asked > 0, np.maximum(_HYPOTHESES * asked / asked.sum(), _LEAST_EACH), 0).astype(int)
    columns = np.array(experiment.goal.columns) if experiment.goal is not None else np.empty(0, dtype=int)
    theta, lengths, weight = [], [], []
    for kind, particles, n, p in zip(posterior.kinds, posterior.particles, counts, probability, strict=True):
        own = particles.weighted.samples(int(n), rng=rng) if n else np.empty((0, len(kind.prior.names)))
        theta.append(own)
        if n:
            lengths.append(kind.placed(own, rng)[:, columns])
            weight.append(np.full(n, p / n))
    share = np.concatenate(weight)
    return theta, np.concatenate(lengths), share / share.sum()


def _candidates(
    experiment: Experiment,
    prospect: Prospect,
    outlook: UtilityMap,
    theta: list[FloatArray],
    readings: tuple[Reading, ...],
    rng: np.random.Generator,
) -> IntArray:
    """Choose which of the designs that can be taken are asked, (n,)."""
    worth = outlook.values[prospect.rows]
    n_shape = len(experiment.shape.prior.names)
    start = int(experiment.shape_columns[0])
    shapes = np.concatenate([own[:, start : start + n_shape] for own in theta if len(own)])
    some = shapes[rng.choice(len(shapes), _AT_EDGES)]  # each as often, however probable
    places = [np.array([[r.pose.x_mm, r.pose.y_mm] for r in readings])]
    region = experiment.shape.region(some)
    if isinstance(region, EllipseRegion | PolygonRegion):
        edges = outlines(region)
        places.append(np.array([edge[rng.integers(len(edge))] for edge in edges]))
        places.append(np.array([edge[:-1].mean(axis=0) for edge in edges[: _AT_EDGES // 4]]))
    wanted = np.concatenate(places)
    there = np.stack([prospect.plan.x_mm[prospect.rows], prospect.plan.y_mm[prospect.rows]], axis=1)
    nearest = np.array([int(np.argmin(((there - place) ** 2).sum(axis=1))) for place in wanted])
    best = np.argsort(-worth, kind="stable")[:_BEST]
    return np.unique(np.concatenate([best, nearest, rng.integers(len(there), size=_ANYWHERE)]))


def _plan(prospect: Prospect, rows: IntArray, last: Reading) -> Plan:
    """Lay out each candidate as a scan of its own that begins where the arm stands: direction and time are its own."""
    n = len(rows)
    at = prospect.rows[rows]
    taken = prospect.plan.take(np.repeat(at, 2))
    x_mm, y_mm, time_s = taken.x_mm.copy(), taken.y_mm.copy(), np.repeat(last.time_s, 2 * n)
    x_mm[::2], y_mm[::2] = last.pose.x_mm, last.pose.y_mm
    time_s[1::2] += prospect.cost_s[rows]
    scan = np.repeat(np.arange(n), 2)
    return replace(taken, x_mm=x_mm, y_mm=y_mm, time_s=time_s, scan=scan, scan_names=tuple(str(k) for k in range(n)))


def _bits(
    lengths: FloatArray, weight: FloatArray, spread: FloatArray, answers: FloatArray, prospect: Prospect
) -> FloatArray:
    """Half the log2 ratio of each length's variance before and, on average, after a reading, summed, (n_designs,)."""
    given = GivenReading(answers, weight, prospect.readout)
    bits = np.zeros(answers.shape[1])
    for length, now in zip((lengths - weight @ lengths).T, spread, strict=True):
        after = now - (given.sum(length) ** 2 / given.mass).sum(axis=1)
        bits += 0.5 * np.log2(now / np.maximum(after, 1e-3 * now))
    return np.maximum(bits, 0.0)
