"""The table of an audit's effects, which the pages of an audit and of a diagnosis show."""

from __future__ import annotations

from collections.abc import Sequence

from probewise._words import unit_after_number
from probewise.diagnosis import EffectAudit
from probewise.effects import spoken_name
from probewise.report.html import Markup, table
from probewise.report.words import number_text

_SIZES = {
    "albedo": "change of albedo",
    "amp": "amplitude",
    "amp_mm": "amplitude",
    "deg": "turn",
    "dx_mm": "along X",
    "dy_mm": "along Y",
    "frac": "relative change",
    "mm": "height",
    "mm_per_mm": "slope",
    "offset_mm": "shift",
    "per_hour": "change",
    "per_mm_x": "along X",
    "per_mm_y": "along Y",
    "per_volt": "relative change",
    "width_mm": "play",
    "x": "along X",
    "y": "along Y",
}
"""Names in words of the parameters that scale an effect."""


def audit_table(effects: Sequence[EffectAudit], of: str = "the sensor") -> Markup:
    """Build the table of all effects, invisible ones first: detectability, detectable share, aliases, size at lambda 8.

    `of` names the model whose own parameters absorb part of an effect. Where an effect's `rows` were computed, a column
    more gives the number of rows like these that detect the effect at a change of the readings by one noise sd (rms).
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
                "; ".join(_detectable_size_in_words(s.parameter, s.unit, s.amount) for s in effect.smallest) or "–",
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


def _detectable_size_in_words(parameter: str, unit: str, amount: float | None) -> str:
    """Write a parameter's name, unless its unit tells, and its value (`amount`) at lambda 8; "at no size" for None."""
    name = _SIZES.get(parameter, "" if parameter == unit else parameter.removesuffix(f"_{unit}").replace("_", " "))
    value = "at no size" if amount is None else f"{amount:.2g} {_unit_in_words(unit)}"
    return f"{name} {value}".strip()


def _unit_in_words(unit: str) -> str:
    """Write "1/V" as "per V", as "1 per V" too, and "LEGO/h" as "LEGO units per h"; a user's own unit is kept."""
    if unit.startswith("1 per "):
        return unit.removeprefix("1 ")
    upper, _, lower = unit.partition("/")
    if upper not in ("1", "LEGO", "mm"):
        return unit_after_number(unit)
    own = "" if upper == "1" else unit_after_number(upper)
    return f"{own} per {lower}".strip() if lower else own
