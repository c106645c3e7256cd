"""audit.json: the result of `probewise audit` as strict JSON, format "audit/1"."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from probewise.diagnosis.audit.plan_audit import EffectAudit, PlanAudit

CURE_PLAN = "cure_plan.csv"


def audit_json(audit: PlanAudit) -> dict[str, Any]:
    """Convert an audit to the content of audit.json.

    The `amount` of a smallest size is null if no size is detectable, `cure` if there is none; `rows` and alias classes
    that were not computed are left out.
    """
    plan = audit.cure_plan
    return {
        "format": "audit/1",
        "readings": len(audit.plan),
        "assumed": audit.assumed,
        "effects": _effects_json(audit.effects),
        "cure": None
        if plan is None
        else {
            "plan": CURE_PLAN,
            "readings": len(plan),
            "minutes": audit.extra_minutes,
            "scans": [
                {
                    "kind": cure.kind,
                    "description": cure.description,
                    "scan": cure.plan.scan_names[0],
                    "readings": len(cure.plan),
                    "cures": list(cure.cured),
                }
                for cure in audit.cures
            ],
        },
        "after": _effects_json(audit.after),
        **({} if audit.classes is None else {"alias_classes": [list(names) for names in audit.classes]}),
    }


def _effects_json(effects: Sequence[EffectAudit]) -> list[dict[str, Any]]:
    return [
        {
            "name": effect.name,
            "sight": effect.detectability,
            "surviving_share": effect.share,
            "alike": [{"effect": name, "cosine": cosine} for name, cosine in effect.alike],
            "smallest": [{"parameter": s.parameter, "unit": s.unit, "amount": s.amount} for s in effect.smallest],
            "reason": effect.reason,
            **({} if effect.rows is None else {"rows": effect.rows}),
        }
        for effect in effects
    ]
