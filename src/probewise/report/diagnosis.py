"""The page of a diagnosis: the verdict, where it shows, what it could be, what the repair gains, what to do next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis import Alias, Diagnosis, EffectFound, Place, PlanAudit
from probewise.report.audit import audit_table
from probewise.report.covariate import category_names, covariate_label, covariate_values
from probewise.report.html import Markup, Section, definition_list, element, figure, fragment, page, paragraph, table
from probewise.report.plots import (
    AxesGrid,
    gain_by_scan,
    grid_of_axes,
    hypothesis_probabilities,
    mean_residuals,
    png,
    readings_before_and_after,
    residuals_against,
    witness,
)
from probewise.report.words import count, number, probability, unit_name

__all__ = ["answer", "figures", "sections", "write_page"]

OPENING = {
    "clean": "Nothing is missing",
    "named": "The model leaves something out",
    "cannot_tell": "This recording cannot tell",
    "noise": "The mean is right, the noise is not plain",
}
_MOST_ALIASES = 8
_WORTH_A_ROW = 0.005


def answer(diagnosis: Diagnosis) -> str:
    """Say the verdict in one sentence."""
    reason = diagnosis.reason.rstrip(".")
    if diagnosis.verdict == "unknown":  # its reason opens like that itself
        return f"{reason}."
    return f"{OPENING[diagnosis.verdict]}: {reason[:1].lower()}{reason[1:]}."


def figures(diagnosis: Diagnosis) -> dict[str, bytes]:
    """Draw the figures of a diagnosis: PNG by file name, each witness under the name that the JSON gives it."""
    unit = diagnosis.recording.plan.instrumentation.unit
    drawn = {
        "first.png": png(_first(diagnosis)),
        "before_after.png": _readings(diagnosis),
        "residuals_time.png": png(
            residuals_against(
                diagnosis.recording.plan.time_s,
                diagnosis.residuals_before,
                diagnosis.residuals_after,
                label="time (s)",
                unit=unit,
            )
        ),
        "residuals_level.png": png(
            residuals_against(
                diagnosis.predicted_before,
                diagnosis.residuals_before,
                diagnosis.residuals_after,
                label=covariate_label("level", unit),
                unit=unit,
            )
        ),
    }
    gain = diagnosis.improvement
    if gain.heldout_by_scan:
        drawn["gain.png"] = png(
            gain_by_scan(gain.heldout_by_scan, gain.heldout_log_density_per_reading, gain.heldout_sd)
        )
    for place in diagnosis.where:
        drawn[place.witness] = png(
            witness(
                place.curve_at,
                place.curve_mean,
                place.curve_sd,
                label=covariate_label(place.covariate, unit, place.scan),
                unit=unit,
                span=_span(place),
            )
        )
    return drawn


def sections(diagnosis: Diagnosis, drawn: Mapping[str, bytes]) -> list[Section]:
    """Build everything below the first screen."""
    return [
        Section("What it could be", _explanations(diagnosis)),
        Section(
            "Where it shows",
            tuple(figure(drawn[place.witness], _where(diagnosis, place)) for place in diagnosis.where)
            or (paragraph("Nowhere more than noise explains."),),
        ),
        Section("Before and after", _before_and_after(diagnosis, drawn)),
        Section("Does it predict readings that it has not seen?", _gain(diagnosis, drawn)),
        Section("What could not be told apart, and what would", (*_aliases(diagnosis), *_next(diagnosis))),
        Section("Noise", _noise(diagnosis)),
    ]


def write_page(
    diagnosis: Diagnosis, drawn: Mapping[str, bytes], *, source: str, seed: int, audit: PlanAudit | None = None
) -> str:
    """Write the whole page; `audit` is that of the readings' design, where there is one."""
    run = Section(
        "This run",
        (
            definition_list(
                (
                    ("recordings", source),
                    ("readings", f"{int(diagnosis.recording.usable.sum())} used of {len(diagnosis.recording)}"),
                    ("seed", str(seed)),
                )
            ),
            *(paragraph(f"Note: {note}.") for note in diagnosis.recording.notes),
        ),
    )
    design = () if audit is None else (Section("What these readings could have shown", _design(audit)),)
    first = fragment(figure(drawn["first.png"], _first_caption(diagnosis)), definition_list(_facts(diagnosis)))
    return page(
        f"Diagnosis of {source}: {diagnosis.verdict.replace('_', ' ')}",
        answer=answer(diagnosis),
        key_figure=first,
        sections=[*sections(diagnosis, drawn), *design, run],
    )


def _is_repaired(diagnosis: Diagnosis) -> bool:
    return not np.array_equal(diagnosis.residuals_before, diagnosis.residuals_after, equal_nan=True)


def _first(diagnosis: Diagnosis) -> AxesGrid:
    """Draw what the model misses where that is worst, before and after, and beside it every explanation."""
    axes = grid_of_axes(1, 2, size_in=(11.6, 3.9), width_ratios=[1.55, 1])
    unit = diagnosis.recording.plan.instrumentation.unit
    place = diagnosis.where[0] if diagnosis.where else None
    mean_residuals(
        diagnosis.predicted_before if place is None else covariate_values(diagnosis, place),
        diagnosis.residuals_before,
        diagnosis.residuals_after if _is_repaired(diagnosis) else None,
        sd=float(diagnosis.repaired.noise_sd.mean()),
        label=covariate_label("level", unit) if place is None else covariate_label(place.covariate, unit, place.scan),
        unit=unit,
        span=None if place is None else _span(place),
        names=None if place is None else category_names(diagnosis, place),
        ax=axes[0, 0],
    )
    hypotheses = [h for h in diagnosis.hypotheses if h.probability > _WORTH_A_ROW]
    names = [_label(h.effects) for h in hypotheses]
    hypothesis_probabilities(names, [h.probability for h in hypotheses], most=6, ax=axes[0, 1])
    axes[0, 0].set_title("what the model misses", fontsize="medium", loc="left")
    axes[0, 1].set_title("what it could be", fontsize="medium", loc="left")
    return axes


def _label(effects: Sequence[str]) -> str:
    if not effects:
        return "nothing is missing"
    return "something unknown" if effects == ("unknown",) else " +\n".join(effects)


def _first_caption(diagnosis: Diagnosis) -> str:
    where = f" {_where(diagnosis, diagnosis.where[0])}" if diagnosis.where else " Nothing stands out."
    after = ", blue after the repair" if _is_repaired(diagnosis) else ""
    return (
        f"Left: recorded minus predicted, averaged; red as calibrated{after}. The grey band is what chance alone "
        f"leaves.{where} Right: the explanations with their probabilities."
    )


def _facts(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Answer, in words that need no statistics: is it real, does the repair help, what to do now."""
    gain, unit = diagnosis.improvement, unit_name(diagnosis.recording.plan.instrumentation.unit)
    facts = [("Could it be chance?", _chance(diagnosis.p_value))]
    if gain.heldout_by_scan and _is_repaired(diagnosis):
        facts.append(("Does the repair predict?", _predicts(gain.heldout_log_density_per_reading, gain.heldout_sd)))
    if _is_repaired(diagnosis):
        facts.append(("What is left", f"rms {gain.rms_before:.3g} {unit} before, {gain.rms_after:.3g} after"))
    facts.append(("What to do next", _next_in_words(diagnosis)))
    return facts


def _predicts(nats: float, sd: float) -> str:
    measured = f"{nats:+.3f} ± {sd:.3f} nats a reading of scans that it had not seen".replace("-", "−")
    if nats > 2 * sd:
        return f"Yes: each is {math.exp(min(nats, 50.0)):.3g} times as probable as before ({measured})."
    return f"{'No better than before' if nats > -2 * sd else 'Worse than before'}: {measured}."


def _chance(p_value: float) -> str:
    if p_value > 0.05:
        return (
            f"Yes: with nothing missing, {100 * p_value:.0f} of 100 recordings look as odd as this (p = {p_value:.2g})."
        )
    often = f"1 recording in {1 / p_value:,.0f}" if p_value > 1e-6 else "less than 1 recording in a million"
    return f"Hardly: with nothing missing, {often} looks as odd as this (p = {p_value:.2g})."


def _next_in_words(diagnosis: Diagnosis) -> str:
    plan = diagnosis.next_measurement
    if plan is None:
        return "Nothing that this apparatus can do would tell more."
    said = f"{plan.description.rstrip('.')}: {count(len(plan.plan), 'reading')}, next_plan.csv."
    return f"{said[:1].upper()}{said[1:]}"


def _explanations(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    return (
        *(paragraph(_sentence(e.sentence)) for e in diagnosis.effects if e.probability > 0.05),
        table(
            ("explanation", "probability"),
            (
                (_label(h.effects).replace("\n", " ").replace("_", " "), probability(h.probability))
                for h in diagnosis.hypotheses[:8]
                if h.probability > 1e-3
            ),
            caption=f"The smallest set that holds 95 %: {', '.join(diagnosis.credible)}.",
        ),
        *_effects(diagnosis),
    )


def _before_and_after(diagnosis: Diagnosis, drawn: Mapping[str, bytes]) -> tuple[Markup, ...]:
    after = " and repaired" if _is_repaired(diagnosis) else ""
    return (
        figure(
            drawn["before_after.png"], f"Readings of one scan, with the model as calibrated{after} on the same axes."
        ),
        figure(drawn["residuals_time.png"], "Residuals in time, before and after the repair, with running means."),
        figure(drawn["residuals_level.png"], "Residuals by predicted reading, before and after the repair."),
    )


def _readings(diagnosis: Diagnosis) -> bytes:
    """Draw the scan that the repair changes most."""
    plan = diagnosis.recording.plan
    change = np.abs(diagnosis.predicted_after - diagnosis.predicted_before)
    scans = [rows for rows in plan.rows_by_scan() if rows.size]
    rows = max(scans, key=lambda r: (float(np.sqrt(np.mean(change[r] ** 2))), r.size))
    along, label = _along(diagnosis, rows)
    return png(
        readings_before_and_after(
            diagnosis.recording,
            diagnosis.predicted_before,
            diagnosis.predicted_after if _is_repaired(diagnosis) else None,
            rows,
            along=along,
            label=f"{label}, scan {plan.scan_names[int(plan.scan[rows[0]])]}",
        )
    )


def _along(diagnosis: Diagnosis, rows: IntArray) -> tuple[FloatArray, str]:
    plan = diagnosis.recording.plan
    x_mm, y_mm = plan.x_mm[rows], plan.y_mm[rows]
    if np.ptp(x_mm) == np.ptp(y_mm) == 0:
        return plan.time_s[rows], "time (s)"
    return (x_mm, "X (mm)") if np.ptp(x_mm) >= np.ptp(y_mm) else (y_mm, "Y (mm)")


def _gain(diagnosis: Diagnosis, drawn: Mapping[str, bytes]) -> tuple[Markup, ...]:
    gain, unit = diagnosis.improvement, unit_name(diagnosis.recording.plan.instrumentation.unit)
    shown = (
        (figure(drawn["gain.png"], "Each scan kept back in turn, both models fitted to the others."),)
        if "gain.png" in drawn
        else (paragraph("There are fewer than two scans of eight readings or more: none can be kept back."),)
    )
    return (
        *shown,
        definition_list(
            (
                (
                    "readings kept back",
                    f"{number(gain.heldout_log_density_per_reading, 4)} ± {number(gain.heldout_sd, 4)} nats each",
                ),
                ("log evidence", f"{number(gain.log_evidence, 1)} nats"),
                (
                    "rms of the residuals",
                    f"{number(gain.rms_before, 3)} before, {number(gain.rms_after, 3)} after ({unit})",
                ),
                ("something still missing", f"p = {gain.p_value_after:.2g}"),
            )
        ),
    )


def _noise(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    noise = diagnosis.noise
    said = paragraph(f"Model: {noise.model}; p = {noise.p_value:.2g} that it explains the noise.")
    if not noise.parameters:
        return (said,)
    rows = ((p.name, p.unit, f"{p.mean:.4g}", f"{p.sd:.2g}") for p in noise.parameters)
    return (said, table(("parameter", "unit", "mean", "sd"), rows))


def _effects(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    likely = [effect for effect in diagnosis.effects if effect.probability > _WORTH_A_ROW]
    rest = [effect for effect in diagnosis.effects if effect.probability <= _WORTH_A_ROW]
    shown = (_effect_table(likely),) if likely else ()
    if not rest:
        return shown
    return (*shown, element("details", element("summary", f"{len(rest)} less likely"), _effect_table(rest)))


def _effect_table(effects: Sequence[EffectFound]) -> Markup:
    rows = [
        (
            effect.name.replace("_", " ") if k == 0 else "",
            probability(effect.probability) if k == 0 else "",
            number(effect.size_lambda, 1) if k == 0 else "",
            p.name,
            f"{p.mean:.4g} ± {p.sd:.2g} {p.unit}".rstrip(),
            f"{p.interval95[0]:.4g} to {p.interval95[1]:.4g}",
        )
        for effect in effects
        for k, p in enumerate(effect.parameters)
    ]
    return table(("effect", "probability", "size λ", "parameter", "value", "95 % interval"), rows)


def _aliases(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    """List pairs that look alike, those among the credible explanations first and the rest folded away."""
    credible = {name for label in diagnosis.credible for name in label.split("+")}
    ranked = sorted(diagnosis.aliases, key=lambda a: (-len(credible & set(a.effects)), -a.cosine))
    if not ranked:
        return (paragraph("Every effect that could show here leaves a trace of its own."),)
    first, rest = ranked[:_MOST_ALIASES], ranked[_MOST_ALIASES:]
    if not rest:
        return (_alias_table(first),)
    more = element("details", element("summary", f"{len(rest)} more pairs"), _alias_table(rest))
    return (_alias_table(first), more)


def _alias_table(aliases: Sequence[Alias]) -> Markup:
    return table(
        ("alike in these readings", "cosine", "what would settle it", "readings"),
        (
            (
                " and ".join(a.effects).replace("_", " "),
                number(a.cosine, 3),
                a.settle_by,
                str(a.readings) if a.readings else "–",
            )
            for a in aliases
        ),
    )


def _next(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    plan = diagnosis.next_measurement
    if plan is None:
        return (
            paragraph("No further reading that this apparatus can take would tell the leading explanations apart."),
        )
    return (
        paragraph(
            f"Next: {plan.description.rstrip('.')}: {count(len(plan.plan), 'reading')}, "
            f"about {number(plan.minutes, 0)} minutes, "
            f"expected to tell {number(plan.expected_log_bayes_factor, 1)} nats between the leading hypotheses "
            "(3 nats are odds of 20 to 1). The plan is in next_plan.csv."
        ),
    )


def _design(audit: PlanAudit) -> tuple[Markup, ...]:
    def listed(names: Sequence[str]) -> str:
        return ", ".join(names).replace("_", " ") or "none"

    return (
        definition_list(
            (
                ("seen and told apart", listed([e.name for e in audit.seen_as("fine")])),
                ("taken for another", listed([f"{e.name} (as {e.alike[0][0]})" for e in audit.seen_as("aliased")])),
                ("not seen at all", listed([e.name for e in audit.seen_as("invisible")])),
            )
        ),
        element("details", element("summary", "every effect, with numbers"), audit_table(audit.effects)),
        paragraph("What readings would cure this, before any are taken: probewise audit PLAN.csv."),
    )


def _span(place: Place) -> tuple[float, float] | None:
    return None if place.start is None or place.end is None else (place.start, place.end)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def _where(diagnosis: Diagnosis, place: Place) -> str:
    what = f"It shows in the {covariate_label(place.covariate, diagnosis.recording.plan.instrumentation.unit)}"
    if place.start is not None and place.end is not None:
        what += f" from {place.start:.4g} to {place.end:.4g}"
    if place.scan:
        what += f", {place.scan}" if place.covariate == "scan" else f", scan {place.scan}"
    return f"{what}: p = {place.p_value:.2g}."
