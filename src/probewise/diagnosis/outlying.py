"""Readings that are left out before a fit, and tests whether outlying readings cluster in a covariate.

A heavy tail explains any few deviating readings. If they all lie at one level, at one end of a scan or near an edge, an
effect is missing that changes only them. Single readings farther out than the widest tail are lost ones: they would
bend a fit and set the scale of everything, however large they are, so they are left out before. So are readings at an
undeclared end of a meter's range, where it stops: they are exactly equal, which no noise makes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import betaln, ndtri, stdtr

from probewise._arrays import ROUNDING, TINY, BoolArray, FloatArray, IntArray
from probewise._words import count_with_noun
from probewise.diagnosis.fit import Fit, Model, fit, fit_each_start, with_prior
from probewise.diagnosis.locate import Covariate, window_columns
from probewise.diagnosis.noise import LEAST_SCALE, MAD_OF_NORMAL, NoiseLaw, Tail, white_noise_of_recording
from probewise.diagnosis.templates import log_mean_exp
from probewise.effects import NoiseEffect
from probewise.effects.noise import LARGEST_SIZE, MOST_OUTLYING, lattice_step, readings_lost_beyond_doubt
from probewise.inference import sd_floor
from probewise.priors import Uniform
from probewise.recordings.plan import Recording
from probewise.sensor.stages import Stage

FAR_OUT = ", far out"  # suffix of the names of families of unknown effects in which outlying readings cluster
_BY_CHANCE = 0.05  # probability that noise alone has such a reading in a recording
_BENT = 2.0  # noise sds: rms of the residuals from which single readings may have bent a fit
_C_STEPS = 4
# Share of successive readings that are equal, up to which equal ones are a sign of lost values or of a stop. Eight
# equal readings in turn, or five and three, are then by chance in one of 1e5 places, at the end of the range in fewer.
_RARELY = 0.1

_A = 0.5  # parameter of the beta prior of the share of outlying readings (Jeffreys)


def outlier_probabilities(residuals: FloatArray, law: NoiseLaw) -> FloatArray:
    """Return the probability of each residual to be from the wide part of a noise distribution, (n_points,)."""
    if law.wide.size:
        return law.wide
    whitened = law(residuals)
    return Tail(law.share, law.times).wide_probability((whitened / law.likeliest_sigma(whitened[:, None])[0]) ** 2)


def clustering_log_bayes_factors(far_out: FloatArray, covariates: Sequence[Covariate]) -> dict[str, float]:
    """Return log Bayes factors for another share of outlying readings in a window of a covariate than elsewhere.

    `far_out`: probability of each reading to be outlying, (n_points,). Returns by the covariate's name with the suffix
    `FAR_OUT`; Bayes factors are averaged over its windows.
    """
    n, total = len(far_out), float(far_out.sum())
    even = float(betaln(total + _A, n - total + _A) - betaln(_A, _A))
    scores: dict[str, list[FloatArray]] = {}
    for covariate in covariates:
        columns, _ = window_columns(covariate, n)
        if columns.shape[1]:
            inside, many = far_out @ columns, columns.sum(axis=0)
            outside, few = total - inside, n - many
            apart = betaln(inside + _A, many - inside + _A) + betaln(outside + _A, few - outside + _A)
            scores.setdefault(f"{covariate.published_name}{FAR_OUT}", []).append(apart - 2 * betaln(_A, _A) - even)
    return {family: log_mean_exp(np.concatenate(own)) for family, own in scores.items()}


@dataclass(frozen=True, eq=False)
class LostReadings:
    """Readings too far from all others for noise: rows of the recording, sizes in noise sds, and share of the squares.

    `rows` and `in_sds` are (n_lost,); `share` is that of the sum of squared residuals of a fit to the others.
    """

    rows: IntArray
    in_sds: FloatArray
    share: float

    def left_out_of(self, recording: Recording) -> Recording:
        """Return the recording with these readings left out, and a note that says so."""
        n, least = len(self.rows), float(self.in_sds.min())
        far = f"{least:,.0f}" if least < 1e6 else f"{least:.1g}"
        note = (
            f"{count_with_noun(n, 'reading')} left out as lost: {rows_in_words(recording, self.rows)}, {far} noise sds "
            f"{'or more ' if n > 1 else ''}from a fit to the others, with {_percent(self.share)} of the squared "
            "residuals; correct such cells or empty them"
        )
        return replace(recording, left_out=(*recording.left_out, *self.rows.tolist()), notes=(*recording.notes, note))

    def effect(self, recording: Recording) -> NoiseEffect:
        """Return the effect on the noise that lost them."""
        n, unit = int(recording.usable.sum()), recording.plan.instrumentation.unit_after_number
        distance = float(np.linalg.norm(self.in_sds))
        return readings_lost_beyond_doubt(recording.readings[self.rows], n, distance, unit)


def improbable_rows(found: Fit, law: NoiseLaw, *, chance: float = _BY_CHANCE) -> IntArray:
    """Return the residuals, by number, that are improbable among so many if the others tell mean and noise.

    Each is the largest by its deletion residual (a Student t, to first order exact at any leverage) when those before
    it are left out; at most a fifth of all. `chance` is that of any under white noise.
    """
    residual, slopes = law(found.residuals), law(found.slopes)
    if not (np.isfinite(residual).all() and np.isfinite(slopes).all()):
        return np.zeros(0, dtype=np.int64)
    out, kept = list[int](), ~law.lost
    with np.errstate(all="ignore"):
        for _ in range(int(MOST_OUTLYING * kept.sum())):
            basis, singular, _ = np.linalg.svd(slopes[kept] / max(found.sd, LEAST_SCALE), full_matrices=False)
            own = basis * np.sqrt(singular**2 / (1 + singular**2))
            left = residual[kept] - basis @ (basis.T @ residual[kept])
            free = int(kept.sum()) - slopes.shape[1] - 1
            if free < 2:
                break
            unshared = 1 - np.minimum(np.sum(own**2, axis=1), 1 - ROUNDING)
            others = (left @ left - left**2 / unshared) / free
            t = np.abs(left) / np.sqrt(np.maximum(others, TINY) * unshared)
            t[unshared < 1e-6] = 0.0
            worst = int(np.argmax(t))
            if 2 * kept.sum() * stdtr(free, -t[worst]) > chance:
                break
            out.append(int(np.flatnonzero(kept)[worst]))
            kept[out[-1]] = False
    return np.array(out, dtype=np.int64)


def find_lost_readings(
    model: Model,
    recording: Recording,
    first: Fit,
    starts: Sequence[FloatArray],
    covariates: Callable[[Fit, Recording], tuple[Sequence[Covariate], FloatArray]],
    *,
    sd: float,
) -> LostReadings | None:
    """Find single readings so far from a fit to the others that even the widest outlying noise is improbable.

    The fit is one of least trimmed squares (Rousseeuw 1984), which a fifth of the readings cannot bend, however far out
    they are. A reading is lost if it also stands out from its neighbours in the run, so that neither a jump nor a bend
    explains it, or has the very value of one that is; and if such readings do not cluster in a covariate (`covariates`
    are as of an `Apparatus`). Nothing is fitted unless a residual of the fit `first`, to all readings, is improbable,
    or their rms is over twice a noise sd that is known without it. None if there are none.
    """
    law, usable = white_noise_of_recording(recording), np.flatnonzero(recording.usable)
    n_most, size = int(MOST_OUTLYING * len(usable)), np.abs(law(first.residuals))
    is_bent = float(np.sqrt(np.mean(size**2))) > _BENT * sd
    is_bent |= bool(size.max() > LARGEST_SIZE * np.median(size) / MAD_OF_NORMAL)
    if not is_bent and not improbable_rows(first, law).size:
        return None
    run, by_chance = recording.plan.scan[usable], -ndtri(0.5 * _BY_CHANCE / len(usable))
    in_runs = np.argsort(run, kind="stable")
    steps = np.abs(np.diff((first.residuals / law.sd)[in_runs])[np.diff(run[in_runs]) == 0])
    if not steps.size or steps.max() < by_chance * np.median(steps) / MAD_OF_NORMAL:
        return None  # bent or not, the residuals have no step that a reading far from its neighbours would make
    found = _least_trimmed_fit(model, recording, [first.z, *starts], law, n_most)
    if found is None:
        return None
    residual = found.residuals / law.sd
    aside = _farthest(residual, n_most, law)
    known = replace(law, lost=aside)
    apart = np.diff(residual)[(np.diff(run) == 0) & ~aside[1:] & ~aside[:-1]]
    spread = [np.median(np.abs(residual))] + ([np.median(np.abs(apart)) / math.sqrt(2)] if apart.size > 2 else [])
    is_kept = np.isin(np.arange(len(recording)), usable[~aside])
    kept = recording.with_readings(np.where(is_kept, recording.readings, np.nan))
    sd = max(float(min(spread)) / MAD_OF_NORMAL, sd_floor(kept))
    slopes, every = known(found.slopes) / sd, found.slopes / law.sd[:, None] / sd
    told = np.linalg.solve(with_prior(slopes.T @ slopes), every.T)
    unknown = np.sqrt(1 + np.einsum("ij,ji->i", every, told))
    size = np.abs(_beyond_neighbours(residual, run, aside)) / (sd * unknown)
    far = aside & (size > LARGEST_SIZE * by_chance)
    readings = recording.readings[usable]
    far |= aside & (size > by_chance) & np.isin(readings, readings[far])  # lost to one value, nearer to what was there
    if not far.any() or _cluster(far, readings, covariates(found, recording)[0]):
        return None
    squares = residual**2
    return LostReadings(usable[far], size[far], float(squares[far].sum() / squares.sum()))


def _least_trimmed_fit(
    model: Model, recording: Recording, starts: Sequence[FloatArray], law: NoiseLaw, n_most: int
) -> Fit | None:
    """Fit all readings but the `n_most` farthest, from fits that leave out none, or one of five blocks of rows."""
    n, best, least = len(law.sd), None, math.inf
    for block in [np.zeros(0, dtype=np.int64), *np.array_split(np.arange(n), 5)]:
        lost = np.isin(np.arange(n), block)
        tried = fit_each_start(model, recording, starts, replace(law, lost=lost), max_steps=_C_STEPS)
        found = min(tried, key=lambda one: one.objective)
        for _ in range(_C_STEPS):
            if not math.isfinite(found.objective):
                break
            again = _farthest(found.residuals / law.sd, n_most, law)
            if np.array_equal(again, lost):
                break
            lost = again
            found = fit(model, recording, found.z, replace(law, lost=lost), max_steps=_C_STEPS)
        if math.isfinite(found.objective):
            squares = float(np.sum((found.residuals / law.sd)[~lost] ** 2))
            best, least = (found, squares) if squares < least else (best, least)
    if best is None:
        return None
    return fit(model, recording, best.z, replace(law, lost=_farthest(best.residuals / law.sd, n_most, law)))


def _farthest(residual: FloatArray, n: int, law: NoiseLaw) -> BoolArray:
    size = np.where(law.is_censored, 0.0, np.abs(residual))
    return np.isin(np.arange(len(size)), np.argsort(-size, kind="stable")[:n])


def _beyond_neighbours(residual: FloatArray, run: IntArray, aside: BoolArray) -> FloatArray:
    """Return by how much each residual exceeds both nearest ones in its run that are not `aside`, or the only one."""
    order = np.argsort(run, kind="stable")
    r, last = residual[order], run[order]
    number = np.arange(len(r))
    above = np.maximum.accumulate(np.where(aside[order], -1, number))
    below = np.minimum.accumulate(np.where(aside[order], len(r), number)[::-1])[::-1]
    sides = []
    for at in (np.append(-1, above[:-1]), np.append(below[1:], len(r))):
        there = (at >= 0) & (at < len(r))
        near = np.clip(at, 0, len(r) - 1)
        sides.append(np.where(there & (last[near] == last), r - r[near], np.nan))
    one, other = (np.where(np.isnan(a), b, a) for a, b in (sides, sides[::-1]))
    out = np.where(np.sign(one) == np.sign(other), np.minimum(np.abs(one), np.abs(other)), 0.0)
    return np.asarray(np.nan_to_num(out[np.argsort(order, kind="stable")]))


def _cluster(far: BoolArray, readings: FloatArray, covariates: Sequence[Covariate]) -> bool:
    """Return whether far readings cluster in a covariate; equal ones in successive rows count once."""
    again = np.append(False, np.diff(readings) == 0)
    if np.mean(again[~far]) < _RARELY:
        far = far & ~(again & np.append(False, far[:-1]))
    scores = clustering_log_bayes_factors(far.astype(np.float64), covariates)
    return max(scores.values(), default=-math.inf) > 3.0  # nats


def note_on_improbable_rows(found: Fit, recording: Recording) -> tuple[str, ...]:
    """Say in one note which single rows carry the residuals of a fit, if readings so far out are no noise."""
    law, usable = white_noise_of_recording(recording), np.flatnonzero(recording.usable)
    at = improbable_rows(found, law, chance=1e-6)
    if not at.size:
        return ()
    squares = (found.residuals / law.sd) ** 2
    share = _percent(float(squares[at].sum() / squares.sum()))
    carry, bend = ("carries", "bends") if len(at) == 1 else ("carry", "bend")
    return (
        f"{rows_in_words(recording, usable[at])} {carry} {share} of the squared residuals and {bend} the fit; correct "
        "or empty cells that hold no reading; probewise diagnose tells outlying readings from effects",
    )


def rows_in_words(recording: Recording, rows: IntArray) -> str:
    """Write rows (counted from 0) as their table calls them, or a file whose header is row 1, with their readings."""
    name: Callable[[int], object] = getattr(recording.plan, "row_name", lambda row: row + 2)
    first = ", ".join(f"row {name(row)} ({recording.readings[row]:.6g})" for row in rows[:3].tolist())
    return first + (f" and {len(rows) - 3} more" if len(rows) > 3 else "")


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share < 0.995 else "nearly all"


_LEAST_IN_ALL = 8
# Of the median change from one reading to the next: on a coarser lattice readings are equal without a stop.
_FINE = 0.1


@dataclass(frozen=True, eq=False)
class MeterStop:
    """Saturation of a meter at `level`, after the noise: its readings there, of the mask `rows`, are exactly equal.

    They are left out of the fit, so that the noise model does not change. In the stored model, the stop is the form
    `saturation` of the reading.
    """

    level: float
    is_ceiling: bool
    rows: BoolArray
    reading: str
    unit: str

    def left_out_of(self, recording: Recording) -> Recording:
        """Return the recording without the readings at the stop, and with a note that says so."""
        level, left = f"{self.level:.6g} {self.unit}".rstrip(), np.where(self.rows, np.nan, recording.readings)
        note = f"{count_with_noun(int(self.rows.sum()), 'reading')} left out, at {level}, where the meter stops"
        return replace(recording, readings=left, notes=(*recording.notes, note))

    @property
    def effect(self) -> NoiseEffect:
        """The stop as an effect, whose level is certain to within rounding."""
        near = ROUNDING * (1 + abs(self.level))
        way, beyond = ("rises", np.maximum) if self.is_ceiling else ("falls", np.minimum)
        says = f"{self.reading} {way} no further than {self.level:.6g} {self.unit}".rstrip()
        prior = {"level": Uniform(self.level - near, self.level + near)}
        own = ("saturation", Stage.NOISE, prior, ("reading",), ("level",), lambda noise, theta, plan: noise)
        return NoiseEffect(
            *own,
            np.array([[[self.level]]]),
            lambda mean, sd: f"{says}, where the meter stops",
            amplitudes=(),
            known=np.array([self.level]),
            change_of_readings=lambda predicted: -beyond(predicted - self.level, 0.0),
        )


def find_meter_stop(recording: Recording, reading: str = "the reading") -> MeterStop | None:
    """Return the stop at the largest reading, or else at the smallest one; None if there is none.

    At least eight readings must equal that reading exactly, five of them in succession: noise makes readings differ,
    unless the meter saturates after the noise. None where rounding is too coarse to tell, or at an end that was
    declared.
    """
    usable = np.flatnonzero(recording.usable)
    readings, scan = recording.readings[usable], recording.plan.scan[usable]
    in_turn = (np.diff(usable) == 1) & (np.diff(scan) == 0)  # of successive rows of a run
    steps = np.abs(np.diff(readings))[in_turn]
    typical = float(np.median(steps)) if steps.size else 0.0
    if len(readings) <= _LEAST_IN_ALL or not typical > 0 or lattice_step(readings) > _FINE * typical:
        return None  # they are too few or too coarse for equal ones to tell of a stop
    for is_ceiling in (True, False):
        level = float(readings.max() if is_ceiling else readings.min())
        stands, there = readings == level, recording.readings == level
        if stands.sum() < _LEAST_IN_ALL or recording.censored[there].any():
            continue
        elsewhere = steps[~stands[1:][in_turn]]
        follows = np.append(False, stands[:-1] & stands[1:] & in_turn)
        streaks = np.diff(np.flatnonzero(np.append(~follows, True)))  # of rows at the stop, or one elsewhere
        if np.mean(elsewhere == 0) <= _RARELY and streaks.max() >= 5:
            return MeterStop(level, is_ceiling, there, reading, recording.plan.instrumentation.unit)
    return None
