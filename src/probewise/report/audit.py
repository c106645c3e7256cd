"""The page of an audit: which effects a plan can detect and tell apart, and which readings would help."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from probewise._words import count_with_noun, unit_after_number
from probewise._writing import Output, StagedFiles
from probewise.diagnosis import CURE_PLAN, EffectAudit, PlanAudit, audit_json
from probewise.diagnosis.advice import LAMBDA
from probewise.diagnosis.apparatus import ENOUGH_NATS
from probewise.diagnosis.audit import ALIAS
from probewise.diagnosis.words import parameter_in_words
from probewise.effects import spoken_name
from probewise.recordings import write_plan
from probewise.report.html import Markup, Section, figure, page, table
from probewise.report.plots.canvas import AxesGrid, png
from probewise.report.plots.probabilities import audit_matrix
from probewise.report.words import number_text, typeset_numbers


def summary_sentence(audit: PlanAudit) -> str:
    """Count in at most twenty words the fine, aliased and invisible effects, and those that more readings make fine."""
    n_fine, n_aliased, n_invisible = (
        len(audit.effects_with_detectability(kind)) for kind in ("fine", "aliased", "invisible")
    )
    counts = f"fine for {n_fine} of {len(audit.effects)} effects; {n_aliased} aliased, {n_invisible} invisible"
    if not audit.cures:
        return f"This plan is {counts}."
    cured = len(audit.effects_with_detectability("fine", after=True)) - n_fine
    return f"This plan is {counts}. {count_with_noun(audit.extra_readings, 'more reading')} make {cured} more fine."


def figure_drawers(audit: PlanAudit) -> dict[str, Callable[[], bytes]]:
    """Return the function that draws an audit's figure, a PNG, by file name."""
    return {"audit.png": lambda: png(draw_detectability_and_aliases(audit))}


def draw_detectability_and_aliases(audit: PlanAudit) -> AxesGrid:
    """Draw the detectability of every effect, and which effects are aliased; return the two axes, (1, 2)."""
    names, detectability = [e.name for e in audit.effects], [e.detectability for e in audit.effects]
    return audit_matrix(names, detectability, audit.cosines, alias=ALIAS)


def page_html(audit: PlanAudit, drawn: Mapping[str, bytes], *, source: str) -> str:
    """Return the HTML of an audit's page; `drawn` is from `figure_drawers`, `source` the plan's name."""
    shown = figure(
        drawn["audit.png"],
        "Fine: these readings detect the effect and tell it from every other. Aliased: they detect it, but another "
        "effect can imitate it. Invisible: they cannot detect it. "
        "Left: share of each effect's change in the readings that "
        f"{audit.words.null}'s own parameters cannot absorb. "
        "Right: the effect of the row is present, at typical parameters; the cosine measures how well the effect of "
        "the column imitates it, at the parameters that suit it best. The matrix is not symmetric: an effect with many "
        "parameters can imitate a simple one, but not the other way round. A circle marks an "
        f"alias: at size λ = {LAMBDA:g} these readings favour the row over the column by less than {ENOUGH_NATS:g} "
        "nats.",
    )
    assumed = {
        "plan": source,
        "readings": f"{len(audit.plan)} in {count_with_noun(len(audit.plan.scan_names), audit.words.run)}",
        audit.words.null.removeprefix("the "): audit.assumed,
        "controls of the instrument": ", ".join(audit.plan.instrumentation.controls) or "nothing",
    }
    every = Section("Every effect", (audit_table(audit.effects, audit.words.null),))
    return page(
        f"Audit of {source}",
        answer=summary_sentence(audit),
        key_figure=shown,
        sections=[_help_section(audit), every, Section("What was assumed", (assumed,))],
        with_terms=True,
    )


def _help_section(audit: PlanAudit) -> Section:
    """List the aliased effects of rows that nobody plans, else the fewest extra readings that would help."""
    if audit.classes is not None:
        said: tuple[str, ...] = ("These rows tell apart all effects that they can detect.",)
        if audit.classes:
            rows = ((str(k), ", ".join(map(spoken_name, names))) for k, names in enumerate(audit.classes, start=1))
            opening = "Classes of aliased effects, directly or through others in the class:"
            said = (opening, table(("class", "effects"), rows))
        return Section("Effects that cannot be told apart", said)
    plan, title = audit.cure_plan, "The fewest extra readings that would help"
    if plan is None and all(effect.detectability == "fine" for effect in audit.effects):
        return Section(title, ("None are needed: this plan is fine for every effect.",))
    if plan is None:
        nothing = (
            "No scan that this arm can take (repeated, reversed, faster or turned) and no other position of the "
            "sheet would help enough."
        )
        return Section(title, (nothing,))
    left = [spoken_name(e.name) for e in audit.after if e.detectability != "fine"]
    steps = (
        (str(k), typeset_numbers(cure.description), str(len(cure.plan)), ", ".join(map(spoken_name, cure.cured)) or "–")
        for k, cure in enumerate(audit.cures, start=1)
    )
    summed = (
        f"{count_with_noun(len(plan), 'reading')}, about {number_text(audit.extra_minutes, 0)} minutes; "
        f"the plan is in cure_plan.csv. Still aliased or invisible: {', '.join(left) or 'nothing'}."
    )
    return Section(title, (table(("step", "what to do", "readings", "effects that are then fine"), steps), summed))


def audit_table(effects: Sequence[EffectAudit], of: str = "the sensor") -> Markup:
    """Build the table of all effects, invisible ones first: detectability, detectable share, aliases, size at lambda 8.

    `of` names the model whose own parameters absorb part of an effect. A column more gives the number of rows that
    detect it, where it was computed.
    """
    counted = any(effect.rows is not None for effect in effects)
    rank = ("invisible", "aliased", "fine")
    return table(
        ("effect", "detectability", "detectable share", "aliased with (cosine)", "size at λ = 8", *["rows"] * counted),
        (
            (
                spoken_name(effect.name),
                effect.detectability,
                number_text(effect.share, 2),
                effect.reason or ", ".join(f"{spoken_name(n)} {c:.3f}" for n, c in effect.alike[:4]) or "–",
                _detectable_sizes_in_words(effect),
                *["–" if effect.rows is None else str(effect.rows)] * counted,
            )
            for effect in sorted(effects, key=lambda e: rank.index(e.detectability))
        ),
        caption="Detectability: fine (these readings detect the effect and tell it from every other), aliased (they "
        "detect it, but the named effect can imitate it, to the cosine given; the reverse need not hold), or invisible "
        f"(they cannot detect it). Detectable share: share of the effect's change in the readings that {of}'s own "
        "parameters do not absorb. Size at λ = 8: value of each parameter at which the effect reaches eight noise sds; "
        "– where no parameter scales the effect."
        + (
            " Rows: how many rows like these detect the effect when it changes the readings by one noise sd (rms)."
            if counted
            else ""
        ),
    )


def _detectable_sizes_in_words(effect: EffectAudit) -> str:
    """Write the value at lambda 8 ("at no size" for None) of each parameter that scales an effect."""
    said = []
    for size in effect.smallest:
        value = "at no size" if size.amount is None else f"{size.amount:.2g} {unit_after_number(size.unit)}".rstrip()
        said.append(f"{parameter_in_words(effect.name, size.parameter, size.unit)} {value}")
    return "; ".join(said) or "–"


def output_of(value: PlanAudit, *, seed: int | None = None, source: str = "the plan") -> Output:
    """Return the files of an audit, which has no seed: audit.json and the plan that would help; figure and page."""

    def write_files(stage: StagedFiles) -> None:
        stage.write_json("audit.json", audit_json(value))
        if value.cure_plan is not None:
            write_plan(value.cure_plan, stage / CURE_PLAN)

    page = partial(page_html, value, source=source)
    return Output(write_files, figure_drawers(value), page, main="audit.json")
