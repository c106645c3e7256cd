"""The page of a diagnosis: the verdict, its main figure, what to measure next; then the details."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from probewise._words import count_with_noun, unit_after_number, value_with_sd
from probewise._writing import Output, StagedFiles
from probewise.calibration import write_sensor
from probewise.diagnosis import (
    ALARM,
    MOST_ADVISED_READINGS,
    NEXT_PLAN,
    TO_SEPARATE,
    Alias,
    Diagnosis,
    EffectFound,
    Formula,
    ParameterFound,
    Place,
    calibrated_of,
    diagnosis_json,
    generators_of_diagnosis,
    notes_on_calls,
    p_in_words,
    repaired_of,
)
from probewise.diagnosis.locate import figure_name_of
from probewise.diagnosis.prepared import rows_to_diagnose
from probewise.diagnosis.words import (
    effect_has_words,
    effect_in_words,
    hypothesis_in_words,
    join_lists,
    join_names,
    parameter_in_words,
)
from probewise.effects import name_without_copy_suffix
from probewise.recordings import write_plan
from probewise.report import html
from probewise.report.covariates import (
    category_name_by_value,
    covariate_in_words_and_unit,
    noise_of,
    term_family_in_words,
)
from probewise.report.diagnosis_figures import figure_drawers, first_figure_content, noun_of_held_out_part
from probewise.report.headline import headline as summary_sentence
from probewise.report.words import (
    duration_text,
    number_text,
    probability_text,
    range_text,
    typeset_numbers,
    value_with_error,
)
from probewise.systems import RunTable, run_table_csv, write_fitted_system
from probewise.verbs import DEFAULT_SEED

__all__ = ["figure_drawers", "output_of", "page_html", "sections", "summary_sentence"]

_MOST_ALIASES = 8
_MOST_PLACES = 3
_MOST_PARAMETERS = 12
_LIKELY = 0.05  # probability of an effect from which it has a paragraph of its own
_CHANCE = 0.05  # p-value above which chance is a sufficient explanation
_NOISE_CAPTIONS = {
    "correlated_noise": "Correlation of residuals, by how many readings they lie apart.",
    "random_walk": "Correlation of residuals, by how many readings they lie apart: for a random walk it falls slowly.",
    "signal_dependent_noise": "Scatter of residuals by predicted reading: constant for white noise.",
    "outliers": "Histogram of residuals on a logarithmic scale, with a normal distribution.",
    "dropouts": "Histogram of residuals on a logarithmic scale, with a normal distribution; lost readings are far out.",
    "quantisation": "Position of readings between two multiples of the rounding step; unrounded readings lie anywhere.",
}


def sections(diagnosis: Diagnosis, drawn: Mapping[str, bytes]) -> list[html.Section]:
    """Build the sections of a diagnosis's page, below the first screen; `drawn` is from `figure_drawers`."""
    before, changed = diagnosis.apparatus.words.before_in_words, "The model"
    if diagnosis.repair_changes_predictions:
        changed = f"Before and after: {before}, {diagnosis.after_in_words}"
    return [
        html.Section("What it could be", _explanation_elements(diagnosis)),
        html.Section("Where it shows", _place_elements(diagnosis, drawn)),
        html.Section(changed, _before_and_after_elements(diagnosis, drawn)),
        html.Section("Does the repaired model predict held-out readings?", _heldout_gain_elements(diagnosis, drawn)),
        html.Section("Aliased effects, and what would separate them", _alias_elements(diagnosis)),
        html.Section("Noise", _noise_elements(diagnosis, drawn)),
    ]


def page_html(diagnosis: Diagnosis, drawn: Mapping[str, bytes], *, source: str, seed: int | None) -> str:
    """Return the HTML of a diagnosis's page; `drawn` is from `figure_drawers`."""
    n_used = int(diagnosis.recording.usable[rows_to_diagnose(diagnosis.recording)].sum())
    facts = {"recordings": source, "readings": f"{n_used} used of {len(diagnosis.recording)}", **html.seed_fact(seed)}
    facts |= dict(diagnosis.apparatus.words.facts)
    notes = html.notes_in_words((*diagnosis.recording.notes, *notes_on_calls(diagnosis)))
    shown = html.figure(drawn["first.svg"], _first_figure_caption(diagnosis))
    return html.page(
        f"Diagnosis of {source}: {diagnosis.verdict.replace('_', ' ')}",
        answer=summary_sentence(diagnosis),
        key_figure=html.fragment(shown, html.definition_list(_questions_and_answers(diagnosis))),
        sections=[*sections(diagnosis, drawn), html.Section("This run", (facts, *notes))],
        with_terms=True,
    )


def _first_figure_caption(diagnosis: Diagnosis) -> str:
    shown = first_figure_content(diagnosis)
    bars = "Below: the possible explanations with their probabilities."
    if shown == "readings":
        return "The readings in the order of time. Below: prior probabilities; these readings do not change them."
    if isinstance(shown, str):
        return f"{_NOISE_CAPTIONS.get(shown, _NOISE_CAPTIONS['signal_dependent_noise'])} {bars}"
    after = f", blue squares: {diagnosis.after_in_words}" if diagnosis.repair_changes_predictions else ""
    where = f" {_place_caption(diagnosis, shown.place)}" if shown.place else ""
    circles = f"Orange circles: {diagnosis.apparatus.words.before_in_words}{after}."
    band = "By chance alone, 95 % of the means would lie in the grey band."
    return f"Residuals, averaged in bins. {circles} {band}{where} {bars}"


def _questions_and_answers(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """List pairs of a reader's question and its answer in words: what to measure next, what was found, ..."""
    gain, changes = diagnosis.improvement, diagnosis.repair_changes_predictions
    facts = [
        ("What to measure next", _next_readings_in_words(diagnosis)),
        ("What was found", _as_sentence(diagnosis, diagnosis.reason.partition(TO_SEPARATE)[0])),
    ]
    if diagnosis.formula is not None:
        facts.append(("As a formula", _formula_in_words(diagnosis.formula)))
    if diagnosis.remainder is not None:
        facts.append(("Beside that", _as_sentence(diagnosis, diagnosis.remainder.sentence)))
    if not diagnosis.too_little:
        facts.append(("Could it be chance?", _could_be_chance_in_words(diagnosis)))
    if gain.heldout_by_scan and changes:
        predicts = _heldout_gain_in_words(gain.heldout_log_density_per_reading, gain.heldout_sd)
        facts.append(("Does the repair predict?", predicts))
    if gain.comes_next and gain.comes_next.n_readings and changes:
        told = _heldout_gain_in_words(gain.comes_next.per_reading, gain.comes_next.sd)
        run = diagnosis.apparatus.words.run
        facts.append(("Does it predict what comes next?", f"{told} Held out was the last fifth of each {run}."))
    if changes:
        beside = " (beside the random walk of the zero, which no residual contains)" if diagnosis.after.has_walk else ""
        left = f"rms {_rms_in_words(diagnosis)}{beside}."
        if diagnosis.by_rows:
            left += f" The unknown part is corrected in these readings only: {diagnosis.not_in_model}."
        facts.append(("Residuals", left))
    if diagnosis.combination_shares:
        samples = f"Posterior samples in {diagnosis.apparatus.words.model} contain {diagnosis.shares_in_words}."
        facts.append(("In the repaired model", samples))
    return facts


def _rms_in_words(diagnosis: Diagnosis) -> str:
    """Write the rms of the residuals as calibrated, and after a repair that changes them."""
    gain, unit = diagnosis.improvement, diagnosis.recording.plan.instrumentation.unit_after_number
    before = f"{gain.rms_before:.3g} {unit}{diagnosis.recording.weighting_in_words}"
    under = diagnosis.noise_of_residuals_in_words
    if not diagnosis.repair_changes_predictions:
        return f"{before}{under}"
    after = typeset_numbers(f"{gain.rms_after:.3g} {diagnosis.after_in_words}")
    return f"{before} {diagnosis.apparatus.words.before_in_words}, {after}{under}"


def _formula_in_words(formula: Formula) -> str:
    """Write what a formula is added to, its parameters, and its gain in log evidence and per held-out reading."""
    numbers = ", ".join(f"{p.name} = {value_with_sd(p.mean, p.sd)}" for p in formula.parameters)
    of = f"the rate of {formula.target}" if formula.side == "rate" else formula.target
    held_out = f"{formula.heldout_log_density_per_reading:+.3f} nats per held-out reading"
    gained = f"log evidence {formula.log_evidence:+.1f} nats, {held_out}"
    return typeset_numbers(f"Added to {of}: {formula.expression}, {numbers} ({gained}).")


def _heldout_gain_in_words(nats: float, sd: float) -> str:
    written = value_with_sd(nats, sd)
    measured = f"{typeset_numbers(written if written.startswith('-') else f'+{written}')} nats per held-out reading"
    if nats > 2 * sd:
        times = math.exp(min(nats, 50.0))
        many = f"{times:.3g}" if times < 1000 else "over a thousand"
        return f"Yes: each reading is {many} times as probable as before ({measured})."
    return f"{'No better than before' if nats > -2 * sd else 'Worse than before'}: {measured}."


def _could_be_chance_in_words(diagnosis: Diagnosis) -> str:
    p_value, log_evidence = diagnosis.p_value, diagnosis.improvement.log_evidence
    often = "less than 1 recording in a million looks"
    if p_value > 1e-6:
        often = f"1 recording in {float(f'{1 / p_value:.2g}'):,.0f} looks"
    said = "Yes" if p_value > _CHANCE else "Hardly"
    if diagnosis.verdict == "noise":  # what is beyond doubt is in both models, and gains nothing
        gained = f"log evidence {log_evidence:.0f} nats over white noise"
        said = f"The noise, hardly ({gained if log_evidence > 0.5 else 'all readings are multiples of one step'})"
    elif diagnosis.verdict == "unknown" and p_value > _CHANCE:
        said = "The mean, yes, but chance would not put so many outlying readings together"
    return typeset_numbers(f"{said}: with nothing missing, {often} as odd as this ({p_in_words(p_value)}).")


def _next_readings_in_words(diagnosis: Diagnosis) -> str:
    plan = diagnosis.next_measurement
    if plan is None and diagnosis.too_little:
        cure = diagnosis.apparatus.words.find_signal
        return f"{cure[:1].upper()}{cure[1:]}, and take more readings."
    if plan is None and diagnosis.is_settled:
        return "Nothing more is needed."
    if plan is None:
        return "No readings that were considered, within the ranges recorded here, would settle what is open."
    told = plan.expected_log_bayes_factor
    taken = count_with_noun(len(plan.plan), "reading")
    if diagnosis.apparatus.words.tells_duration:
        taken += f", about {duration_text(plan.minutes)}"
    said = f"{plan.description.rstrip('.')}: {taken}, {diagnosis.apparatus.words.next_plan}."
    classes = [join_lists([plan.between[k] for k in own], "or") for own in plan.classes_among(plan.effects)]
    separated = " from ".join(classes) if len(classes) == 2 else join_lists(classes)
    nats = "more than 100" if told > 100 else number_text(told, 0 if told >= 10 else 1)  # no one needs more
    return f"{said[:1].upper()}{said[1:]} Expected to separate {separated} by {nats} nats."


def _explanation_elements(diagnosis: Diagnosis) -> Sequence[str]:
    credible = "; ".join(hypothesis_in_words(() if k == "clean" else k.split("+")) for k in diagnosis.credible)
    likely = sorted((e for e in diagnosis.effects if e.probability > _LIKELY), key=lambda e: -e.size_lambda)
    candidates = ", ".join(
        f"{effect_in_words(name) if effect_has_words(name) else term_family_in_words(name)} ({probability_text(p)})"
        for name, p in diagnosis.unknown_candidates
        if p > _LIKELY
    )
    opening = "Candidates for the unknown effect (a covariate that it depends on, or a form)"
    return (
        *(
            _as_sentence(
                diagnosis,
                f"{effect_in_words(e.name)} ({probability_text(e.probability)}, alone or beside others): {e.sentence}",
            )
            for e in likely
        ),
        f"95 % credible set (the fewest explanations that hold 0.95): {credible}.",
        *([f"{opening}: {candidates}."] if candidates else []),
        *(  # effects in the repaired model's samples that are not among the diagnosis's
            _as_sentence(diagnosis, f"In {share:.0%} of the repaired model's samples: {sentence}")
            for _, share, sentence in diagnosis.unstated_effects
        ),
        *_laplace_and_nested_table(diagnosis),
        *([_effect_table(likely)] if likely else []),
    )


def _laplace_and_nested_table(diagnosis: Diagnosis) -> Sequence[str]:
    """Build the table of the explanations whose evidence was computed twice; empty if none was."""
    rows = [
        (
            hypothesis_in_words(w.effects),
            str(w.n_gaussians or "–"),
            number_text(w.laplace, 2),
            typeset_numbers(value_with_sd(w.nested, w.error)),
            ("yes" if w.agree else "no") + (f" ({'; '.join(w.doubts)})" if w.doubts else ""),
        )
        for w in diagnosis.weighings
    ]
    header = ("explanation", "Gaussians", "ln Z, Laplace", "ln Z, nested sampling", "agree to a nat plus the error")
    caption = "Log evidence ln Z (nats) by the Laplace approximation and by nested sampling."
    return (html.table(header, rows, caption=caption),) if rows else ()


def _place_elements(diagnosis: Diagnosis, drawn: Mapping[str, bytes]) -> Sequence[str]:
    """Build the figures of the places with significant residuals; all but the first three are folded away."""
    if not diagnosis.where:
        return ("No residual is larger than noise explains.",)
    shown = [
        html.figure(drawn[place.figure_name], _place_caption(diagnosis, place, seen=seen))
        for place, seen in noise_of(diagnosis).ranked_places
    ]
    opening = (
        f"Residuals of the {diagnosis.apparatus.words.unrepaired} model against each covariate in which they are "
        "significant: the headline's first, then the most visible. Each dot is a reading; by chance alone, 95 % of the "
        "means would lie in the grey band."
    )
    rest = shown[_MOST_PLACES:]
    return (opening, *shown[:_MOST_PLACES], *((html.details(f"{len(rest)} more", *rest),) if rest else ()))


def before_and_after_caption(diagnosis: Diagnosis) -> str:
    """Return the caption of the figure of one scan: readings and predictions before and after the diagnosis."""
    run = diagnosis.apparatus.words.run
    which, colours = f"One {run}", "orange"
    if diagnosis.repair_changes_predictions:
        which = f"The {run} that changes most"
        colours = f"orange {diagnosis.apparatus.words.before_in_words}, blue {diagnosis.after_in_words}"
    return f"{which}: readings (black) and predictions ({colours}), and below the residuals with their running means."


def _before_and_after_elements(diagnosis: Diagnosis, drawn: Mapping[str, bytes]) -> Sequence[str]:
    return (
        html.figure(drawn["before_after.svg"], before_and_after_caption(diagnosis)),
        *([_parameter_table(diagnosis)] if isinstance(diagnosis.recording.plan, RunTable) else []),
        *(
            html.figure(drawn[figure_name_of(e.name)], _as_sentence(diagnosis, f"With the 95 % band: {e.sentence}"))
            for e in diagnosis.effects
            if figure_name_of(e.name) in drawn
        ),
    )


def _parameter_table(diagnosis: Diagnosis) -> html.Markup:
    """Build the table of a simulator's parameters in both models; folded away if they are many. A sensor has a file."""
    models = [(diagnosis.apparatus.words.before_in_words, diagnosis.null)]
    models += [(diagnosis.after_in_words, diagnosis.repaired)] * diagnosis.repair_changes_predictions
    columns = [dict(zip(model.chain.names, model.theta.T, strict=True)) for _, model in models]
    names = [name for name in columns[0] if name in columns[-1]]
    rows = [(k, *(value_with_error(float(c[k].mean()), float(c[k].std())) for c in columns)) for k in names]
    listed = html.table(("parameter of the simulator", *(name for name, _ in models)), rows)
    return listed if len(rows) <= _MOST_PARAMETERS else html.details(f"{len(rows)} parameters", listed)


def _heldout_gain_elements(diagnosis: Diagnosis, drawn: Mapping[str, bytes]) -> Sequence[str | Mapping[str, str]]:
    gain, changes = diagnosis.improvement, diagnosis.repair_changes_predictions
    words = diagnosis.apparatus.words
    unchanged = f"The predicted mean is {words.before_in_words}: there is no repair to test on held-out readings."
    shown = words.nothing_held_out if changes else unchanged
    if "gain.svg" in drawn:
        caption = (
            f"Gain in log predictive density of each held-out {noun_of_held_out_part(diagnosis)}, both models "
            "fitted to the others: blue where the repaired model predicts better, orange where worse. Grey: mean "
            "over all, with standard error."
        )
        shown = html.figure(drawn["gain.svg"], caption)
    facts = {"log evidence gained": f"{number_text(gain.log_evidence, 1)} nats"} if changes else {}
    facts["rms of the residuals"] = _rms_in_words(diagnosis)
    facts["test for further missing effects"] = typeset_numbers(p_in_words(gain.p_value_after))
    return shown, facts


def _noise_elements(diagnosis: Diagnosis, drawn: Mapping[str, bytes]) -> Sequence[str]:
    noise = diagnosis.noise
    names = [] if noise.model == "white" else noise.model.split("+")
    model = join_names([effect_in_words(name) for name in names]) if names else "white: independent, with one sd"
    test = f"Noise model: {model}. Test of the residuals against it: {p_in_words(noise.p_value)}."
    rows = [
        (p.name.replace("_", " "), unit_after_number(p.unit), *_value_and_interval_texts(p)) for p in noise.parameters
    ]
    caption = (
        f"Residuals after the repair, if any. Above: autocorrelation within {diagnosis.apparatus.words.run}s. "
        f"Middle: scatter by predicted reading. Below: histogram on a logarithmic scale."
    )
    found = (html.table(("parameter", "unit", "value", "95 % interval"), rows),) if rows else ()
    return (typeset_numbers(test), *found, html.figure(drawn["noise.svg"], caption))


def _effect_table(effects: Sequence[EffectFound]) -> html.Markup:
    rows = []
    for effect in effects:
        named, own = effect_in_words(effect.name), name_without_copy_suffix(effect.name)  # in diagnosis.json
        said = (
            f"{named} ({own})" if named != own else own,
            probability_text(effect.probability),
            number_text(effect.size_lambda, 1),
        )
        for p in effect.parameters:
            values = (", ".join(effect.scans), "") if p.name == "scans" else _value_and_interval_texts(p, unit=True)
            rows.append((*said, parameter_in_words(effect.name, p.name, p.unit), *values))
            said = ("", "", "")
    return html.table(("effect", "probability", "size λ", "parameter", "value", "95 % interval"), rows)


def _value_and_interval_texts(found: ParameterFound, *, unit: bool = False) -> tuple[str, str]:
    low, high = found.interval95
    written = value_with_sd(found.mean, found.sd, found.unit if unit else "")
    return typeset_numbers(written), typeset_numbers(range_text(low, high))


def _alias_elements(diagnosis: Diagnosis) -> Sequence[str]:
    """List the aliased pairs, those with effects of the credible set first; all but the first eight are folded away."""
    credible = {name for label in diagnosis.credible for name in label.split("+")}
    ranked = sorted(diagnosis.aliases, key=lambda a: (-len(credible & set(a.effects)), -a.cosine))
    if not ranked:
        return ("None: these readings tell apart all effects of the vocabulary that they can detect.",)
    first, rest = ranked[:_MOST_ALIASES], ranked[_MOST_ALIASES:]
    said = "While they are small, the effects of a pair change these readings alike; larger ones may differ, as the "
    said += "probabilities above say."
    if diagnosis.is_settled:
        said = f"This diagnosis is settled: no pair of these leaves it open. {said}"
        return (said, html.details(f"{count_with_noun(len(ranked), 'pair')}", _alias_table(ranked)))
    folded = (html.details(f"{len(rest)} more pairs", _alias_table(rest)),) if rest else ()
    return (said, _alias_table(first), *folded)


def _alias_table(aliases: Sequence[Alias]) -> html.Markup:
    rows = (
        (
            " and ".join(map(effect_in_words, a.effects)),
            number_text(a.cosine, 3),
            typeset_numbers(a.settle_by),
            f"{a.readings or '–'}{' or more' * (a.readings >= MOST_ADVISED_READINGS)}",
        )
        for a in aliases
    )
    return html.table(("aliased in these readings", "cosine", "what would separate them", "readings needed"), rows)


def _as_sentence(diagnosis: Diagnosis, text: str) -> str:
    return typeset_numbers(f"{diagnosis.apparatus.words.as_sentence(text).rstrip('.')}.")


def _place_caption(diagnosis: Diagnosis, place: Place, *, seen: bool = True) -> str:
    """Return a place's caption: where residuals are significant, p-value, and, if not `seen`, why no mean shows it."""
    run = diagnosis.apparatus.words.run
    covariate, unit = covariate_in_words_and_unit(diagnosis, place.covariate)
    if place.covariate == run:
        what = f"{run} {place.scan}"
    elif place.start is None or place.end is None:
        what = covariate
    elif names := category_name_by_value(diagnosis, place):
        what = ", ".join([covariate, *(name for v, name in names.items() if place.start <= v <= place.end)])
    else:
        scale = 0.0 if place.values is None else float(np.nanmax(place.values) - np.nanmin(place.values))
        what = f"{covariate}, {range_text(place.start, place.end, scale)} {unit_after_number(unit)}".rstrip()
    if place.scan and place.covariate != run:
        what += f", {run} {place.scan}"
    chance = "" if place.p_value < ALARM else ", possibly chance"
    hidden = "" if seen else " No mean leaves the band: residuals that change sign, or only scatter, average to zero."
    return typeset_numbers(f"Significant residuals: {what} ({p_in_words(place.p_value)}{chance}).{hidden}")


def output_of(
    value: Diagnosis, *, seed: int | None = None, rng: np.random.Generator | None = None, source: str = ""
) -> Output:
    """Return the files of a diagnosis: diagnosis.json, both models, the next readings; its figures and page.

    `rng` draws the samples in the sensors' files (default: by the seed); `source` names the recordings (default: the
    recording's own name).
    """
    source = source or value.recording.source or "the readings"
    rng = rng or generators_of_diagnosis(DEFAULT_SEED if seed is None else seed)[2]

    def write_files(stage: StagedFiles) -> None:
        stage.write_json("diagnosis.json", diagnosis_json(value))
        plan = None if value.next_measurement is None else value.next_measurement.plan
        if isinstance(value.recording.plan, RunTable):
            write_fitted_system(repaired_of(value), stage / "repaired.json")
            write_fitted_system(calibrated_of(value), stage / "calibrated.json")
        else:
            write_sensor(value.repaired.fitted_sensor(value.recording, rng=rng), stage / "sensor.json")
            write_sensor(value.null.fitted_sensor(value.recording, rng=rng), stage / "calibrated.json")
        if isinstance(plan, RunTable):
            stage.write(value.apparatus.words.next_plan, run_table_csv(plan))
        elif plan is not None:
            write_plan(plan, stage / NEXT_PLAN)

    page = partial(page_html, value, source=source, seed=seed)
    return Output(write_files, figure_drawers(value), page, main="diagnosis.json")
