"""The page of a diagnosis: the verdict, where it shows, what it could be, what the repair gains, what to do next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from probewise.diagnosis import (
    ALARM,
    MOST_READINGS,
    Alias,
    Diagnosis,
    EffectFound,
    ParameterFound,
    Place,
    PlanAudit,
    p_in_words,
)
from probewise.effects.vocabulary import give_or_take
from probewise.report.audit_table import audit_table
from probewise.report.covariate import covariate_unit, covariate_words
from probewise.report.diagnosis_figures import figures, hypothesis_label
from probewise.report.html import Markup, Section, definition_list, element, figure, fragment, page, paragraph, table
from probewise.report.words import count, number, probability, readable, unit_name

__all__ = ["answer", "figures", "sections", "write_page"]

OPENING = {
    "clean": "Nothing is missing",
    "named": "The model leaves something out",
    "cannot_tell": "This recording cannot tell",
    "noise": "The mean is right, the noise is not plain",
}
_MOST_ALIASES = 8
_LIKELY = 0.05  # of an effect that is spoken of at once
_CHANCE = 0.05  # p-value above which nobody is surprised
_TELLS_SOMETHING = 0.5  # nats


def answer(diagnosis: Diagnosis) -> str:
    """Say the verdict in one sentence."""
    reason = readable(diagnosis.reason.rstrip("."))
    if diagnosis.verdict == "unknown":  # its reason opens like that itself
        return f"{reason}."
    return f"{OPENING[diagnosis.verdict]}: {reason[:1].lower()}{reason[1:]}."


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
        Section(
            "What could not be told apart, and what would", (*_aliases(diagnosis), paragraph(_next_in_words(diagnosis)))
        ),
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
    first = fragment(figure(drawn["first.svg"], _first_caption(diagnosis)), definition_list(_facts(diagnosis)))
    return page(
        f"Diagnosis of {source}: {diagnosis.verdict.replace('_', ' ')}",
        answer=answer(diagnosis),
        key_figure=first,
        sections=[*sections(diagnosis, drawn), *design, run],
    )


def _first_caption(diagnosis: Diagnosis) -> str:
    where = f" {_where(diagnosis, diagnosis.where[0])}" if diagnosis.where else " Nothing stands out."
    after = ", blue after the repair" if diagnosis.is_repaired else ""
    return (
        f"Left: recorded minus predicted, averaged; orange as calibrated{after}. The grey band is what chance alone "
        f"leaves.{where} Right: the explanations with their probabilities."
    )


def _facts(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """Answer, in words that need no statistics: is it real, does the repair help, what to do now."""
    gain, unit = diagnosis.improvement, unit_name(diagnosis.recording.plan.instrumentation.unit)
    facts = [] if diagnosis.few else [("Could it be chance?", _chance(diagnosis))]
    if gain.heldout_by_scan and diagnosis.is_repaired:
        facts.append(("Does the repair predict?", _predicts(gain.heldout_log_density_per_reading, gain.heldout_sd)))
    if diagnosis.is_repaired:
        left = f"rms {gain.rms_before:.3g} {unit} before, {gain.rms_after:.3g} after"
        only_here = "; what has no name is put right in these readings alone, sensor.json does not carry it"
        facts.append(("What is left", left + only_here if diagnosis.corrected else left))
    if diagnosis.left_open:
        facts.append(("What its predictions leave open", _shares(diagnosis.left_open)))
    facts.append(("What to do next", _next_in_words(diagnosis)))
    return facts


def _predicts(nats: float, sd: float) -> str:
    measured = f"{nats:+.3f} ± {sd:.3f} nats a reading of scans that it had not seen".replace("-", "−")
    if nats > 2 * sd:
        return f"Yes: each is {math.exp(min(nats, 50.0)):.3g} times as probable as before ({measured})."
    return f"{'No better than before' if nats > -2 * sd else 'Worse than before'}: {measured}."


def _shares(shares: Mapping[tuple[str, ...], float]) -> str:
    listed = (f"{' with '.join(names).replace('_', ' ') or 'no effect'} in {p:.0%}" for names, p in shares.items())
    return f"{', '.join(listed)} of the samples in sensor.json"


def _chance(diagnosis: Diagnosis) -> str:
    p_value, p = diagnosis.p_value, p_in_words(diagnosis.p_value)
    if p_value > _CHANCE:
        often = f"with nothing missing, {100 * p_value:.0f} of 100 recordings look as odd as this ({p})"
    elif p_value > 1e-6:
        often = f"with nothing missing, 1 recording in {1 / p_value:,.0f} looks as odd as this ({p})"
    else:
        often = readable(f"with nothing missing, less than 1 recording in a million looks as odd as this ({p})")
    if diagnosis.verdict == "noise":
        gained = f"plain noise explains these readings worse by {diagnosis.improvement.log_evidence:.0f} nats"
        return f"What is said of the noise, hardly: {gained}. The mean is another matter: {often}."
    if diagnosis.verdict == "unknown" and p_value > _CHANCE:
        return f"The mean, yes: {often}. That readings far out lie together is no chance."
    return f"{'Yes' if p_value > _CHANCE else 'Hardly'}: {often}."


def _next_in_words(diagnosis: Diagnosis) -> str:
    plan = diagnosis.next_measurement
    if plan is None and diagnosis.few:
        return "Scan across an edge, and take more readings: these say nothing."
    if plan is None:
        return "Nothing that this apparatus can do would tell more."
    told = plan.expected_log_bayes_factor
    asked = f"{count(len(plan.plan), 'reading')}, about {count(max(round(plan.minutes), 1), 'minute')}"
    said = f"{plan.description.rstrip('.')}: {asked}, next_plan.csv."
    if told < _TELLS_SOMETHING:
        return f"No plan of {MOST_READINGS} readings was found that tells more than {number(told, 1)} nats: {said}"
    *others, last = plan.between
    rivals = f"{others[0]} from {last}" if len(others) == 1 else f"apart {', '.join(others)} and {last}"
    by = f"by {number(told, 1)} nats; 3 are odds of 20 to 1"
    return f"{said[:1].upper()}{said[1:]} Expected to tell {rivals} {by}."


def _explanations(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    return (
        *(paragraph(_sentence(e.sentence)) for e in diagnosis.effects if e.probability > _LIKELY),
        table(
            ("explanation", "probability"),
            (
                (hypothesis_label(h.effects).replace("\n", " "), probability(h.probability))
                for h in diagnosis.hypotheses[:8]
                if h.probability > 1e-3
            ),
        ),
        paragraph(f"The smallest set that holds 95 %: {', '.join(diagnosis.credible).replace('_', ' ')}."),
        *_candidates(diagnosis),
        *_carried(diagnosis),
        *_weighings(diagnosis),
        *_effects(diagnosis),
    )


def _candidates(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    """Say what something unknown may be, where it may be there at all."""
    likely = [(name, p) for name, p in diagnosis.unknown_candidates if p > _LIKELY]
    if not likely:
        return ()
    listed = ", ".join(f"{name.replace('_', ' ')} ({probability(p)})" for name, p in likely)
    return (paragraph(f"What has no name may be, or depend on: {listed}."),)


def _carried(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    """Say what the repaired sensor carries that no explanation above does."""
    return tuple(
        paragraph(_sentence(f"In {share:.0%} of the repaired sensor's samples: {sentence}"))
        for _, share, sentence in diagnosis.carried
    )


def _weighings(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    """Set both evidences of what was weighed twice side by side."""
    if not diagnosis.weighings:
        return ()
    return (
        table(
            ("weighed twice", "Gaussians", "ln Z, Laplace", "ln Z, nested sampling", "within a nat"),
            (
                (
                    hypothesis_label(w.effects).replace("\n", " "),
                    str(w.n_gaussians or "–"),
                    number(w.laplace, 2),
                    f"{number(w.nested, 2)} ± {number(w.error, 2)}",
                    ("yes" if w.agree else "no") + (f" ({'; '.join(w.doubts)})" if w.doubts else ""),
                )
                for w in diagnosis.weighings
            ),
            caption="Log evidence with the posterior taken for one Gaussian peak, and by a search of the whole prior.",
        ),
    )


def _before_and_after(diagnosis: Diagnosis, drawn: Mapping[str, bytes]) -> tuple[Markup, ...]:
    after = " and repaired" if diagnosis.is_repaired else ""
    return (
        figure(
            drawn["before_after.svg"],
            f"Readings of one scan, with the model as calibrated{after} on the same axes; below what is left over.",
        ),
        figure(
            drawn["residuals.svg"],
            "What is left over of all readings, in time and by predicted reading, with running means.",
        ),
    )


def _gain(diagnosis: Diagnosis, drawn: Mapping[str, bytes]) -> tuple[Markup, ...]:
    gain, unit = diagnosis.improvement, unit_name(diagnosis.recording.plan.instrumentation.unit)
    shown = (
        (figure(drawn["gain.svg"], "Each scan kept back in turn, both models fitted to the others."),)
        if "gain.svg" in drawn
        else (paragraph(_nothing_kept_back(diagnosis)),)
    )
    held = f"{number(gain.heldout_log_density_per_reading, 4)} ± {number(gain.heldout_sd, 4)} nats each"
    kept_back = (("readings kept back", held),) if gain.heldout_by_scan else ()
    return (
        *shown,
        definition_list(
            (
                *kept_back,
                ("log evidence", f"{number(gain.log_evidence, 1)} nats"),
                (
                    "rms of the residuals",
                    f"{number(gain.rms_before, 3)} before, {number(gain.rms_after, 3)} after ({unit})",
                ),
                ("something still missing", readable(p_in_words(gain.p_value_after))),
            )
        ),
    )


def _nothing_kept_back(diagnosis: Diagnosis) -> str:
    if not diagnosis.is_repaired:
        return "The mean is as calibrated: there is no repair to be tested on readings kept back."
    return "There are fewer than two scans of eight readings or more: none can be kept back."


def _noise(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    noise = diagnosis.noise
    said = paragraph(readable(f"Model: {noise.model}; {p_in_words(noise.p_value)} that it explains the noise."))
    if not noise.parameters:
        return (said,)
    rows = ((p.name, p.unit, f"{p.mean:.4g}", f"{p.sd:.2g}") for p in noise.parameters)
    return (said, table(("parameter", "unit", "mean", "sd"), rows))


def _effects(diagnosis: Diagnosis) -> tuple[Markup, ...]:
    likely = [effect for effect in diagnosis.effects if effect.probability > _LIKELY]
    rest = [effect for effect in diagnosis.effects if effect.probability <= _LIKELY]
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
            *(_value(p) if p.name != "scans" else (", ".join(effect.scans), "")),
        )
        for effect in effects
        for k, p in enumerate(effect.parameters)
    ]
    return table(("effect", "probability", "size λ", "parameter", "value", "95 % interval"), rows)


def _value(found: ParameterFound) -> tuple[str, str]:
    """Write a parameter with its sd and unit, and its interval."""
    low, high = found.interval95
    unit = "" if found.unit == "1" else f" {found.unit}"
    value = f"{give_or_take(found.mean, found.sd)}{unit}"
    return readable(value), readable(f"{low:.4g} to {high:.4g}")


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
                _readings(a.readings),
            )
            for a in aliases
        ),
    )


def _readings(n: int) -> str:
    """Write how many readings would settle something; more than a plan may have are not counted."""
    return "–" if n == 0 else str(n) if n < MOST_READINGS else f"{MOST_READINGS} or more"


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


def _sentence(text: str) -> str:
    return readable(f"{text[:1].upper()}{text[1:].rstrip('.')}.")


def _where(diagnosis: Diagnosis, place: Place) -> str:
    shows = "It shows" if place.p_value < ALARM else "What stands out most, as chance may have it, is"
    what = f"{shows} in the {covariate_words(place.covariate)}"
    if place.covariate == "scan":
        what = f"{shows} in scan {place.scan}"
    elif place.start is not None and place.end is not None:
        unit = covariate_unit(place.covariate, diagnosis.recording.plan.instrumentation.unit)
        start, end = f"{place.start:.4g}", f"{place.end:.4g}"
        what += f" at {start} {unit}".rstrip() if start == end else f" from {start} to {end} {unit}".rstrip()
    if place.scan and place.covariate != "scan":
        what += f", scan {place.scan}"
    return readable(f"{what} ({p_in_words(place.p_value)}).")
