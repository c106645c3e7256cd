"""The verdict in twenty words at most, for somebody who is not of the field."""

from __future__ import annotations

import numpy as np

from probewise.diagnosis import ALARM, Diagnosis
from probewise.report.covariate import covariate_words
from probewise.report.effect_words import effect_in_words, hypothesis_in_words, listed
from probewise.report.words import count

__all__ = ["MOST_WORDS", "headline"]

MOST_WORDS = 20
_SURE = 0.5


def headline(diagnosis: Diagnosis) -> str:
    """Say the verdict: the first of what could be said, the fullest first, that is short enough."""
    return next(said for said in _sayings(diagnosis) if len(said.split()) <= MOST_WORDS)


def _sayings(diagnosis: Diagnosis) -> list[str]:
    """List what could be said, the fullest first; the last is short whatever the diagnosis holds."""
    n = int(diagnosis.recording.usable.sum())
    if diagnosis.few:
        return [_too_little(diagnosis, n)]
    match diagnosis.verdict:
        case "clean" if diagnosis.p_value < ALARM:
            return ["These readings look unusual, but nothing that was tried explains them better than the model."]
        case "clean":
            return [f"Nothing is missing: the model explains all {n} readings to within their noise."]
        case "unknown":
            return _unknown(diagnosis)
        case "cannot_tell":
            return _undecided(diagnosis)
        case "noise":
            return _left_out(diagnosis, "The predicted mean is right, but the noise model leaves out")
        case "named":
            more = ["Something more is missing."] if diagnosis.improvement.p_value_after < ALARM else []
            said = _left_out(diagnosis, "The model leaves out")
            return [" ".join([one, *more]) for one in said] + said


def _too_little(diagnosis: Diagnosis, n: int) -> str:
    seen = diagnosis.recording.readings[diagnosis.recording.usable]
    if n > 1 and float(np.ptp(seen)) == 0.0:
        return f"All {n} readings are equal: there is no signal to diagnose."
    return f"{count(n, 'reading').capitalize()} {'is' if n == 1 else 'are'} too few for a diagnosis."


def _left_out(diagnosis: Diagnosis, opening: str) -> list[str]:
    sizes = {effect.name: effect.size_lambda for effect in diagnosis.effects}
    names = [effect_in_words(name) for name in sorted(diagnosis.combination, key=lambda k: -sizes.get(k, 0.0))]
    if len(names) == 1:
        return [f"{opening} {names[0]}.", f"{opening} one effect."]
    return [
        f"{opening} {listed(names)}.",
        f"{opening} {len(names)} effects, the largest of them {names[0]}.",
        f"{opening} {len(names)} effects.",
    ]


def _unknown(diagnosis: Diagnosis) -> list[str]:
    shares = diagnosis.unknown_shares
    top = max(shares, key=lambda k: shares[k], default="")
    family, _, kind = top.partition(", ")
    covariate = covariate_words(family.removesuffix(" within scans"))
    known = [effect_in_words(e.name) for e in diagnosis.effects if e.probability >= _SURE]
    beside = f"Beside {listed(known)}, something" if known else "Something"
    plain = f"{beside} is missing that no known effect explains"
    said = [f"{plain}.", "Something is missing that no known effect explains."]
    if kind == "far out":
        return [f"Outlying readings lie together by {covariate}: something without a name is missing there.", *said]
    if (top and family == effect_in_words(family)) or not top:
        return [f"{plain}; it shows most along the {covariate}.", *said] if top else said
    return [f"{plain}; it looks most like {effect_in_words(family)}.", *said]


def _undecided(diagnosis: Diagnosis) -> list[str]:
    first, *others = diagnosis.hypotheses
    rivals = [hypothesis_in_words(h.effects) for h in (first, *others[:1])]
    if diagnosis.p_value >= ALARM:
        leading = next((h.effects for h in diagnosis.hypotheses if h.effects), ())
        plain = "These readings cannot tell whether anything is missing"
        return [f"{plain}; if so, most likely {hypothesis_in_words(leading)}.", f"{plain}."]
    if len(rivals) < 2 or (first.probability >= _SURE and not diagnosis.aliases):
        return [
            f"Something is missing; {rivals[0]} fits best but does not predict new readings.",
            "Something is missing, but these readings cannot tell what.",
        ]
    return [
        f"Something is missing, but these readings cannot tell {rivals[0]} from {rivals[1]}.",
        "Something is missing, but these readings cannot tell what.",
    ]
