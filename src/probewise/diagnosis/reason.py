"""The verdict and its reason in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from probewise.diagnosis.apparatus import SETTLED, Words
from probewise.diagnosis.locate import ALARM
from probewise.diagnosis.outlying import FAR_OUT
from probewise.diagnosis.prior_odds import Names
from probewise.diagnosis.unknown_bases import PRODUCTS
from probewise.diagnosis.verdict import Hypothesis, Judged
from probewise.diagnosis.words import effects_in_words, hypothesis_in_words, join_lists, join_names, p_in_words

TO_SEPARATE = "; to tell "
"""Introduces the next readings in the reason of `cannot_tell`."""
ALL = "them apart"
"""What they tell if they separate all hypotheses that the reason names."""
NOTHING_MORE = "nothing more"
"""The hypothesis of no effect beside those that are certain."""

NOTHING = "nothing missing"
"""The hypothesis of no effect at all."""

_OPEN = 0.05  # least probability of a rival: what has less is no open question


@dataclass(frozen=True)
class Grounds:
    """The facts, in addition to the verdict, for the sentence that gives its reason.

    `n_readings`, `least_readings`: usable readings, and the fewest for a verdict;
    `form`: description of the calibrated SSF, "" if there is none; `sentences`: sentence on each effect, by name;
    `like`: sentences on the effects that the unknown one resembles; `family`: the most probable family of bases of the
    unknown effect, such as "time"; `beside`: effects that act in addition to the unknown one; `shows_in`: names of the
    covariates in which effects and residuals are located, in the order of `Diagnosis.where`; `p_value_after`: p-value
    of the global test of the repaired model; `settles`: the readings that would separate the hypotheses that the
    sentence names, in words; "" if no such readings do, None if that is not known; `apart`: which of these hypotheses
    they separate, in words; `nuisances`: sentences on the noise that was found beside what has a name in the
    vocabulary.
    """

    words: Words
    n_readings: int
    least_readings: int
    form: str = ""
    sentences: Mapping[str, str] = field(default_factory=dict)
    like: tuple[str, ...] = ()
    family: str = ""
    beside: tuple[str, ...] = ()
    shows_in: tuple[str, ...] = ()
    p_value_after: float = 1.0
    settles: str | None = None
    apart: str = ALL
    nuisances: tuple[str, ...] = ()


def reason_of(judged: Judged, grounds: Grounds) -> str:
    """Return the verdict and its reason, in one sentence or two."""
    n, p = grounds.n_readings, p_in_words(judged.p_value)
    if judged.too_little and n >= grounds.least_readings:
        return f"All {n} usable readings are equal: there is no signal to diagnose; {grounds.words.find_signal}."
    if judged.too_little:
        has = "1 usable reading is" if n == 1 else f"{n} usable readings are"
        return f"{has} too few for a diagnosis; {grounds.least_readings} or more are needed."
    if judged.withdrawn:
        leader = hypothesis_in_words(judged.hypotheses[0].effects)
        worse = f"predicts held-out readings far worse than {grounds.words.null} without it"
        return f"Something is missing ({p}); {leader} fits these readings best, but {worse}."
    if judged.verdict == "clean":
        form = f", {grounds.form}," if grounds.form else ""
        rare = ", which is rare; nothing that was tried explains them better" if judged.p_value < ALARM else ""
        return f"The model{form} explains all {n} readings to within their noise ({p}{rare})."
    say = {
        "unknown": _unknown_sentence,
        "cannot_tell": _cannot_tell_sentence,
        "noise": _noise_sentence,
        "named": _named_sentence,
    }
    return say[judged.verdict](judged, grounds)


def combinations_in_reason(judged: Judged) -> list[Names]:
    """Return the effects of the hypotheses that the reason of `cannot_tell` names."""
    if judged.shared:
        return [tuple(sorted({*judged.shared, *h.effects})) for h in _rivals_to_name(judged.beside_shared)]
    return [h.effects for h in _rivals_to_name(judged.hypotheses)]


def _unknown_sentence(judged: Judged, grounds: Grounds) -> str:
    p = p_in_words(judged.p_value)
    if judged.p_value > ALARM and not grounds.family.endswith(FAR_OUT):
        p = f"probability {judged.unknown_probability:.2f}, though a test of the mean alone has {p}"
    if grounds.like:
        like = "; ".join(grounds.like)
        return f"Something is missing ({p}) that no named effect explains; it looks most like this: {like}."
    if grounds.family.endswith(FAR_OUT):
        covariate = grounds.words.covariate_in_words(grounds.family.removesuffix(FAR_OUT))
        tail = f"a test of the mean alone, which takes them for heavy-tailed noise, gives {p}"
        return f"Outlying readings cluster in {covariate}: something is missing there ({tail})."
    most = covariate_of_unknown(grounds.family, grounds.shows_in)
    place = f"; it shows most in {grounds.words.covariate_in_words(most)}" if most else ""
    if grounds.family == PRODUCTS:
        place = "; it varies as a product of two columns"
    what = f"Beside {join_names(effects_in_words(grounds.beside))}, something" if grounds.beside else "Something"
    return f"{what} is missing ({p}) that no named effect explains{place}."


def covariate_of_unknown(family: str, shows_in: Sequence[str]) -> str:
    """Return the covariate in which an unknown effect shows most: that of its most probable form, if it shows there.

    If that is the time, it is the first of the covariates `shows_in`, which a control is where both say the same.
    """
    likeliest, first = family.partition(",")[0].removesuffix(" within scans"), next(iter(shows_in), "")
    return likeliest if likeliest in shows_in and likeliest not in ("time", "row") else first


def _cannot_tell_sentence(judged: Judged, grounds: Grounds) -> str:
    cure = "" if grounds.settles is None else f"; {grounds.words.settles_nothing}"
    if grounds.settles:
        cure = f"{TO_SEPARATE}{grounds.apart}: {grounds.settles}"
    said = _joined_effect_sentences(judged.shared, grounds)
    if said:
        return f"{said}. Beside that, {_open_question(judged.beside_shared, grounds, NOTHING_MORE)}{cure}."
    asked = _open_question(judged.hypotheses, grounds, NOTHING)
    return f"{asked[:1].upper()}{asked[1:]}{cure}."


def _open_question(hypotheses: Sequence[Hypothesis], grounds: Grounds, nothing: str) -> str:
    """Say which hypotheses these readings cannot tell apart, or which one is likeliest, without a full stop."""
    named = _rivals_to_name(hypotheses)
    said = [f"{hypothesis_in_words(h.effects, nothing=nothing)} ({h.probability:.2f})" for h in named]
    if len(said) > 1:
        return f"these {grounds.n_readings} readings cannot tell apart {join_lists(said)}"
    rest = max((h.probability for h in hypotheses if h not in named), default=0.0)
    return f"most likely {said[0]}; no other explanation has more than {max(rest, 0.01):.2f}"


def _rivals_to_name(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    return [h for k, h in enumerate(hypotheses[:3]) if k == 0 or h.probability >= _OPEN]


def _noise_sentence(judged: Judged, grounds: Grounds) -> str:
    p = p_in_words(judged.p_value)
    mean = f"nothing is missing from the mean ({p})"
    if judged.p_value < ALARM:
        mean = f"a test of the mean alone gives {p}, which no effect explains better than this noise"
    return f"{_joined_effect_sentences(judged.combination, grounds, *grounds.nuisances)}; {mean}."


def _named_sentence(judged: Judged, grounds: Grounds) -> str:
    after = grounds.p_value_after
    named = f"{_joined_effect_sentences(judged.stated, grounds, *grounds.nuisances)} ({p_in_words(judged.p_value)})."
    beside = ""
    if judged.leader and judged.beside_shared[0].probability < SETTLED:
        beside = f" Beside that, {_open_question(judged.beside_shared, grounds, NOTHING_MORE)}."
    more = f" Something more is missing: the repaired model has {p_in_words(after)}." if after < ALARM else ""
    return f"{named}{beside}{more}"


def _joined_effect_sentences(names: Sequence[str], grounds: Grounds, *more: str) -> str:
    said = "; ".join([*(grounds.sentences[name] for name in names if name in grounds.sentences), *more])
    return grounds.words.as_sentence(said)
