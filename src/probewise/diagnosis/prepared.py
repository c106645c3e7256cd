"""Input of a diagnosis: readings, of long recordings a few thousand, possible effects, and the null."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.fit import Fit, Model, Null, fit_each_start
from probewise.diagnosis.joining import join
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.noise_law import white_noise_of_recording
from probewise.diagnosis.noise_models import rough_sd
from probewise.diagnosis.outlying import LostReadings, find_lost_readings
from probewise.diagnosis.sensors import (
    LEAST_READINGS,
    SensorPrior,
    SsfForms,
    require_same_unit,
    require_sensor_prior,
    sensor_from_samples,
)
from probewise.effects import Extent, NamedEffect, NoiseEffect
from probewise.effects.noise import LARGEST_SIZE
from probewise.errors import ParameterError
from probewise.recordings.plan import Recording, require_patterns_described
from probewise.sensor import Stage

MOST_READINGS = 2400
_FEWEST_SCANS = 8
_STRETCH = 6  # readings
_SEED = 0  # the same rows of the same recording, whatever the seed of its diagnosis


def rows_to_diagnose(recording: Recording, most: int = MOST_READINGS) -> IntArray:
    """Choose rows spread over the recording with about `most` usable readings; all rows if there are no more.

    Whole scans are chosen, to preserve correlations between readings; or, if these would be fewer than eight, stretches
    of six successive rows. Both are spread evenly but not regularly, so that what repeats itself is seen at all phases.

    Returns row numbers, ascending.
    """
    n_usable, n_points = int(recording.usable.sum()), len(recording)
    if n_usable <= most:
        return np.arange(n_points)
    share = most / n_usable
    scan = recording.plan.scan
    n_scans = len(recording.plan.scan_names)
    n_kept = math.floor(n_scans * share)
    if n_kept >= _FEWEST_SCANS:
        # One of each n_scans / n_kept, with the first and the last: scans that go there and back must not all go there.
        jitter = np.random.default_rng(_SEED).random(n_kept)
        kept = np.floor((np.arange(n_kept) + jitter) * n_scans / n_kept).astype(np.int64)
        kept[[0, -1]] = 0, n_scans - 1
        return np.flatnonzero(np.isin(scan, kept))
    return positions_in_stretches(scan, round(n_points * share))


def positions_in_stretches(run: IntArray, most: int) -> IntArray:
    """Choose about `most` of some rows in stretches of six neighbours of one run; all if there are no more.

    The gaps between stretches are a half to one and a half of their mean, the same for every table of this length: with
    equal gaps a table that repeats itself, as by the hour, may show the same hours in every stretch.

    `run`: number of each row's run, (n_rows,). Neighbours are successive rows of a run, also where runs are
    interleaved. Returns row numbers, ascending.
    """
    n_rows, n_stretches = len(run), round(most / _STRETCH)
    if n_rows <= most:
        return np.arange(n_rows)
    gaps = np.cumsum(0.5 + np.random.default_rng(_SEED).random(n_stretches + 1))
    slack = n_rows - n_stretches * _STRETCH
    first = _STRETCH * np.arange(n_stretches) + np.floor(slack * gaps[:-1] / gaps[-1]).astype(np.int64)
    by_run = np.argsort(run, kind="stable")
    own = run[by_run][first + _STRETCH // 2]  # a stretch over the end of a run is moved into it, if it is long enough
    begin, end = np.searchsorted(run[by_run], own, side="left"), np.searchsorted(run[by_run], own, side="right")
    first = np.where(end - begin >= _STRETCH, np.clip(first, begin, end - _STRETCH), first)
    return np.unique(by_run[first[:, None] + np.arange(_STRETCH)])


_WILD = 5.0  # spans of the middle 80 % of the readings from their median: no scale of a prior


@dataclass(frozen=True, eq=False)
class Prepared:
    """Input of a diagnosis.

    `recording`: the readings used; `effects`: effects that could act in them, by name; `null`: the null model; None:
    calibrated from the recording; `apparatus`: the apparatus that took the readings; `everything`: all readings; the
    same as `recording` if all are used.
    """

    recording: Recording
    effects: Mapping[str, NamedEffect[Any]]
    null: Null | None
    apparatus: Apparatus
    everything: Recording

    @property
    def is_thinned(self) -> bool:
        """Whether only some readings are used."""
        return self.everything is not self.recording

    @cached_property
    def usable_rows(self) -> IntArray:
        """Rows with a usable reading, (n_usable,)."""
        return np.flatnonzero(self.recording.usable)

    @cached_property
    def usable_rows_of_everything(self) -> IntArray:
        """Rows of `everything` with a reading that is used, (n_usable,)."""
        return rows_to_diagnose(self.everything)[self.usable_rows] if self.is_thinned else self.usable_rows

    @cached_property
    def noise_effect_names(self) -> frozenset[str]:
        """Names of the effects on the noise."""
        return frozenset(name for name, effect in self.effects.items() if effect.stage is Stage.NOISE)

    @cached_property
    def pure_noise_effect_names(self) -> frozenset[str]:
        """Names of the effects that change the noise alone."""
        return frozenset(n for n in self.noise_effect_names if not cast(NoiseEffect, self.effects[n]).changes_the_mean)

    @property
    def least_readings(self) -> int:
        """Fewest usable readings for a verdict."""
        return LEAST_READINGS if self.null is None else self.null.least_readings

    @property
    def has_only_equal_readings(self) -> bool:
        """Whether all usable readings are equal."""
        return float(np.ptp(self.recording.readings[self.usable_rows])) == 0.0

    @property
    def has_too_little_data(self) -> bool:
        """Whether the readings are too few for a verdict, or all equal; those at an end of the range do not count.

        Those left out as lost do: which they are, the others tell.
        """
        n_informative = len(self.usable_rows) - int(self.recording.censored[self.usable_rows].sum())
        n_informative += len(self.recording.left_out)
        return n_informative < self.least_readings or self.has_only_equal_readings

    def expand_usable_to_all_rows(self, values: FloatArray) -> FloatArray:
        """Expand values of usable readings to all rows, NaN elsewhere: (n_usable,) -> (n_points,)."""
        out = np.full(len(self.recording), np.nan)
        out[self.usable_rows] = values
        return out


def prepare(
    recordings: Recording | Sequence[Recording],
    *,
    sensor: SensorPrior | None = None,
    null: Null | None = None,
    apparatus: Apparatus,
) -> Prepared:
    """Join recordings, thin out long ones, and let the apparatus build the effects; errors as in `diagnose`."""
    if sensor is not None and null is not None:
        raise ParameterError("sensor, null", "both", "one of them: a null contains the prior of its sensor")
    if sensor is not None:
        require_sensor_prior(sensor)
    everything = join([recordings] if isinstance(recordings, Recording) else recordings)
    if null is None:
        require_patterns_described(everything.plan)
    if sensor is not None:
        require_same_unit(sensor, everything.plan)
        null = sensor_from_samples(sensor)
    rows = rows_to_diagnose(everything)
    recording = everything if len(rows) == len(everything) else everything.take(rows)
    lost = _lost_readings(recording, null, apparatus) if recording.usable.sum() >= LEAST_READINGS else None
    if lost is None:
        return Prepared(recording, apparatus.effects(recording, null), null, apparatus, everything)
    effect = lost.effect(recording)
    everything = replace(lost, rows=rows[lost.rows]).left_out_of(everything)
    recording = everything if len(rows) == len(everything) else everything.take(rows)
    effects = {**apparatus.effects(recording, null), effect.name: effect}
    return Prepared(recording, effects, null, apparatus, everything)


def _lost_readings(recording: Recording, null: Null | None, apparatus: Apparatus) -> LostReadings | None:
    """Find lost readings about the null, or about one Gaussian with a prior scaled to readings that are not far out.

    Nothing is fitted unless a reading differs from the two before or after it by more than widest outliers do.
    """
    rough, readings = rough_sd(recording), recording.readings
    usable = np.flatnonzero(recording.usable)
    if np.abs(np.diff(readings[usable], 2)).max() <= LARGEST_SIZE * rough:
        return None
    low, middle, high = np.quantile(readings[usable], [0.1, 0.5, 0.9])
    wild = np.flatnonzero(recording.usable & (np.abs(readings - middle) > _WILD * (high - low)))
    if null is None:
        kept = replace(recording, left_out=(*recording.left_out, *wild.tolist()))
        null, starts = SsfForms(Extent.of(kept)).one_gaussian_and_starts()
    else:
        starts = null.starts
    model = Model(null, (), recording.plan)
    law = replace(white_noise_of_recording(recording), lost=np.isin(usable, wild))
    first = min(fit_each_start(model, recording, list(starts), law), key=lambda found: found.objective)
    if not np.isfinite(first.objective):
        return None

    def covariates(found: Fit) -> Sequence[Covariate]:
        return apparatus.covariates_and_predicted_slope(found, recording)[0]

    return find_lost_readings(model, recording, first, [], covariates, sd=rough)
