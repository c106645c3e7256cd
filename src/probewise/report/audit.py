"""The page of an audit: what a plan sees before any data, what it cannot tell apart, what would cure that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from probewise.diagnosis import PlanAudit
from probewise.diagnosis.audit.detectability import ALIAS, LAMBDA, LEAST_NATS
from probewise.effects import spoken_name
from probewise.report.audit_table import audit_table
from probewise.report.html import Markup, Section, definition_list, figure, fragment, page, paragraph, table
from probewise.report.plots import AxesGrid, audit_matrix, png
from probewise.report.terms import explained, terms_of
from probewise.report.words import count, number, readable

__all__ = ["answer", "figures", "picture", "write_page"]

_CURED_BY = "The fewest readings that would cure it"


def answer(audit: PlanAudit) -> str:
    """Say in twenty words at most what the plan can do, and what it takes to cure the rest."""
    n_fine, n_aliased = len(audit.seen_as("fine")), len(audit.seen_as("aliased"))
    of = f"{n_fine} of {len(audit.effects)} effects"
    said = f"This plan can identify {of}; {n_aliased} are aliased, {len(audit.seen_as('invisible'))} undetectable."
    if not audit.cures:
        return said
    cured = len(audit.seen_as("fine", after=True)) - n_fine
    return f"{said} {count(audit.extra_readings, 'more reading')} would cure {cured}."


def figures(audit: PlanAudit) -> dict[str, bytes]:
    """Draw the figure of an audit: PNG by file name."""
    return {"audit.png": png(picture(audit))}


def picture(audit: PlanAudit) -> AxesGrid:
    """Draw what the plan sees of every effect, and what it cannot tell apart."""
    names, sights = [e.name for e in audit.effects], [e.detectability for e in audit.effects]
    return audit_matrix(names, sights, audit.cosines, alias=ALIAS)


def write_page(audit: PlanAudit, drawn: Mapping[str, bytes], *, source: str) -> str:
    """Write the whole page."""
    shown = figure(
        drawn["audit.png"],
        "Left: of what each effect changes in the readings, the share that "
        f"{audit.words.null}'s own parameters cannot absorb. "
        "Right, read along a row: the effect of the row is there, at a typical setting; the cosine says how well the "
        "effect of the column, at the setting that suits it best, would pass for it. So it matters which of the two is "
        "there: an effect with many settings passes for a plain one, but not the other way round. A circle marks an "
        f"alias: at size λ = {LAMBDA:g} these readings tell the row from the column by less than {LEAST_NATS:g} nats.",
    )
    sections = [
        Section("Not told apart", _classes(audit)) if audit.classes is not None else Section(_CURED_BY, _cures(audit)),
        Section("Every effect", (audit_table(audit.effects, audit.words.null),)),
        Section(
            "What was assumed",
            (
                definition_list(
                    (
                        ("plan", source),
                        ("readings", f"{len(audit.plan)} in {count(len(audit.plan.scan_names), audit.words.run)}"),
                        (audit.words.null.removeprefix("the "), audit.assumed),
                        ("can be set", ", ".join(audit.plan.instrumentation.controls) or "nothing"),
                    )
                ),
            ),
        ),
    ]
    known: set[str] = set()
    return page(
        f"Audit of {source}",
        answer=answer(audit),
        key_figure=fragment(shown, *terms_of(f"{answer(audit)} {shown}", known)),
        sections=explained(sections, known),
    )


def _classes(audit: PlanAudit) -> tuple[Markup, ...]:
    if not audit.classes:
        return (paragraph("Every effect that these rows show changes the readings in a way of its own."),)
    opening = "Effects that are taken for each other, directly or by way of others:"
    rows = ((str(k), ", ".join(map(spoken_name, names))) for k, names in enumerate(audit.classes, start=1))
    return (paragraph(opening), table(("class", "effects"), rows))


def _cures(audit: PlanAudit) -> tuple[Markup, ...]:
    plan = audit.cure_plan
    if plan is None:
        if all(effect.detectability == "fine" for effect in audit.effects):
            return (paragraph("None are needed: every effect can be identified."),)
        return (
            paragraph(
                "No scan that this arm can take, repeated, reversed, faster or turned, nor the sheet laid otherwise, "
                "would help enough."
            ),
        )
    left = [spoken_name(e.name) for e in audit.after if e.detectability != "fine"]
    return (
        table(
            ("step", "what to do", "readings", "effects that can then be identified"),
            (
                (
                    str(k),
                    readable(cure.description),
                    str(len(cure.plan)),
                    ", ".join(map(spoken_name, cure.cured)) or "–",
                )
                for k, cure in enumerate(audit.cures, start=1)
            ),
        ),
        paragraph(
            f"{count(len(plan), 'reading')}, about {number(audit.extra_minutes, 0)} minutes; "
            f"the plan is in cure_plan.csv. Still not identified: {', '.join(left) or 'nothing'}."
        ),
    )


def _names(effects: Sequence[str]) -> str:
    return ", ".join(map(spoken_name, effects)) or "–"
