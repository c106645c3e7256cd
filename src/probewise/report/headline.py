"""The verdict in twenty words at most, for a reader from outside the field."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from probewise._words import count_with_noun
from probewise.diagnosis import ALARM, Diagnosis
from probewise.diagnosis.unknown_bases import MEMORY, PRODUCTS, SCAN_ENDS
from probewise.diagnosis.verdict import covariate_of_unknown
from probewise.diagnosis.words import effect_in_words, effects_in_words, hypothesis_in_words, join_lists, join_names
from probewise.effects import PROPOSAL, RARE_EFFECTS
from probewise.effects.noise import noise_sd
from probewise.report.covariates import covariate_in_words_and_unit
from probewise.report.words import typeset_numbers

MOST_WORDS = 20
_SURE = 0.5
_RIVAL = 0.1  # probability from which a hypothesis is named as a rival
_MOST_RIVALS = 3
_CANNOT_TELL = "Something is missing, but these readings cannot tell what."


def headline(diagnosis: Diagnosis) -> str:
    """Return a diagnosis's verdict in one or two sentences: the most complete version of at most twenty words."""
    return next(said for said in _verdict_versions(diagnosis) if len(said.split()) <= MOST_WORDS)


def _verdict_versions(diagnosis: Diagnosis) -> list[str]:
    """List wordings of a diagnosis's verdict, the most complete first; the last always has at most twenty words."""
    n = int(diagnosis.recording.usable.sum())
    if diagnosis.too_little:
        if n > 1 and float(np.ptp(diagnosis.recording.readings[diagnosis.recording.usable])) == 0.0:
            return [f"All {n} readings are equal: there is no signal to diagnose."]
        return [f"{count_with_noun(n, 'reading').capitalize()} {'is' if n == 1 else 'are'} too few for a diagnosis."]
    noise, stated = diagnosis.noise.model.split("+"), list(diagnosis.stated)
    match diagnosis.verdict:
        case "clean" if diagnosis.p_value < ALARM:
            said = ["These readings look unusual, but nothing that was tried explains them better than the model."]
        case "clean":
            said = [f"Nothing is missing: the model explains all {n} readings to within their noise."]
        case "unknown":
            said = _unknown_versions(diagnosis)
        case "cannot_tell":
            return _undecided_versions(diagnosis)
        case "noise":
            unlike = "what it was" if diagnosis.stated == (noise_sd.name,) else "white"
            said = _left_out_versions(diagnosis, f"The predicted mean is right, but the noise is not {unlike}:", stated)
        case "named":
            more = " Something more is missing." if diagnosis.improvement.p_value_after < ALARM else ""
            stated = [name for name in stated if name not in noise] or stated
            *plain, last = _left_out_versions(diagnosis, "The model leaves out", stated)
            beside = [f"{plain[0][:-1]}; besides, {either}." for either in _open_beside_shared(diagnosis)]
            # With sizes first; a name before that more is missing.
            listed = [
                (one, rest)
                for own in (_told_with_sizes(diagnosis, stated), plain)
                for rest in (more, "")
                for one in own
            ]
            return [*beside, *_with_rivals(diagnosis, [*listed, (last, more), (last, "")])]
    return _with_rivals(diagnosis, [(one, "") for one in said])


def _with_rivals(diagnosis: Diagnosis, versions: Sequence[tuple[str, str]]) -> list[str]:
    """Add the hypotheses that remain possible to the first sentence of each version; without them where none fits."""
    stated = frozenset(diagnosis.stated)
    rivals = [
        h.effects
        for h in diagnosis.hypotheses
        if h.probability > _RIVAL
        and not (bool(stated) == bool(h.effects) and (stated <= {*h.effects} or stated >= {*h.effects}))
    ]
    live = [*_rival_versions(rivals), "others are possible"] if rivals else []
    told = [f"; {'' if one.startswith('others') else 'less likely, '}{one}." for one in live]
    return [f"{first[:-1]}{rival}{rest}" for rival in (*told, ".") for first, rest in versions]


def _told_with_sizes(diagnosis: Diagnosis, stated: Sequence[str]) -> list[str]:
    """Return the sentence on the effects `stated`, with sizes and dates; none if one lacks it."""
    told = {effect.name: effect.sentence for effect in diagnosis.effects if effect.sentence}
    if not all(name in told for name in stated):
        return []
    joined = diagnosis.apparatus.words.as_sentence("; ".join(told[name] for name in stated))
    return [typeset_numbers(f"{joined}.")]


def _left_out_versions(diagnosis: Diagnosis, opening: str, stated: Sequence[str]) -> list[str]:
    sizes = {effect.name: effect.size_lambda for effect in diagnosis.effects}
    names = effects_in_words(sorted(stated, key=lambda k: -sizes.get(k, 0.0)))
    if len(names) == 1:
        return [f"{opening} {names[0]}.", f"{opening} one effect."]
    return [
        f"{opening} {join_names(names)}.",
        f"{opening} {len(names)} effects, the largest of them {names[0]}.",
        f"{opening} {len(names)} effects.",
    ]


def _unknown_versions(diagnosis: Diagnosis) -> list[str]:
    shares = diagnosis.unknown_shares
    top = max(shares, key=lambda k: shares[k], default="")
    family = top.partition(", ")[0].removesuffix(" within scans")
    shows_in = covariate_of_unknown(top, [place.covariate for place in diagnosis.where])
    covariate = _covariate_with_article(diagnosis, shows_in if family in ("time", "row") and shows_in else family)
    known = effects_in_words([e.name for e in diagnosis.effects if e.probability >= _SURE])
    short = "Something is missing that no known effect explains"
    plain = f"Beside {join_names(known)}, something is missing that no known effect explains" if known else short
    if top in RARE_EFFECTS or top.startswith(PROPOSAL):
        said = [f"{plain}; it looks most like {effect_in_words(top)}."]
    elif top.endswith(", far out"):
        said = [f"Outlying readings cluster in {covariate}: something is missing there that no known effect explains."]
    else:
        said = [f"{plain}; it depends most on {covariate}."] if top else []
    if shows_in:
        said += [f"{one}; it shows most in {_covariate_with_article(diagnosis, shows_in)}." for one in (plain, short)]
    return [*said, f"{plain}.", f"{short}."]


def _covariate_with_article(diagnosis: Diagnosis, family: str) -> str:
    """Return what a family of bases depends on, in words, with an article unless it is a user's own name."""
    said, _ = covariate_in_words_and_unit(diagnosis, family)
    is_own = family == PRODUCTS or said in diagnosis.apparatus.words.own_names
    return {MEMORY: "earlier readings", SCAN_ENDS: f"the ends of {diagnosis.apparatus.words.run}s"}.get(
        family, said if is_own else f"the {said}"
    )


def _undecided_versions(diagnosis: Diagnosis) -> list[str]:
    rivals = [h.effects for h in diagnosis.hypotheses if h.probability > _RIVAL]
    if diagnosis.p_value >= ALARM or () in rivals:
        plain = "These readings cannot tell whether anything is missing"
        likely = [names for names in rivals if names] or [h.effects for h in diagnosis.hypotheses if h.effects][:1]
        most = "" if len(likely) > 1 else "most likely "
        return [*(f"{plain}; if so, {most}{either}." for either in _rival_versions(likely)), f"{plain}."]
    said = []
    something = "Something is missing"
    if diagnosis.shared:
        something = f"Beside {join_names(effects_in_words(diagnosis.shared))}, something is missing"
    if len(rivals) > 1:
        every, *cut = _rival_versions(rivals)
        said = [f"{something}: {every}; these readings cannot tell which.", f"{something}: {every}."]
        said += [f"{something}: {some}." for some in cut]
    elif diagnosis.withdrawn:
        leader = hypothesis_in_words(diagnosis.hypotheses[0].effects)
        said = [f"Something is missing; {leader} fits best, but predicts new readings worse."]
    return [*said, f"{something}, but these readings cannot tell what.", _CANNOT_TELL]


def _open_beside_shared(diagnosis: Diagnosis) -> list[str]:
    """List wordings of what may act beside named effects that all rivals share, the most complete first."""
    if not diagnosis.leader:
        return []
    rivals = [h.effects for h in diagnosis.beside_shared if h.probability > _RIVAL]
    return [] if len(rivals) < 2 or () in rivals else _rival_versions(rivals)


def _rival_versions(rivals: Sequence[tuple[str, ...]]) -> list[str]:
    """Name hypotheses, given their effects, as in "A, B or C", without the effects that all share.

    First three at most, then fewer, of which the last stands for those that are not named.
    """
    if not rivals:
        return []
    shared = frozenset.intersection(*map(frozenset, rivals))
    names = [hypothesis_in_words([k for k in own if k not in shared] or own) for own in rivals]
    counts = range(min(len(names), _MOST_RIVALS), 0, -1)
    rest = {n: ["another" if len(names) - n == 1 else f"{len(names) - n} others"] * (n < len(names)) for n in counts}
    return [join_lists([*names[:n], *rest[n]], "or") for n in counts]
