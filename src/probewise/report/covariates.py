"""Covariates of a diagnosis: names, units and values; and the views in which residuals are drawn against them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise._words import UNITS, unit_after_number, unit_of_name
from probewise.diagnosis import ALARM, Diagnosis, Place
from probewise.effects import RARE_EFFECTS
from probewise.recordings import Plan
from probewise.report.residual_means import ResidualMeans, mean_residuals
from probewise.systems import RunTable

_WORDS = {
    "level": "predicted reading",
    "slope": "slope of the predicted reading along the motion",
    "place": "place along the scans",
    "direction": "direction of motion",
    "orientation": "orientation of the sensor",
    "edge_distance": "distance from the edge",
}
_DIRECTIONS = {-1.0: "backwards", 0.0: "at rest", 1.0: "forwards"}
_MOST_ORIENTATIONS = 24  # with a name each on the axis
_SEEN = 2.3  # sds beyond which a mean visibly leaves the band
_N_SAMPLES = 200  # posterior samples for the variance that the fit absorbs
_ASTRAY = 0.01  # largest deviation of a scan from its line, as a share of its length
_GAP = 0.1  # of the longest run, for a gap that is left out
_LEAST_PLACES = 3  # least number of places in a line


def covariate_in_words(name: str) -> str:
    """Return the name of a light sensor's covariate in words, without its unit: "battery" for battery_mv."""
    stem, _, suffix = name.rpartition("_")
    without_unit = stem if stem and suffix in UNITS else name
    return _WORDS.get(name, without_unit.replace("column:", "column ").replace("_", " "))


def term_family_in_words(family: str) -> str:
    """Write a family of bases in words: "time, scan by scan (locally)" for "time within scans, locally"."""
    name, _, how = family.partition(", ")
    stem = name.removesuffix(" within scans")
    written = covariate_in_words(stem) + (", scan by scan" if stem != name else "")
    return f"{written} ({how})" if how else written


def covariate_in_words_and_unit(diagnosis: Diagnosis, name: str) -> tuple[str, str]:
    """Return a covariate's name in words, and its unit, "" if none is known."""
    words = diagnosis.apparatus.words
    unit = unit_after_number(diagnosis.recording.plan.instrumentation.unit)
    written = covariate_in_words(name) if words.covariates is None else words.covariate_in_words(name)
    return written, words.units.get(name, unit_of_name(name)).replace("{reading}", unit)


def axis_label(diagnosis: Diagnosis, name: str, scan: str | None = None) -> str:
    """Return an axis label: the covariate in words, the scan (or run) if one is given, and the unit in brackets."""
    written, unit = covariate_in_words_and_unit(diagnosis, name)
    run = diagnosis.apparatus.words.run
    written += f", {run} {scan}" if scan is not None and name != run else ""
    return written + (f" ({unit_after_number(unit)})" if unit else "")


def covariate_values(diagnosis: Diagnosis, place: Place) -> FloatArray:
    """Return the values of a place's covariate, (n_points,), as diagnosed; NaN in unusable rows and where undefined."""
    values = np.full(len(diagnosis.recording), np.nan)
    if place.values is not None:
        values[np.flatnonzero(diagnosis.recording.usable)] = place.values
    return values


def category_name_by_value(diagnosis: Diagnosis, place: Place) -> dict[float, str] | None:
    """Return the names, by ascending value, of a place's covariate: scan, run, direction, or up to 24 orientations.

    None for other covariates; of a table's covariates, only the run has names.
    """
    words = diagnosis.apparatus.words
    if place.covariate == words.run:
        return {float(k): name for k, name in enumerate(diagnosis.recording.plan.scan_names)}
    if words.covariates is not None:
        return None  # a table's column may be called as a covariate of a light sensor is
    there = [] if place.values is None else _distinct_values(place.values)
    if place.covariate == "direction":
        return {sign: _DIRECTIONS[sign] for sign in there}
    if place.covariate == "orientation" and len(there) <= _MOST_ORIENTATIONS:
        return {angle: f"{angle:g}°" for angle in there}
    return None


def time_without_gaps(plan: Plan | RunTable, name: str) -> tuple[Callable[[FloatArray], FloatArray], str]:
    """Return how to draw times of a table: gaps longer than every run are left out; and words that say so, or "".

    Other covariates, by `name`, and times without such gaps are drawn as they are.
    """
    times = np.unique(plan.time_s[np.isfinite(plan.time_s)])
    longest = max(float(np.ptp(plan.time_s[rows])) for rows in plan.rows_by_scan())
    gaps = np.diff(times)
    if name != "time" or not isinstance(plan, RunTable) or not 0 < longest < gaps.max(initial=0.0):
        return np.asarray, ""
    drawn = np.cumsum(np.append(0.0, np.where(gaps > longest, _GAP * longest, gaps)))
    return lambda values: np.interp(values, times, drawn), ", gaps left out"


@dataclass(frozen=True, eq=False)
class CovariateView:
    """A covariate against which residuals are drawn.

    `at` holds its values, (n_points,), NaN in rows not drawn; of a categorical covariate positions 0, 1, 2 ... with
    `names`. `label` is the axis label; `window` the interval to shade; `place` the window with significant residuals
    that is drawn; None: another view.
    """

    at: FloatArray
    label: str
    names: Sequence[str] = ()
    window: tuple[float, float] | None = None
    place: Place | None = None


class ResidualNoise:
    """Noise of a diagnosis's residuals, for the band of chance about their means.

    `sd`, (n_points,), is the noise sd of each reading by the repaired model, `rho` its AR(1) correlation within scans.
    `absorbed`, (n_samples, n_points), holds posterior predictions of the calibrated model, whose variance narrows the
    band; None: it is not narrowed.
    """

    def __init__(self, diagnosis: Diagnosis) -> None:
        self.diagnosis, plan, null = diagnosis, diagnosis.recording.plan, diagnosis.null
        noise = {p.name: p.mean for p in diagnosis.noise.parameters}
        noise_sd = float(diagnosis.repaired.noise_sd.mean())
        sd = noise_sd * diagnosis.recording.relative_sd
        sd = sd * np.array([noise.get(f"values[{name}]", 1.0) for name in plan.scan_names])[plan.scan]
        if "ratio" in noise:
            level = diagnosis.after.readings
            sd = sd * np.sqrt(1 + noise["ratio"] * ((level - level.min()) / (float(np.ptp(level)) or 1.0)))
        self.sd = np.hypot(sd, noise.get("step", 0.0) / np.sqrt(12))  # the noise sd is that before rounding
        self.rho, self.absorbed = noise.get("rho", 0.0), None
        if "sd_per_row" not in noise:  # beside a walk the readings leave the mean open, not the residuals
            theta = null.theta[:: max(1, len(null.theta) // _N_SAMPLES)]
            # The null's spread is that of its own noise sd, which the misfit inflates.
            self.absorbed = min(1.0, float(noise_sd / null.noise_sd.mean())) * null.chain.predict(theta, plan)

    def means_in(self, view: CovariateView, *, after: bool = False) -> ResidualMeans:
        """Average the calibrated model's residuals in bins of a view; with `after`, also the repaired model's."""
        return mean_residuals(
            view.at,
            self.diagnosis.before.residuals,
            self.diagnosis.after.residuals if after and self.diagnosis.repair_changes_predictions else None,
            sd=self.sd,
            rho=self.rho,
            scan=self.diagnosis.recording.plan.scan,
            window=view.window,
            absorbed=self.absorbed,
        )

    @cached_property
    def first_view(self) -> CovariateView:
        """Choose the first figure's covariate: the first candidate with a mean of 2.3 sds or more, else the largest.

        Candidates in order: covariates with significant residuals (`ranked_places`), the repair's change of the
        predicted readings, the predicted reading.
        """
        diagnosis, before, after = self.diagnosis, self.diagnosis.before, self.diagnosis.after
        candidates: list[CovariateView] = []
        for place, _ in self.ranked_places:
            if diagnosis.verdict != "clean" or place.p_value < ALARM:
                candidates += views_of_place(diagnosis, place)
        if diagnosis.repair_changes_predictions and diagnosis.verdict != "clean":
            change = after.readings_with_walk - before.readings_with_walk
            unit = diagnosis.recording.plan.instrumentation.unit_after_number
            candidates.append(CovariateView(change, f"change that the repair makes ({unit})"))
        candidates.append(CovariateView(np.array(before.readings), axis_label(diagnosis, "level")))
        sizes = [self.means_in(view).largest_mean_in_sds for view in candidates]
        seen = [view for view, size in zip(candidates, sizes, strict=True) if size >= _SEEN]
        return seen[0] if seen else candidates[np.argmax(sizes)]

    @cached_property
    def ranked_places(self) -> list[tuple[Place, bool]]:
        """List the places with significant residuals, each with True if a mean residual reaches 2.3 sds.

        First those on whose covariate the unknown effect most probably depends, then those with True. Of places that
        are the same interval, one is kept.
        """
        found, shown = self.diagnosis, list[tuple[Place, bool]]()
        seen = [
            any(self.means_in(v).largest_mean_in_sds >= _SEEN for v in views_of_place(found, p)) for p in found.where
        ]
        ranked = sorted(
            zip(found.where, seen, strict=True), key=lambda k: (-_probability_unknown_depends_on(found, k[0]), not k[1])
        )
        for place, is_seen in ranked:  # with one scan, a place in all scans and one in that scan are the same
            values = covariate_values(found, place)
            if place.start is None or not any(
                (place.covariate, place.start, place.end) == (other.covariate, other.start, other.end)
                and np.array_equal(values, covariate_values(found, other), equal_nan=True)
                for other, _ in shown
            ):
                shown.append((place, is_seen))
        return shown


@lru_cache(maxsize=1)
def noise_of(diagnosis: Diagnosis) -> ResidualNoise:
    """Return the noise of a diagnosis's residuals, the same for its figures and its page."""
    return ResidualNoise(diagnosis)


def views_of_place(diagnosis: Diagnosis, place: Place) -> list[CovariateView]:
    """List a place's views: along its scan or run, if it is a whole one; then, for every place, along its covariate."""
    at, names = covariate_values(diagnosis, place), category_name_by_value(diagnosis, place)
    label = axis_label(diagnosis, place.covariate, place.scan)
    if place.without_effect:
        unit = unit_after_number(diagnosis.recording.plan.instrumentation.unit)
        label = f"predicted reading without the effect ({unit})"
    window = None if place.start is None or place.end is None else (place.start, place.end)
    draw, said = time_without_gaps(diagnosis.recording.plan, place.covariate)
    at, label = draw(at), label + said
    window = None if window is None else (float(draw(np.array(window))[0]), float(draw(np.array(window))[1]))
    values = _distinct_values(at)
    if names:
        held = [k for k, v in enumerate(values) if (window[0] <= v <= window[1] if window else names[v] == place.scan)]
        window = (held[0] - 0.5, held[-1] + 0.5) if held else None
        at = np.where(np.isfinite(at), np.searchsorted(values, at), np.nan)
    shown = [names[v] for v in values] if names else []
    by_covariate = CovariateView(at, label, shown, window, place)
    if place.scan is None or place.covariate != diagnosis.apparatus.words.run:
        return [by_covariate]
    return [view_along_scan(diagnosis, place.scan, place), by_covariate]


def view_along_scan(diagnosis: Diagnosis, scan: str, place: Place | None = None) -> CovariateView:
    """Build the view of one scan along X or Y, whichever it spans more; along time if the scan is no line.

    A run of a simulator's table is shown along its time or rows.
    """
    plan = diagnosis.recording.plan
    rows = np.flatnonzero(np.isin(plan.scan, [k for k, name in enumerate(plan.scan_names) if name == scan]))
    if isinstance(plan, RunTable):
        along = plan.time_s[rows]
        whole = scan if plan.run is not None else None
        label = axis_label(diagnosis, "time" if plan.has_varying_time else "row", whole)
    else:
        x_mm, y_mm = plan.x_mm[rows], plan.y_mm[rows]
        along, label = (x_mm, "X (mm)") if np.ptp(x_mm) >= np.ptp(y_mm) else (y_mm, "Y (mm)")
        if not is_scan_along_line(plan, rows):
            along, label = plan.time_s[rows], "time (s)"
        label = f"{label}, scan {scan}"
    at = np.full(len(plan), np.nan)
    at[rows] = along
    return CovariateView(at, label, place=place)


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
    """Return the probability that the unknown effect, if that is the verdict, depends on a place's covariate."""
    shares = diagnosis.unknown_shares
    if diagnosis.verdict != "unknown" or max(shares, key=lambda k: shares[k], default="") in RARE_EFFECTS:
        return 0.0
    within = " within scans" if place.scan is not None and place.covariate != diagnosis.apparatus.words.run else ""
    return sum(p for family, p in shares.items() if family.partition(",")[0] == place.covariate + within)


def _distinct_values(at: FloatArray) -> list[float]:
    values: list[float] = np.unique(at[np.isfinite(at)]).tolist()
    return values
