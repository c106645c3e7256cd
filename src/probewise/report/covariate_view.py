"""Covariates against which residuals are drawn: those with significant residuals, and that of the first figure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise._words import unit_after_number
from probewise.diagnosis import ALARM, Diagnosis, Place
from probewise.effects import RARE_EFFECTS, name_without_copy_suffix
from probewise.recordings import Plan
from probewise.report.covariate import (
    axis_label,
    category_name_by_value,
    covariate_in_words_and_unit,
    covariate_values_by_place,
)
from probewise.report.residual_means import ResidualMeans, mean_residuals
from probewise.systems import RunTable

_SEEN = 2.3  # sds beyond which a mean visibly leaves the band
_N_SAMPLES = 200  # posterior samples for the variance that the fit absorbs
_ASTRAY = 0.01  # largest deviation of a scan from its line, as a share of its length
_LEAST_PLACES = 3  # least number of places in a line
_LEAST_PERIODS = 3.0  # least number of periods in a recording for folding it


@dataclass(frozen=True, eq=False)
class CovariateView:
    """A covariate against which residuals are drawn.

    `at` holds its values, (n_points,), NaN in rows not drawn; `label` is the axis label. `names` gives each value's
    name if the covariate is categorical. `window` is the interval to shade, in the covariate's unit or, if categorical,
    in positions on the axis. `place` is the window with significant residuals that is drawn; None: another view.
    """

    at: FloatArray
    label: str
    names: Mapping[float, str] | None = None
    window: tuple[float, float] | None = None
    place: Place | None = None

    @property
    def category_names_on_axis(self) -> list[str] | None:
        """Names of a categorical covariate's distinct values, in ascending order of value; None for others."""
        return None if self.names is None else [self.names[v] for v in _distinct_values(self.at)]


@dataclass(frozen=True, eq=False)
class ResidualNoise:
    """Noise of residuals, for the band of chance about their means.

    `sd`, (n_points,), is the noise sd of each reading, `rho` the AR(1) correlation within scans. `absorbed`,
    (n_samples, n_points), holds posterior predictions, whose variance narrows the band; None: it is not narrowed.
    """

    sd: FloatArray
    rho: float
    absorbed: FloatArray | None

    @classmethod
    def of_diagnosis(cls, diagnosis: Diagnosis) -> ResidualNoise:
        """Take the repaired model's noise sds and correlation, and posterior predictions of the calibrated model."""
        found = {p.name: p.mean for p in diagnosis.report.noise.parameters}
        plan = diagnosis.recording.plan
        sd = float(diagnosis.repaired.noise_sd.mean()) * diagnosis.recording.relative_sd
        sd = sd * np.array([found.get(f"values[{name}]", 1.0) for name in plan.scan_names])[plan.scan]
        if "ratio" in found:
            level = diagnosis.repair.after.readings
            share = (level - level.min()) / (float(np.ptp(level)) or 1.0)
            sd = sd * np.sqrt(1 + found["ratio"] * share)
        sd = np.hypot(sd, found.get("step", 0.0) / np.sqrt(12))  # the noise sd is that before rounding
        if "sd_per_row" in found:  # beside a walk the readings leave the mean open, not the residuals
            return cls(sd, found.get("rho", 0.0), None)
        null = diagnosis.null
        theta = null.theta[:: max(1, len(null.theta) // _N_SAMPLES)]
        return cls(sd, found.get("rho", 0.0), null.chain.predict(theta, plan))

    def mean_residuals(self, diagnosis: Diagnosis, view: CovariateView, *, after: bool) -> ResidualMeans:
        """Average the calibrated model's residuals in bins of a view; with `after`, also the repaired model's."""
        return mean_residuals(
            view.at,
            diagnosis.repair.before.residuals,
            diagnosis.repair.after.residuals if after and diagnosis.repair.changes_predictions else None,
            sd=self.sd,
            rho=self.rho,
            scan=diagnosis.recording.plan.scan,
            names=view.names,
            window=None if view.names else view.window,
            absorbed=self.absorbed,
        )


def choose_first_figure_view(diagnosis: Diagnosis, chance: ResidualNoise) -> CovariateView:
    """Choose the covariate of the first figure: the first candidate with a mean residual of 2.3 sds or more.

    If there is none, the candidate with the largest mean in sds; without candidates, the predicted reading.

    Candidates in order: time, X or a column, folded at a named effect's period; covariates with significant residuals,
    those on which an unknown effect most probably depends first; last, the repair's change of the predicted readings.
    """
    values = covariate_values_by_place(diagnosis)
    alarming = [place for place in diagnosis.where if diagnosis.verdict != "clean" or place.p_value < ALARM]
    places = sorted(alarming, key=lambda place: -_probability_unknown_depends_on(diagnosis, place))
    found = _views_at_period(diagnosis)
    for place in places:
        found += _views_of_place(diagnosis, place, values[place.figure_name])
    if diagnosis.repair.changes_predictions and diagnosis.verdict != "clean":
        found.append(_view_against_repair_change(diagnosis))
    if not found:
        return CovariateView(np.array(diagnosis.repair.before.readings), axis_label(diagnosis, "level"))
    sizes = [chance.mean_residuals(diagnosis, view, after=False).largest_mean_in_sds for view in found]
    return next((w for w, size in zip(found, sizes, strict=True) if size >= _SEEN), found[int(np.argmax(sizes))])


def ranked_places_with_visibility(diagnosis: Diagnosis, chance: ResidualNoise) -> list[tuple[Place, bool]]:
    """List the places with significant residuals, each with True if a mean residual reaches 2.3 sds.

    First those whose covariate the unknown effect most probably depends on; then those with True; then the others. Of
    places that are the same interval, one is kept.
    """
    values, seen = covariate_values_by_place(diagnosis), {}
    for place in diagnosis.where:
        views = _views_of_place(diagnosis, place, values[place.figure_name])
        seen[place.figure_name] = any(
            chance.mean_residuals(diagnosis, w, after=False).largest_mean_in_sds >= _SEEN for w in views
        )
    ordered = sorted(
        diagnosis.where, key=lambda p: (-_probability_unknown_depends_on(diagnosis, p), not seen[p.figure_name])
    )
    shown: list[Place] = []
    for place in ordered:  # with one scan, a place in all scans and one in that scan are the same
        if not any(_is_same_interval(values, place, other) for other in shown):
            shown.append(place)
    return [(place, seen[place.figure_name]) for place in shown]


def _is_same_interval(values: Mapping[str, FloatArray], place: Place, other: Place) -> bool:
    ends = (place.covariate, place.start, place.end) == (other.covariate, other.start, other.end)
    own, others = values[place.figure_name], values[other.figure_name]
    return ends and place.start is not None and np.array_equal(own, others, equal_nan=True)


def _views_of_place(diagnosis: Diagnosis, place: Place, at: FloatArray) -> list[CovariateView]:
    """List a place's views: `view_along_scan` if it is a whole scan or run; then, for every place, along its covariate.

    `at`, (n_points,), holds the covariate's values.
    """
    by_covariate = view_along_place_covariate(diagnosis, place, at)
    if place.scan is None or place.covariate != diagnosis.apparatus.words.run:
        return [by_covariate]
    return [view_along_scan(diagnosis, place.scan, place), by_covariate]


def view_along_place_covariate(diagnosis: Diagnosis, place: Place, at: FloatArray) -> CovariateView:
    """Build the view of a place along its covariate, whose values are `at`, (n_points,)."""
    unit = diagnosis.recording.plan.instrumentation.unit
    label = axis_label(diagnosis, place.covariate, place.scan)
    if place.without_effect:
        label = f"reading to be expected without it ({unit_after_number(unit)})"
    names = category_name_by_value(diagnosis, place)
    return CovariateView(at, label, names, _shaded_interval(place, at, names), place)


def view_along_scan(diagnosis: Diagnosis, scan: str, place: Place | None = None) -> CovariateView:
    """Build the view of one scan along X or Y, whichever it spans more; along time if the scan is no line.

    A run of a simulator's table is shown along its time or rows. Residuals that change sign within the scan show here.
    """
    plan = diagnosis.recording.plan
    rows = np.flatnonzero(np.isin(plan.scan, [k for k, name in enumerate(plan.scan_names) if name == scan]))
    if isinstance(plan, RunTable):
        at = np.full(len(plan), np.nan)
        at[rows] = plan.time_s[rows]
        whole = scan if plan.run is not None else None
        return CovariateView(at, axis_label(diagnosis, "time" if plan.has_varying_time else "row", whole), place=place)
    x_mm, y_mm = plan.x_mm[rows], plan.y_mm[rows]
    along, label = (x_mm, "X (mm)") if np.ptp(x_mm) >= np.ptp(y_mm) else (y_mm, "Y (mm)")
    if not is_scan_along_line(plan, rows):
        along, label = plan.time_s[rows], "time (s)"
    at = np.full(len(plan), np.nan)
    at[rows] = along
    return CovariateView(at, f"{label}, scan {scan}", place=place)


def is_scan_along_line(plan: Plan | RunTable, rows: IntArray) -> bool:
    """Return whether the rows of one scan lie on a line, at three or more places; True for the rows of a table."""
    if isinstance(plan, RunTable):
        return True
    places = np.stack([plan.x_mm[rows], plan.y_mm[rows]])
    if np.unique(places.round(6), axis=1).shape[1] < _LEAST_PLACES:
        return False
    widest, across = np.linalg.svd(places - places.mean(axis=1, keepdims=True), compute_uv=False)
    return bool(across <= _ASTRAY * widest)


def _probability_unknown_depends_on(diagnosis: Diagnosis, place: Place) -> float:
    """Return the probability that the unknown effect depends on a place's covariate.

    It is 0 unless the verdict is `unknown` and the most probable form of the effect is a family of bases.
    """
    shares = diagnosis.judged.unknown_shares
    if diagnosis.verdict != "unknown" or max(shares, key=lambda k: shares[k], default="") in RARE_EFFECTS:
        return 0.0
    within = " within scans" if place.scan is not None and place.covariate != diagnosis.apparatus.words.run else ""
    return sum(p for family, p in shares.items() if family.partition(",")[0] == place.covariate + within)


def _views_at_period(diagnosis: Diagnosis) -> list[CovariateView]:
    """List views of time, X or a column, folded at the period of each periodic effect of the verdict.

    Only where the recording spans more than three periods.
    """
    plan, out = diagnosis.recording.plan, []
    for effect in diagnosis.effects:
        found = {p.name: p.mean for p in effect.parameters}
        if effect.name not in diagnosis.combination:
            continue
        if isinstance(plan, RunTable):
            out += _covariates_and_periods_to_fold(diagnosis, plan, effect.name, found)
            continue
        if found.get("alias_hz", 0.0) > 0:
            out.append((plan.time_s, 1 / found["alias_hz"], "time", "s"))
        if found.get("period_mm", 0.0) > 0:
            out.append((plan.x_mm, found["period_mm"], "X", "mm"))
    return [
        CovariateView(
            np.mod(values, period), f"{name} within one period of {period:.4g} {unit}" + (f" ({unit})" if unit else "")
        )
        for values, period, name, unit in out
        if np.ptp(values) > _LEAST_PERIODS * period
    ]


def _covariates_and_periods_to_fold(
    diagnosis: Diagnosis, table: RunTable, effect: str, found: Mapping[str, float]
) -> list[tuple[FloatArray, float, str, str]]:
    """List the covariate to fold for an effect on a simulator: values (n_points,), period, name, unit; empty if none.

    A wave in time folds the time, a column's periodic error that column. `found`: the effect's parameters by name.
    """
    if found.get("hz", 0.0) > 0:
        return [(table.time_s, 1 / found["hz"], *covariate_in_words_and_unit(diagnosis, "time"))]
    column = name_without_copy_suffix(effect).partition(":")[2]
    return [(table.covariates[column], found["period"], column, "")] if found.get("period", 0.0) > 0 else []


def _view_against_repair_change(diagnosis: Diagnosis) -> CovariateView:
    unit = diagnosis.recording.plan.instrumentation.unit_after_number
    return CovariateView(
        diagnosis.repair.after.readings_with_walk - diagnosis.repair.before.readings_with_walk,
        f"change that the repair makes ({unit})",
    )


def _shaded_interval(place: Place, at: FloatArray, names: Mapping[float, str] | None) -> tuple[float, float] | None:
    """Return the interval of the axis to shade for a place: from its start to its end; None if it has none.

    For a categorical covariate (`names`): half a position beyond the first and last category that the place holds.
    """
    ends = None if place.start is None or place.end is None else (place.start, place.end)
    if not names:
        return ends
    shown = _distinct_values(at)
    members = [k for k, v in enumerate(shown) if (ends[0] <= v <= ends[1] if ends else names[v] == place.scan)]
    return (members[0] - 0.5, members[-1] + 0.5) if members else None


def _distinct_values(at: FloatArray) -> list[float]:
    values: list[float] = np.unique(at[np.isfinite(at)]).tolist()
    return values
