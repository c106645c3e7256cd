"""Input of a diagnosis: readings, possible effects, and the null."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.fitting.coordinates import LEAST_READINGS
from probewise.diagnosis.fitting.fit import Fit, Model, fit_each_start
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.fitting.sensor_prior import (
    SensorPrior,
    require_same_unit,
    require_sensor_prior,
    sensor_from_samples,
)
from probewise.diagnosis.joining import join
from probewise.diagnosis.noise.law import white_noise_of_recording
from probewise.diagnosis.noise.models import rough_sd
from probewise.diagnosis.residuals.covariate import Covariate
from probewise.diagnosis.residuals.outlying import LostReadings, find_lost_readings
from probewise.diagnosis.thinning import rows_to_diagnose
from probewise.effects import NamedEffect, NoiseEffect
from probewise.effects.noise import LARGEST_SIZE
from probewise.errors import ParameterError
from probewise.recordings.plan import Recording, require_patterns_described
from probewise.sensor import Stage

_WILD = 5.0  # spans of the middle 80 % of the readings from their median: no scale of a prior


@dataclass(frozen=True, eq=False)
class Prepared:
    """Input of a diagnosis.

    Parameters
    ----------
    recording
        The readings used.
    effects
        Effects that could act in them, by name.
    null
        The null model; None: calibrated from the recording.
    apparatus
        The apparatus that took the readings.
    everything
        All readings; the same as `recording` if all are used.
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
        null, starts = apparatus.null_forms(kept).one_gaussian_and_starts()
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
