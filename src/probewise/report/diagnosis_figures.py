"""The figures of a diagnosis: SVG by file name, each witness under the name that the JSON gives it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis import Diagnosis, Place
from probewise.report.covariate import category_names, covariate_label, covariate_values
from probewise.report.drawing import Band, Bars, Boxes, Dots, Line, Mark, Panel, Rule, Span, drawing
from probewise.report.palette import BLUE, GREY, VERMILLION
from probewise.report.words import number, signed, unit_name

__all__ = ["figures", "gain_by_scan", "hypothesis_label", "mean_residuals"]

_WORTH_A_BAR = 0.005
_MOST_BARS = 6
_MOST_SCANS = 12
_STEPS = 24
_LEAST_ROWS = 4
_LINE = 14.0  # px, of a name's
_ASIDE = 0.15  # of the place of a value without a scale: how far two means stand from its middle
_BEFORE, _AFTER = "as calibrated", "repaired"


def figures(diagnosis: Diagnosis) -> dict[str, bytes]:
    """Draw all figures: the first screen's, before and after, the held-out gain, a witness of each place."""
    values = covariate_values(diagnosis)
    drawn = {
        "first.svg": _first(diagnosis, values),
        "before_after.svg": _before_and_after(diagnosis),
        "residuals.svg": _residuals(diagnosis),
    }
    gain = diagnosis.improvement
    if gain.heldout_by_scan:
        panel = gain_by_scan(gain.heldout_by_scan, gain.heldout_log_density_per_reading, gain.heldout_sd)
        drawn["gain.svg"] = drawing([[panel]])
    for place in diagnosis.where:
        drawn[place.witness] = _witness(diagnosis, place, values[place.witness])
    return drawn


def hypothesis_label(effects: Sequence[str]) -> str:
    """Name a hypothesis, an effect a line."""
    if not effects:
        return "nothing is missing"
    return "something unknown" if effects == ("unknown",) else " +\n".join(effects).replace("_", " ")


def mean_residuals(
    covariate: FloatArray,
    before: FloatArray,
    after: FloatArray | None,
    *,
    sd: float,
    rho: float = 0.0,
    scan: IntArray | None = None,
    names: Mapping[float, str] | None = None,
) -> tuple[Mark, ...]:
    """Average what the model misses in steps of a covariate, as calibrated and repaired.

    Parameters
    ----------
    covariate, before, after
        Shape (n_points,): the covariate, and recorded minus predicted reading by both models; NaN where there
        is none. Without `after` nothing was repaired.
    sd
        Noise of one reading, for the band that chance alone would fill.
    rho, scan
        Its correlation with the reading before it in the same scan, and the scan of each reading, (n_points,).
    names
        Names of the values of a covariate without a scale; the marks then stand at 0, 1, 2 ...

    Returns
    -------
    The band of chance, then the means.
    """
    ok = np.flatnonzero(np.isfinite(covariate) & np.isfinite(before))
    groups = _groups(covariate[ok], names)
    at = np.arange(len(groups), dtype=np.float64) if names else np.array([covariate[ok][g].mean() for g in groups])
    scan = np.zeros(len(before), dtype=np.int64) if scan is None else scan
    chance = 1.96 * sd * np.array([_sd_of_mean(ok[g], scan, rho) for g in groups])
    area = Boxes if names else Band
    out: list[Mark] = [area(at, -chance, chance, "95 % of chance alone")]
    aside = _ASIDE if names and after is not None else 0.0
    for residual, colour, name, step in ((before, VERMILLION, _BEFORE, -aside), (after, BLUE, _AFTER, aside)):
        if residual is not None:
            means = np.array([residual[ok][g].mean() for g in groups])
            out.append(Line(at + step, means, f"mean, {name}", colour, knots=True, joined=not names))
    return tuple(out)


def _sd_of_mean(rows: IntArray, scan: IntArray, rho: float) -> float:
    """Give the sd of the mean of readings, of that of one, where each remembers the one before it (AR(1))."""
    n, own = max(rows.size, 1), np.zeros(len(scan), dtype=bool)
    own[rows] = True
    variance = 1.0 / n
    for lag in range(1, min(_longest_memory(rho), len(scan) - 1) + 1):
        both = own[lag:] & own[:-lag] & (scan[lag:] == scan[:-lag])
        variance += 2 * rho**lag * float(both.sum()) / n**2
    return math.sqrt(max(variance, 0.0))


def _longest_memory(rho: float) -> int:
    """Count the readings over which a correlation falls below a hundredth."""
    return math.ceil(math.log(0.01) / math.log(abs(rho))) if 0.01 < abs(rho) < 1 else 0


def gain_by_scan(scans: Sequence[tuple[str, float]], mean: float, sd: float) -> Panel:
    """Draw the gain on each scan that was kept back, nats a reading, and the mean of all with its error.

    Parameters
    ----------
    scans
        Name and gain of each. Of more than twelve those of least and largest gain are drawn.
    mean, sd
        Over all readings kept back, with the standard error.
    """
    ranked = sorted(scans, key=lambda pair: -pair[1])
    if len(ranked) > _MOST_SCANS:
        ranked = [*ranked[: _MOST_SCANS // 2], *ranked[-_MOST_SCANS // 2 :]]
    gains = np.array([gain for _, gain in ranked])
    said = f"all: {signed(mean, 3)} ± {number(sd, 3)}"
    return Panel(
        (
            Span(mean - sd, mean + sd, colour=GREY),
            Rule(mean, upright=True, name=said, colour=GREY, width=1.4),
            Bars(gains, [BLUE if gain >= 0 else VERMILLION for gain in gains]),
            Rule(0.0, upright=True),
        ),
        x="gain on a scan that the fit had not seen (nats a reading)",
        y_names=[(-float(k), name.replace("_", " ")) for k, (name, _) in enumerate(ranked)],
        height=30.0 * max(len(ranked), 4),
    )


def _first(diagnosis: Diagnosis, values: Mapping[str, FloatArray]) -> bytes:
    """Draw what the model misses where that is worst, before and after, and beside it every explanation."""
    place = diagnosis.where[0] if diagnosis.where else None
    after = diagnosis.residuals_after if diagnosis.is_repaired else None
    if place is None:
        label = covariate_label("level", diagnosis.recording.plan.instrumentation.unit)
        missed = _missed(diagnosis, diagnosis.predicted_before, label, after=after)
    elif place.scan is not None and place.covariate == "scan":
        missed = _missed(diagnosis, *_along_scan(diagnosis, place.scan), after=after)
    else:
        missed = _by_covariate(diagnosis, place, values[place.witness], after=after)
    likely = _explanations(diagnosis)
    missed = replace(missed, title="what the model misses", height=likely.height)
    return drawing([[missed, likely]], shares=(1.6, 1.0))


def _witness(diagnosis: Diagnosis, place: Place, at: FloatArray) -> bytes:
    """Draw the residuals of the calibrated model against a place's covariate: each, their mean, its band of chance.

    A scan is drawn along its way first, then among the others: a miss that changes its sign leaves no mean.
    """
    by_covariate = _by_covariate(diagnosis, place, at, readings=True)
    if place.scan is None or place.covariate != "scan":
        return drawing([[by_covariate]])
    along = _missed(diagnosis, *_along_scan(diagnosis, place.scan), readings=True)
    return drawing([[replace(along, height=150.0)], [replace(by_covariate, height=150.0)]])


def _by_covariate(
    diagnosis: Diagnosis,
    place: Place,
    at: FloatArray,
    *,
    after: FloatArray | None = None,
    readings: bool = False,
) -> Panel:
    """Draw residuals against the covariate of a place, (n_points,), with the place shaded."""
    unit = diagnosis.recording.plan.instrumentation.unit
    label = covariate_label(place.covariate, unit, place.scan)
    if place.level is not None:
        label = f"reading to be expected without it ({unit_name(unit)})"
    names = category_names(diagnosis, place)
    panel = _missed(diagnosis, at, label, names=names, after=after, readings=readings)
    return replace(panel, marks=(*_span(place, at, names), *panel.marks))


def _missed(
    diagnosis: Diagnosis,
    at: FloatArray,
    label: str,
    *,
    names: Mapping[float, str] | None = None,
    after: FloatArray | None = None,
    readings: bool = False,
) -> Panel:
    """Draw mean residuals against values, (n_points,), and each reading's where asked."""
    before, sd = diagnosis.residuals_before, float(diagnosis.repaired.noise_sd.mean())
    rho = next((p.mean for p in diagnosis.noise.parameters if p.name == "rho"), 0.0)
    each = Dots(_side_by_side(at) if names else at, before, "each reading", opacity=0.35)
    means = mean_residuals(at, before, after, sd=sd, rho=rho, scan=diagnosis.recording.plan.scan, names=names)
    return Panel(
        (*((each,) if readings else ()), *means, Rule(0.0)),
        x=label,
        y=f"left over ({unit_name(diagnosis.recording.plan.instrumentation.unit)})",
        x_names=[(float(k), names[value]) for k, value in enumerate(_values(at))] if names else None,
    )


def _explanations(diagnosis: Diagnosis) -> Panel:
    listed = [h for h in diagnosis.hypotheses if h.probability > _WORTH_A_BAR]
    shown = [(hypothesis_label(h.effects), h.probability) for h in listed[:_MOST_BARS]]
    if len(diagnosis.hypotheses) > len(shown):
        shown.append((f"{len(diagnosis.hypotheses) - len(shown)} others", max(1 - sum(p for _, p in shown), 0.0)))
    lines = max(name.count("\n") + 1 for name, _ in shown)
    return Panel(
        (
            Bars(
                np.array([p for _, p in shown]),
                [BLUE, *[GREY] * (len(shown) - 1)],
                [number(p, 3) for _, p in shown],
            ),
        ),
        x="probability",
        y_names=[(-float(k), name) for k, (name, _) in enumerate(shown)],
        x_ends=(0.0, 1.25),  # room for the number behind the longest
        title="what was believed before" if diagnosis.few else "what it could be",
        height=max(230.0, len(shown) * (_LINE * lines + 14.0)),
    )


def _before_and_after(diagnosis: Diagnosis) -> bytes:
    """Draw the scan that the repair changes most: readings and models, and below what each model leaves."""
    recording, plan = diagnosis.recording, diagnosis.recording.plan
    unit = unit_name(plan.instrumentation.unit)
    change = np.abs(diagnosis.predicted_after - diagnosis.predicted_before)
    scans = [rows for rows in plan.rows_by_scan() if rows.size]
    rows = max(scans, key=lambda r: (float(np.sqrt(np.mean(change[r] ** 2))), r.size))
    along, label = _along(diagnosis, rows)
    order = np.argsort(along, kind="stable")
    rows, along = rows[order], along[order]
    readings = np.where(recording.usable[rows], recording.readings[rows], np.nan)
    above: list[Mark] = [Dots(along, readings, "recorded", opacity=0.8)]
    below: list[Mark] = [Rule(0.0)]
    for predicted, residuals, colour, name in _models(diagnosis):
        above.append(Line(along, predicted[rows], name, colour))
        below.append(Dots(along, residuals[rows], f"recorded − {name}", colour, opacity=0.75))
    scan = plan.scan_names[int(plan.scan[rows[0]])]
    return drawing(
        [
            [Panel(above, y=f"reading ({unit})", title=f"scan {scan}")],
            [Panel(below, x=label, y=f"left over ({unit})", height=130.0)],
        ]
    )


def _residuals(diagnosis: Diagnosis) -> bytes:
    """Draw all residuals in time and by predicted reading, each with its running mean, before and after."""
    plan = diagnosis.recording.plan
    unit = plan.instrumentation.unit
    rows = []
    for at, label in (
        (plan.time_s, "time (s)"),
        (diagnosis.predicted_before, covariate_label("level", unit)),
    ):
        marks: list[Mark] = [Rule(0.0)]
        lines = []
        for _, residuals, colour, name in _models(diagnosis):
            marks.append(Dots(at, residuals, colour=colour, size=2.4, opacity=0.35))
            lines.append(Line(*_running_mean(at, residuals), name, colour, width=2.2))
        rows.append([Panel([*marks, *lines], x=label, y=f"left over ({unit_name(unit)})", height=180.0)])
    return drawing(rows)


def _models(diagnosis: Diagnosis) -> list[tuple[FloatArray, FloatArray, str, str]]:
    """List predicted readings, residuals, colour and name of the calibrated model, and of a repaired one."""
    models = [
        (diagnosis.predicted_before, diagnosis.residuals_before, VERMILLION, _BEFORE),
        (diagnosis.predicted_after, diagnosis.residuals_after, BLUE, _AFTER),
    ]
    return models if diagnosis.is_repaired else models[:1]


def _span(place: Place, at: FloatArray, names: Mapping[float, str] | None) -> tuple[Span, ...]:
    """Shade where it shows: from start to end, or about the scan, direction or orientation named."""
    ends = None if place.start is None or place.end is None else (place.start, place.end)
    if not names:
        return (Span(*ends, "where it shows"),) if ends else ()
    shown = _values(at)
    members = [k for k, v in enumerate(shown) if (ends[0] <= v <= ends[1] if ends else names[v] == place.scan)]
    return (Span(members[0] - 0.5, members[-1] + 0.5, "where it shows"),) if members else ()


def _values(at: FloatArray) -> list[float]:
    values: list[float] = np.unique(at[np.isfinite(at)]).tolist()
    return values


def _side_by_side(at: FloatArray) -> FloatArray:
    """Spread the rows of each value evenly over its place, in the order of taking, (n_points,)."""
    out = np.full(at.shape, np.nan)
    for k, value in enumerate(_values(at)):
        rows = np.flatnonzero(at == value)
        out[rows] = k + np.linspace(-0.4, 0.4, rows.size) if rows.size > 1 else k
    return out


def _along_scan(diagnosis: Diagnosis, scan: str) -> tuple[FloatArray, str]:
    """Give each row's place along one scan, (n_points,), NaN in all others, and its label."""
    plan = diagnosis.recording.plan
    rows = np.flatnonzero(plan.scan == plan.scan_names.index(scan))
    along, label = _along(diagnosis, rows)
    out = np.full(len(plan), np.nan)
    out[rows] = along
    return out, f"{label}, scan {scan}"


def _along(diagnosis: Diagnosis, rows: IntArray) -> tuple[FloatArray, str]:
    plan = diagnosis.recording.plan
    x_mm, y_mm = plan.x_mm[rows], plan.y_mm[rows]
    if np.ptp(x_mm) == np.ptp(y_mm) == 0:
        return plan.time_s[rows], "time (s)"
    return (x_mm, "X (mm)") if np.ptp(x_mm) >= np.ptp(y_mm) else (y_mm, "Y (mm)")


def _groups(values: FloatArray, names: Mapping[float, str] | None) -> list[IntArray]:
    """Group rows: by value where values have names, else in steps of the covariate, neighbours with too few joined."""
    if names or values.size == 0:
        return [np.flatnonzero(values == value) for value in np.unique(values)]
    step = np.minimum((_STEPS * (values - values.min()) / max(float(np.ptp(values)), 1e-300)).astype(int), _STEPS - 1)
    groups: list[IntArray] = []
    waiting = np.empty(0, dtype=np.int64)
    for k in range(_STEPS):
        waiting = np.concatenate([waiting, np.flatnonzero(step == k)])
        if waiting.size >= _LEAST_ROWS:
            groups.append(waiting)
            waiting = waiting[:0]
    if waiting.size:
        groups = [*groups[:-1], np.concatenate([*groups[-1:], waiting])]
    return groups


def _running_mean(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Average groups of about one twentieth of the points, neighbours in x."""
    ok: BoolArray = np.isfinite(x) & np.isfinite(y)
    x, y = x[ok], y[ok]
    if x.size == 0:
        return x, y
    groups = np.array_split(np.argsort(x, kind="stable"), max(1, min(20, len(x) // 4)))
    return np.array([x[g].mean() for g in groups]), np.array([y[g].mean() for g in groups])
