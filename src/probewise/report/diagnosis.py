"""The page of a diagnosis: the verdict, where it shows, what it could be, what the repair gains."""

from __future__ import annotations

from collections.abc import Mapping

from probewise.diagnosis import Diagnosis, Place
from probewise.report.html import Markup, Section, definition_list, figure, page, paragraph, table
from probewise.report.plots import hypothesis_probabilities, png, residuals_against, witness
from probewise.report.words import count, number, probability, unit_name

__all__ = ["answer", "figures", "sections", "write_page"]

UNITS = {
    "place": "mm",
    "time": "s",
    "orientation": "degree",
    "level": "reading",
    "slope": "reading per mm",
    "edge_distance": "mm",
}
OPENING = {
    "clean": "Nothing is missing",
    "named": "The model leaves something out",
    "cannot_tell": "This recording cannot tell",
    "unknown": "Something without a name is missing",
    "noise": "The mean is right, the noise is not plain",
}


def answer(diagnosis: Diagnosis) -> str:
    """Say the verdict in one sentence."""
    reason = diagnosis.reason.rstrip(".")
    return f"{OPENING[diagnosis.verdict]}: {reason[:1].lower()}{reason[1:]}."


def figures(diagnosis: Diagnosis) -> dict[str, bytes]:
    """Draw the figures of a diagnosis: PNG by file name, each witness under the name that the JSON gives it."""
    hypotheses = [h for h in diagnosis.hypotheses if h.probability > 1e-4]
    unit = diagnosis.recording.plan.instrumentation.unit
    drawn = {
        "hypotheses.png": png(
            hypothesis_probabilities([h.label for h in hypotheses], [h.probability for h in hypotheses])
        ),
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
                label=f"predicted reading ({unit_name(unit)})",
                unit=unit,
            )
        ),
    }
    for place in diagnosis.where:
        drawn[place.witness] = png(
            witness(
                place.curve_at,
                place.curve_mean,
                place.curve_sd,
                label=_covariate(place.covariate) + (f", scan {place.scan}" if place.scan else ""),
                unit=unit,
                span=None if place.start is None or place.end is None else (place.start, place.end),
            )
        )
    return drawn


def sections(diagnosis: Diagnosis, drawn: Mapping[str, bytes]) -> list[Section]:
    """Build everything below the answer."""
    gain, noise = diagnosis.improvement, diagnosis.noise
    unit = diagnosis.recording.plan.instrumentation.unit
    return [
        Section(
            "What it could be",
            (
                figure(drawn["hypotheses.png"], "Probability of each hypothesis; they sum to one."),
                paragraph(
                    f"The smallest set that holds 95 %: {', '.join(diagnosis.credible)}. Probability of data like "
                    f"these if nothing were missing from the mean: p = {diagnosis.p_value:.2g}."
                ),
                *_effects(diagnosis),
            ),
        ),
        Section(
            "Where it shows",
            tuple(figure(drawn[place.witness], _where(place)) for place in diagnosis.where)
            or (paragraph("Nowhere more than noise explains."),),
        ),
        Section(
            "What the repair gains",
            (
                definition_list(
                    (
                        ("log evidence", f"{number(gain.log_evidence, 1)} nats"),
                        (
                            "readings kept back",
                            f"{number(gain.heldout_log_density_per_reading, 4)} ± "
                            f"{number(gain.heldout_sd, 4)} nats each",
                        ),
                        (
                            "rms of the residuals",
                            f"{number(gain.rms_before, 3)} before, {number(gain.rms_after, 3)} after "
                            f"({unit_name(unit)})",
                        ),
                        ("something still missing", f"p = {gain.p_value_after:.2g}"),
                    )
                ),
                figure(
                    drawn["residuals_time.png"], "Residuals in time, before and after the repair, with running means."
                ),
                figure(drawn["residuals_level.png"], "Residuals by predicted reading, before and after the repair."),
            ),
        ),
        Section(
            "Noise",
            (
                paragraph(f"Model: {noise.model}; p = {noise.p_value:.2g} that it explains the noise."),
                *(
                    (
                        table(
                            ("parameter", "unit", "mean", "sd"),
                            ((p.name, p.unit, f"{p.mean:.4g}", f"{p.sd:.2g}") for p in noise.parameters),
                        ),
                    )
                    if noise.parameters
                    else ()
                ),
            ),
        ),
        Section("What to measure next", (*_aliases(diagnosis), *_next(diagnosis))),
    ]


def write_page(diagnosis: Diagnosis, drawn: Mapping[str, bytes], *, source: str, seed: int) -> str:
    """Write the whole page."""
    key = (
        figure(drawn[diagnosis.where[0].witness], _where(diagnosis.where[0]))
        if diagnosis.where
        else figure(drawn["hypotheses.png"], "Probability of each hypothesis.")
    )
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
    return page(
        f"Diagnosis: {diagnosis.verdict}",
        answer=answer(diagnosis),
        key_figure=key,
        sections=[*sections(diagnosis, drawn), run],
    )


def _effects(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    if not diagnosis.effects:
        return ()
    rows = [
        (
            effect.name.replace("_", " ") if k == 0 else "",
            probability(effect.probability) if k == 0 else "",
            number(effect.size_lambda, 1) if k == 0 else "",
            p.name,
            f"{p.mean:.4g} ± {p.sd:.2g} {p.unit}".rstrip(),
            f"{p.interval95[0]:.4g} to {p.interval95[1]:.4g}",
        )
        for effect in diagnosis.effects
        for k, p in enumerate(effect.parameters)
    ]
    told = tuple(paragraph(_sentence(e.sentence)) for e in diagnosis.effects if e.probability > 0.05)
    return (*told, table(("effect", "probability", "size λ", "parameter", "value", "95 % interval"), rows))


def _aliases(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    if not diagnosis.aliases:
        return ()
    return (
        table(
            ("alike under this plan", "cosine", "what would settle it"),
            (
                (
                    " and ".join(a.effects).replace("_", " "),
                    number(a.cosine, 3),
                    f"{a.settle_by} ({a.readings} readings)",
                )
                for a in diagnosis.aliases
            ),
        ),
    )


def _next(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    plan = diagnosis.next_measurement
    if plan is None:
        return (paragraph("No further reading is needed to decide."),)
    return (
        paragraph(
            f"{plan.description.rstrip('.')}: {count(len(plan.plan), 'reading')}, "
            f"about {number(plan.minutes, 0)} minutes, "
            f"expected to tell {number(plan.expected_log_bayes_factor, 1)} nats between the leading hypotheses. "
            "The plan is in next_plan.csv."
        ),
    )


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def _where(place: Place) -> str:
    what = f"In {_covariate(place.covariate)}"
    if place.start is not None and place.end is not None:
        what += f" from {place.start:.4g} to {place.end:.4g}"
    if place.scan:
        what += f", scan {place.scan}"
    return f"{what}: p = {place.p_value:.2g}."


def _covariate(name: str) -> str:
    unit = UNITS.get(name)
    return name.replace("_", " ") + (f" ({unit})" if unit else "")
