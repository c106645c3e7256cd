"""The p-value of a fit, and the windows of each covariate in which its residuals are significant.

The null distribution of every statistic comes from one pivotal bootstrap, r* = P eps: residuals of a linearised fit to
pure noise (P projects onto what the fit leaves), without refits. It accounts for multiple comparisons, because each
draw is compared in the same ways.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import TINY, BoolArray, FloatArray, IntArray, read_only_floats
from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.templates import TemplateBank
from probewise.effects import Effect
from probewise.recordings.plan import Plan
from probewise.systems.table import published_covariate


@dataclass(frozen=True, eq=False)
class Covariate:
    """One covariate (time, place, level, ...) of the usable readings."""

    name: str
    values: FloatArray  # where it is defined, in its unit, (n_rows,)
    rows: IntArray  # indices of these readings, (n_rows,)
    groups: bool = False  # categorical: an orientation, a scan
    scan: str | None = None  # the one to which it is restricted

    @property
    def published_name(self) -> str:
        """Its name in results: without the prefix "column:" where no covariate of a table has that name."""
        return published_covariate(self.name)


ALARM = 0.01
"""p-value of the global test, at or below which the model counts as incomplete."""

LARGEST_P = 0.05
"""p-value above which nothing is significant, neither a place nor, whatever the form of the SSF, the whole."""

_LEAST_ROWS = 3
_ABSORBED = 1e-8  # of a window's length: below it, what the fit leaves is rounding
_SIGNIFICANT = 0.05  # of the maximum of an effect: below it, it is negligible
_PLAIN = 0.25  # p-value of the first draws above which more draws are not needed


def figure_name_of(name: str) -> str:
    """Return the file name of a figure, of letters, digits, - and _ alone; names that differ get files that differ."""
    clean = "".join(c if c.isalnum() or c in "-_" else "_" for c in name)
    if len(clean) > 60 or clean != name.replace(":", "_").replace(" ", "_"):
        clean = f"{clean[:60]}_{zlib.crc32(name.encode()):08x}"
    return f"{clean}.svg"


@dataclass(frozen=True, eq=False)
class Place:
    """A window of a covariate in which residuals, or an effect, are significant, with the curve of mean residuals.

    `start`, `end` in the covariate's unit; None for a whole `scan`. `z`: the statistic of the window in noise sds; for
    an effect, its lambda. The curve is the mean residual in bins of the covariate.
    `values` (n_usable,): the covariate at each usable reading, NaN if undefined. `without_effect`: whether the values
    are readings predicted without the effect.
    """

    covariate: str
    scan: str | None
    start: float | None
    end: float | None
    p_value: float
    z: float
    curve_at: FloatArray
    curve_mean: FloatArray
    values: FloatArray | None = None
    without_effect: bool = False

    def __post_init__(self) -> None:
        if self.values is not None:
            object.__setattr__(self, "values", read_only_floats(self.values))
        for name in ("curve_at", "curve_mean"):
            object.__setattr__(self, name, read_only_floats(getattr(self, name)))

    @property
    def figure_name(self) -> str:
        """Name of the place's figure file: "witness_COVARIATE.svg" or "witness_COVARIATE_SCAN.svg"."""
        where = self.covariate if self.scan is None else f"{self.covariate}_{self.scan}"
        return figure_name_of(f"witness_{where}")

    def rows_among(self, plan: Plan, usable: IntArray) -> BoolArray:
        """Return the mask of the usable readings, of a plan's rows `usable` (n_usable,), that lie in it."""
        out = np.ones(len(usable), dtype=np.bool_)
        if self.scan is not None:
            out &= np.array(plan.scan_names)[plan.scan[usable]] == self.scan
        return out & self._within

    @property
    def _within(self) -> BoolArray:
        values = np.zeros(0) if self.values is None else self.values
        if self.start is None or self.end is None:
            return np.isfinite(values)
        return np.asarray((values >= self.start) & (values <= self.end))

    def overlap(self, other: Place) -> float:
        """Return the readings in both windows, as a share of those in either."""
        either = int(np.sum(self._within | other._within))
        return float(np.sum(self._within & other._within)) / either if either else 0.0


def bayes_factor_p_value(problem: Linearised, banks: Sequence[TemplateBank], draws: FloatArray) -> float:
    """Test for a missing effect on the mean, by the weighted mean of the Bayes factors of all templates.

    `banks`: all templates compared, with labels; each label has equal weight, divided among its templates; `draws`:
    residuals under the null, (n_rows, n_draws). Only the first fifth is used if that gives a p-value above 0.25.
    Returns the p-value: the share of draws with as large a mean; for a mean b beyond their resolution, the bound 1/b.
    """
    families = [(number, label) for number, bank in enumerate(banks) for label in bank.labels]
    names = list(dict.fromkeys(families))
    codes = np.array([names.index(family) for family in families])
    log_weight = -np.log(np.bincount(codes)[codes]) - math.log(len(names))

    def log_mean_bayes_factor(residuals: FloatArray) -> FloatArray:
        scores = np.concatenate([bank.log_bayes_factors(problem, residuals) for bank in banks])
        return np.asarray(logsumexp(scores + log_weight[:, None], axis=0))

    seen = float(log_mean_bayes_factor(problem.residual[:, None])[0])
    n_draws = draws.shape[1]
    if seen > math.log(10 * n_draws):
        return math.exp(-seen)
    above = np.zeros(0)
    for first, last in ((0, n_draws // 5), (n_draws // 5, n_draws)):
        above = np.append(above, log_mean_bayes_factor(draws[:, first:last]) >= seen)
        if above.mean() > _PLAIN:
            break
    return float((1 + above.sum()) / (1 + len(above)))


def window_columns(covariate: Covariate, n_points: int) -> tuple[FloatArray, list[IntArray]]:
    """Build windows over the sorted values of a covariate: of half the readings, a quarter and so on, half overlapping.

    Equal values stay together: a window that split them would select by something else. Of a categorical covariate, one
    window per value. Returns indicator columns, (n_points, n_windows), and the indices of the values in each window.
    """
    values, n = covariate.values, len(covariate.values)
    windows = dict[tuple[int, int], IntArray]()
    if covariate.groups:
        windows = {(k, k): np.flatnonzero(values == value) for k, value in enumerate(np.unique(values))}
    order = np.argsort(values, kind="stable")
    edges = np.concatenate([[0], np.flatnonzero(np.diff(values[order])) + 1, [n]])
    width = 0 if covariate.groups else n // 2
    while width >= _LEAST_ROWS and len(windows) <= 160:
        for first in sorted({*range(0, n - width + 1, max(width // 2, 1)), n - width}):
            low, high = (int(edges[np.searchsorted(edges, end)]) for end in (first, first + width))
            if _LEAST_ROWS <= high - low < n:
                windows.setdefault((low, high), order[low:high])
        width //= 2
    columns = np.zeros((n_points, len(windows)))
    for k, members in enumerate(windows.values()):
        columns[covariate.rows[members], k] = 1.0
    return columns, list(windows.values())


def significant_places(
    problem: Linearised,
    covariates: Sequence[Covariate],
    scan_names: Sequence[str],
    residuals: FloatArray,
    draws: FloatArray,
) -> list[Place]:
    """Return, for each covariate, its most significant window if that has p up to 0.05; most significant first.

    `residuals`: reading minus prediction, (n_points,), for the mean curves; `draws`: residuals under the null, (n_rows,
    n_draws).
    """
    out: list[Place] = []
    norms = np.sqrt(np.maximum(np.sum(draws**2, axis=0), TINY) / problem.law.n_kept)
    own_norm = math.sqrt(float(problem.residual @ problem.residual) / problem.law.n_kept) or 1.0
    for covariate in covariates:
        columns, windows = window_columns(covariate, problem.n_points)
        if not windows:
            continue
        whitened = problem.whiten(columns)
        projected = problem.project_whitened(whitened)
        lengths = np.linalg.norm(projected, axis=0)
        there = np.flatnonzero(lengths > _ABSORBED * np.linalg.norm(whitened, axis=0))
        if not there.size:
            continue
        units = projected[:, there] / lengths[there]
        scores = np.abs(units.T @ problem.residual) / own_norm
        null = np.max(np.abs(units.T @ draws) / norms, axis=0)
        best = int(np.argmax(scores))
        p_value = (1 + int(np.sum(null >= scores[best]))) / (1 + draws.shape[1])
        if p_value > LARGEST_P:
            continue
        inside = covariate.values[windows[there[best]]]
        window: tuple[str | None, float | None, float | None] = (
            (scan_names[int(inside[0])], None, None)
            if covariate.name in ("scan", "run")  # by number
            else (covariate.scan, float(inside.min()), float(inside.max()))
        )
        curve = _mean_curve_fields(covariate, residuals)
        out.append(Place(covariate.published_name, *window, p_value, float(scores[best]), **curve))
    return sorted(out, key=lambda place: (place.p_value, -place.z))


def places_of_effect(
    effect: Effect,
    change: FloatArray,
    covariate: Covariate,
    scans: Covariate | None,
    plan: Plan,
    residuals: FloatArray,
    *,
    p_value: float,
    size: float,
) -> list[Place]:
    """Locate a named effect: the interval of a covariate in which it is at least half its maximum.

    In `level` a twentieth suffices; in `direction` its deviation from its mean counts; in `run`, it is the run of the
    largest change. The list holds one place, or, for an effect bound to scans, one per scan in which it is a twentieth
    of its maximum or more.

    `change`: its change of the readings, (n_points,); `scans`: the covariate `scan`, if there are several; `residuals`:
    residuals of the null, (n_points,), for the mean curve.
    """
    name, curve = covariate.name, _mean_curve_fields(covariate, residuals)
    if name == "run":
        strongest = plan.scan_names[int(plan.scan[np.argmax(np.abs(change))])]
        return [Place(name, strongest, None, None, p_value, size, **curve)]
    if scans is not None and (name == "scan" or (effect.scans and "scan" in effect.covariates)):
        curve = _mean_curve_fields(scans, residuals)
        # A scan without usable readings is not in the plan, and a name may return.
        rows = {scan: np.array([own == scan for own in plan.scan_names])[plan.scan] for scan in effect.scans}
        largest = {scan: float(np.abs(change[own]).max(initial=0.0)) for scan, own in rows.items()}
        there = [scan for scan in effect.scans if largest[scan] >= _SIGNIFICANT * max(largest.values())]
        strongest_first = sorted(there, key=lambda scan: -largest[scan])
        return [Place("scan", scan, None, None, p_value, size, **curve) for scan in strongest_first]
    own = change[covariate.rows]
    # The levels absorb what all readings share: where nearly all move one way, those at rest stand out.
    strength = np.abs(own - own.mean() if name == "direction" else own)
    # An effect with a threshold in level begins where it is first significant.
    values = covariate.values[strength >= (_SIGNIFICANT if name == "level" else 0.5) * strength.max()]
    ends = float(values.min()), float(values.max())
    return [Place(covariate.published_name, None, *ends, p_value, size, **curve, without_effect=name == "level")]


def _mean_curve_fields(covariate: Covariate, residuals: FloatArray) -> dict[str, Any]:
    """Return fields of a `Place`: the covariate at each reading, and the curve of mean residuals in bins of it."""
    values, mine = covariate.values, residuals[covariate.rows]
    if covariate.groups:
        parts = [np.flatnonzero(values == value) for value in np.unique(values)]
    else:
        parts = np.array_split(np.argsort(values, kind="stable"), min(30, max(len(values) // 4, 1)))
    by_row = np.full(len(residuals), np.nan)
    by_row[covariate.rows] = values
    return {
        "values": by_row,
        "curve_at": np.array([values[p].mean() for p in parts]),
        "curve_mean": np.array([mine[p].mean() for p in parts]),
    }
