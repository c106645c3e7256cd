"""The page of an audit: which effects a plan can detect and tell apart, and which readings would help."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from probewise._words import count_with_noun
from probewise.diagnosis import PlanAudit
from probewise.diagnosis.aliases import LAMBDA
from probewise.diagnosis.audit import ALIAS, LEAST_NATS
from probewise.effects import spoken_name
from probewise.report.audit_table import audit_table
from probewise.report.html import Markup, Section, definition_list, figure, fragment, page, paragraph, table
from probewise.report.plots.canvas import AxesGrid, png
from probewise.report.plots.probabilities import audit_matrix
from probewise.report.terms import explain_new_terms, sections_with_terms_explained
from probewise.report.words import number_text, typeset_numbers

_CURED_BY = "The fewest extra readings that would help"


def summary_sentence(audit: PlanAudit) -> str:
    """Count in at most twenty words the fine, aliased and invisible effects, and those that more readings make fine."""
    n_fine, n_aliased = len(audit.effects_with_detectability("fine")), len(audit.effects_with_detectability("aliased"))
    n_invisible = len(audit.effects_with_detectability("invisible"))
    said = (
        f"This plan is fine for {n_fine} of {len(audit.effects)} effects; {n_aliased} aliased, {n_invisible} invisible."
    )
    if not audit.cures:
        return said
    cured = len(audit.effects_with_detectability("fine", after=True)) - n_fine
    return f"{said} {count_with_noun(audit.extra_readings, 'more reading')} make {cured} more fine."


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
        f"alias: at size λ = {LAMBDA:g} these readings favour the row over the column by less than {LEAST_NATS:g} "
        "nats.",
    )
    sections = [
        Section("Effects that cannot be told apart", _alias_class_elements(audit))
        if audit.classes is not None
        else Section(_CURED_BY, _extra_readings_elements(audit)),
        Section("Every effect", (audit_table(audit.effects, audit.words.null),)),
        Section(
            "What was assumed",
            (
                definition_list(
                    (
                        ("plan", source),
                        (
                            "readings",
                            f"{len(audit.plan)} in {count_with_noun(len(audit.plan.scan_names), audit.words.run)}",
                        ),
                        (audit.words.null.removeprefix("the "), audit.assumed),
                        ("controls of the instrument", ", ".join(audit.plan.instrumentation.controls) or "nothing"),
                    )
                ),
            ),
        ),
    ]
    known: set[str] = set()
    return page(
        f"Audit of {source}",
        answer=summary_sentence(audit),
        key_figure=fragment(shown, *explain_new_terms(f"{summary_sentence(audit)} {shown}", known)),
        sections=sections_with_terms_explained(sections, known),
    )


def _alias_class_elements(audit: PlanAudit) -> tuple[Markup, ...]:
    if not audit.classes:
        return (paragraph("These rows tell apart all effects that they can detect."),)
    opening = "Classes of aliased effects, directly or through others in the class:"
    rows = ((str(k), ", ".join(map(spoken_name, names))) for k, names in enumerate(audit.classes, start=1))
    return (paragraph(opening), table(("class", "effects"), rows))


def _extra_readings_elements(audit: PlanAudit) -> tuple[Markup, ...]:
    plan = audit.cure_plan
    if plan is None:
        if all(effect.detectability == "fine" for effect in audit.effects):
            return (paragraph("None are needed: this plan is fine for every effect."),)
        return (
            paragraph(
                "No scan that this arm can take (repeated, reversed, faster or turned) and no other position of the "
                "sheet would help enough."
            ),
        )
    left = [spoken_name(e.name) for e in audit.after if e.detectability != "fine"]
    return (
        table(
            ("step", "what to do", "readings", "effects that are then fine"),
            (
                (
                    str(k),
                    typeset_numbers(cure.description),
                    str(len(cure.plan)),
                    ", ".join(map(spoken_name, cure.cured)) or "–",
                )
                for k, cure in enumerate(audit.cures, start=1)
            ),
        ),
        paragraph(
            f"{count_with_noun(len(plan), 'reading')}, about {number_text(audit.extra_minutes, 0)} minutes; "
            f"the plan is in cure_plan.csv. Still aliased or invisible: {', '.join(left) or 'nothing'}."
        ),
    )
