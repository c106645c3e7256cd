"""The verdict in one sentence."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from probewise.diagnosis.advice.next_scans import NextMeasurement
from probewise.diagnosis.residuals.locate import ALARM, Place
from probewise.diagnosis.residuals.outlying import FAR_OUT
from probewise.diagnosis.search.weighed_fit import Search
from probewise.diagnosis.verdict_report.verdict import EffectFound, Hypothesis, Verdict
from probewise.diagnosis.verdict_report.words import p_in_words

__all__ = ["reason_of"]

Names = tuple[str, ...]


def reason_of(
    search: Search,
    verdict: Verdict,
    combination: Names,
    hypotheses: tuple[Hypothesis, ...],
    effects: tuple[EffectFound, ...],
    p_value: float,
    p_value_after: float,
    fails: bool,
    few: bool,
    asked: NextMeasurement | None,
    where: Sequence[Place],
    noise: Names,
    candidates: Sequence[str],
    least_readings: int,
) -> str:
    """Say in one sentence what the verdict is and why.

    Parameters
    ----------
    search
        What was weighed.
    verdict, combination, hypotheses, effects, p_value, where
        As the diagnosis has them.
    p_value_after
        That nothing is missing from the repaired model.
    fails
        Whether what leads predicts readings kept back far worse than the plain sensor does.
    few
        Whether there are too few readings to say anything.
    asked
        The readings to take next.
    noise
        The most probable noise model.
    candidates
        What is unknown may be this: sentences.
    least_readings
        Fewest readings that a verdict is given on.
    """
    n, p = int(search.recording.usable.sum()), p_in_words(p_value)
    if few and n >= least_readings:
        return f"All {n} usable readings are equal: there is no signal to diagnose; scan across an edge."
    if few:
        has = "1 usable reading is" if n == 1 else f"{n} usable readings are"
        return f"{has} too few to tell; {least_readings} or more are needed."
    by_name = {effect.name: effect for effect in effects}
    if verdict == "clean":
        order = max(search.order_probabilities, key=lambda k: search.order_probabilities[k])
        form = search.sensors[order].form
        ssf = f", {form}," if form else ""
        rare = ", which is rare; nothing that was tried explains them better" if p_value < ALARM else ""
        return f"The model{ssf} explains all {n} readings to within their noise ({p}{rare})."
    if verdict == "unknown":
        if candidates:
            like = "; ".join(candidates)
            return f"Something is missing ({p}) that has no name; it is most like this: {like}."
        family = max(search.unknown_shares, key=lambda k: search.unknown_shares[k], default="")
        if family.endswith(FAR_OUT):
            covariate = family.removesuffix(FAR_OUT).replace("_", " ")
            tail = f"to a test of the mean they are noise with a heavy tail, {p}"
            together = f"The readings that are far out lie together in {covariate}"
            return f"{together}: something is missing there, not noise ({tail})."
        likeliest = family.partition(",")[0].removesuffix(" within scans")
        shown = [place.covariate for place in where]
        most = likeliest if likeliest in shown else next(iter(shown), "")
        place = f" It shows most in {most.replace('_', ' ')}." if most else ""
        found = search.beside(noise)
        known = " and ".join(name.replace("_", " ") for name in found.names) if found else ""
        beside = f", beside {known}" if known else ""
        return f"Something is missing ({p}) that no named effect explains{beside}.{place}"
    if fails:
        return (
            f"Something is missing ({p}); {hypotheses[0].label} explains these readings best, and "
            "predicts those kept back far worse than the sensor without it."
        )
    if verdict == "cannot_tell":
        leading = ", ".join(f"{h.label} {h.probability:.2f}" for h in itertools.islice(hypotheses, 3))
        cure = "" if asked is None else f"; to tell: {asked.description}"
        return f"These {n} readings do not tell apart {leading}{cure}."
    said = "; ".join(by_name[name].sentence for name in combination if name in by_name)
    if verdict == "noise":
        return f"{said[0].upper()}{said[1:]}; nothing is missing from the mean ({p})."
    more = f" Something more is missing: after the repair {p_in_words(p_value_after)}." if p_value_after < ALARM else ""
    return f"{said[0].upper()}{said[1:]} ({p}).{more}"
