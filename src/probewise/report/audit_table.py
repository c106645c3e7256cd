"""The table of an audit, which the page of a diagnosis shows too."""

from __future__ import annotations

from collections.abc import Sequence

from probewise.diagnosis import EffectAudit
from probewise.effects import spoken_name
from probewise.report.html import Markup, table
from probewise.report.words import number, unit_name

__all__ = ["audit_table"]


def audit_table(effects: Sequence[EffectAudit], of: str = "the sensor") -> Markup:
    """Build the table of all effects: how each is seen, what it is taken for, the size at which it shows.

    `of` is what has parameters of its own. Rows that would show an effect have a column where they were counted.
    """
    counted = any(effect.rows is not None for effect in effects)
    rank = ("invisible", "aliased", "fine")
    return table(
        ("effect", "status", "detectable share", "aliased with (cosine)", "size at λ = 8", *["rows"] * counted),
        (
            (
                spoken_name(effect.name),
                effect.detectability,
                number(effect.share, 2),
                effect.reason or ", ".join(f"{spoken_name(n)} {c:.3f}" for n, c in effect.alike[:4]) or "–",
                "; ".join(_smallest(s.parameter, s.unit, s.amount) for s in effect.smallest) or "–",
                *["–" if effect.rows is None else str(effect.rows)] * counted,
            )
            for effect in sorted(effects, key=lambda e: rank.index(e.detectability))
        ),
        caption="Status: fine (can be identified), aliased, or invisible (cannot be detected). Detectable share: of "
        f"what it changes in the readings, the share that {of}'s own parameters do not absorb."
        + (" Rows: so many like these show it where it changes readings by one noise sd rms." if counted else ""),
    )


def _smallest(parameter: str, unit: str, amount: float | None) -> str:
    name = "" if parameter == unit else parameter.removesuffix(f"_{unit}").replace("_", " ")
    value = "at no size" if amount is None else f"{amount:.2g} {'' if unit == '1' else unit_name(unit)}"
    return f"{name} {value}".strip()
