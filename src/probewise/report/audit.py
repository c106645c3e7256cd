"""The page of an audit: what a plan sees before any data, what it cannot tell apart, what would cure that."""

from __future__ import annotations

from collections.abc import Mapping

from probewise.diagnosis import PlanAudit
from probewise.diagnosis.audit.sights import ALIAS
from probewise.report.audit_table import audit_table
from probewise.report.html import Markup, Section, definition_list, figure, page, paragraph, table
from probewise.report.plots import audit_matrix, png
from probewise.report.words import count, number

__all__ = ["answer", "figures", "write_page"]


def answer(audit: PlanAudit) -> str:
    """Say in one sentence what the plan can do, and what it takes to cure the rest."""
    n = len(audit.effects)
    said = (
        f"Of {n} things that may be wrong this plan sees and tells apart {len(audit.seen_as('fine'))}; "
        f"{len(audit.seen_as('aliased'))} it takes for another, {len(audit.seen_as('invisible'))} it cannot see"
    )
    if audit.cures:
        more = len(audit.seen_as("fine", after=True)) - len(audit.seen_as("fine"))
        said += f". {count(audit.extra_readings, 'more reading')} would cure {more}"
    return said + "."


def figures(audit: PlanAudit) -> dict[str, bytes]:
    """Draw the figure of an audit: PNG by file name."""
    names, sights = [e.name for e in audit.effects], [e.sight for e in audit.effects]
    return {"audit.png": png(audit_matrix(names, sights, audit.cosines, alias=ALIAS))}


def write_page(audit: PlanAudit, drawn: Mapping[str, bytes], *, source: str) -> str:
    """Write the whole page."""
    return page(
        f"Audit of {source}",
        answer=answer(audit),
        key_figure=figure(
            drawn["audit.png"],
            "Left: how much of each effect's trace is left when the sensor's own parameters have taken what they can. "
            "Right: how well each effect (row) is imitated by each other (column).",
        ),
        sections=[
            Section("The fewest readings that would cure it", _cures(audit)),
            Section("Every effect", (audit_table(audit.effects),)),
            Section(
                "What was assumed",
                (
                    definition_list(
                        (
                            ("plan", source),
                            ("readings", f"{len(audit.plan)} in {count(len(audit.plan.scan_names), 'scan')}"),
                            ("sensor", audit.assumed),
                            ("the arm can also command", ", ".join(audit.plan.instrumentation.controls) or "nothing"),
                        )
                    ),
                ),
            ),
        ],
    )


def _cures(audit: PlanAudit) -> tuple[Markup, ...]:
    plan = audit.cure_plan
    if plan is None:
        if all(effect.sight == "fine" for effect in audit.effects):
            return (paragraph("Nothing is to be cured."),)
        return (
            paragraph(
                "No scan that this arm can take, repeated, reversed, faster or turned, nor the sheet laid otherwise, "
                "would help enough."
            ),
        )
    left = [e.name.replace("_", " ") for e in audit.after if e.sight != "fine"]
    return (
        table(
            ("", "what to do", "readings", "then seen and told apart"),
            (
                (str(k), cure.description, str(len(cure.plan)), ", ".join(cure.cured).replace("_", " ") or "–")
                for k, cure in enumerate(audit.cures, start=1)
            ),
        ),
        paragraph(
            f"{count(len(plan), 'reading')}, about {number(audit.extra_minutes, 0)} minutes; "
            f"the plan is in cure_plan.csv. Left after that: {', '.join(left) or 'nothing'}."
        ),
    )
