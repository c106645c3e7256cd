"""Grow combinations of effects: screen what could be added to a fit, refit the best of each size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.evidence.screening import log_mean, score_effects, score_pairs
from probewise.diagnosis.search.pool import Pool, rivals_of
from probewise.diagnosis.search.weighed import STEERING, Candidate, outside
from probewise.effects import EFFECTS

__all__ = ["WORTH_GROWING", "WORTH_REFITTING", "Wish", "grow", "wishes_of", "worth_refitting"]

Names = tuple[str, ...]

WORTH_GROWING = 20.0
"""Nats behind the best of its size: nothing more grows from there."""

WORTH_REFITTING = 6.0
"""Nats behind the best so far: screening about a fit that one effect has bent is so far off."""

# An effect may look like another Gaussian, and be explained better by its name at fewer of them.
_RIVAL_ORDER = 100.0  # nats behind the best: an SSF order so far back is not searched
_WORTH_PAIRING = 2.0  # nats of the best effect alone, below which no pair stands out either
_PAIRED = 12  # effects that pairs are screened of, the best alone
_SINGLES = 6  # effects that are refitted alone
_UNNAMED = 3  # combinations of one size that are refitted with something outside the vocabulary
_FAINT = 0.35  # of a trace; where a null leaves no more to first order, a large effect may show in another way


@dataclass(frozen=True, eq=False)
class Wish:
    """A refit that screening promises `score` of, in log evidence: of a candidate, with one more effect."""

    score: float
    parent: Candidate
    added: str


def grow(pool: Pool, *, beam: int, depth: int) -> None:
    """Refit the best combinations of each size, each grown from the best of the size before."""
    null = pool.null
    if depth > 1:
        _screen_pairs(pool, null)
    grown = [c for c in pool.nulls if c.log_z > null.log_z - (_RIVAL_ORDER if c.worth <= null.worth else STEERING)]
    for size in range(1, min(depth, len(pool.effects)) + 1):
        wishes: dict[Names, Wish] = {}
        for parent in grown:
            wishes = wishes_of(pool, parent, wishes)
        if size == 2:
            wishes = _together(pool, wishes)
        chosen = worth_refitting(pool, wishes, width=beam, behind=STEERING) if size > 1 else _alone(pool, null, wishes)
        refitted = [pool.refit(wishes[names].parent, wishes[names].added) for names in chosen]
        grown = [c for c in refitted if c is not None]
        if not grown:
            break
        grown = [c for c in grown if c.log_z > max(r.log_z for r in rivals_of(c.names, grown)) - WORTH_GROWING]


def _screen_pairs(pool: Pool, null: Candidate) -> None:
    """Weigh all pairs about a null by templates, under the noise models that steer."""
    for noise, evidence in null.steering():
        problem = Linearised.of(null.found, evidence.law)
        singles = score_effects(problem, pool.bank(null))
        ranked = sorted(singles, key=lambda name: -float(singles[name].max()))[:_PAIRED]
        if not ranked or log_mean(singles[ranked[0]]) < _WORTH_PAIRING:
            continue
        singles = {name: singles[name] for name in ranked}
        templates = {name: pool.templates.of(null.found, pool.effects[name]) for name in ranked}
        for pair, value in score_pairs(problem, templates, singles).items():
            pool.about_null[pair, noise] = evidence.log_z + value


def wishes_of(pool: Pool, parent: Candidate, wishes: Mapping[Names, Wish]) -> dict[Names, Wish]:
    """Screen every effect that a fit does not hold yet, by its templates about the null of the same SSF.

    Returns
    -------
    The best of these wishes and those already had, by the combination that would come of them.
    """
    bank = pool.bank(pool.candidates[parent.n_gaussians, ()])
    against = 0.0 if parent.names else pool.coincidence(parent.worth)
    known = pool.about_parts if parent.names else pool.about_null
    out = dict(wishes)
    for noise, evidence in parent.steering():
        for name, own in score_effects(Linearised.of(parent.found, evidence.law), bank).items():
            if name in parent.names:
                continue
            names = tuple(sorted((*parent.names, name)))
            score = evidence.log_z + log_mean(own) - against
            if names not in pool.not_felt:  # a refit has said more
                known[names, noise] = max(score, known.get((names, noise), score))
            if names not in out or score > out[names].score:
                out[names] = Wish(score, parent, name)
    return out


def worth_refitting(pool: Pool, wishes: Mapping[Names, Wish], *, width: int, behind: float) -> list[Names]:
    """Choose the combinations of the best odds by screening, up to `width` of names alone.

    One that screening puts `behind` nats behind what it competes with is seldom worth its cost.
    """
    odds = {names: wish.score + pool.prior.log_mean(names) for names, wish in wishes.items()}
    ranked = sorted(odds, key=lambda names: -odds[names])
    named, rest = [n for n in ranked if not outside(n)], [n for n in ranked if outside(n)]
    return [
        names
        for names in [*named[:width], *rest[:_UNNAMED]]
        if odds[names] >= max(pool.odds(c) for c in rivals_of(names, pool.candidates.values())) - behind
    ]


def _alone(pool: Pool, null: Candidate, wishes: Mapping[Names, Wish]) -> list[Names]:
    """Choose the effects that are refitted alone: the leader, what is not far behind, and what screening cannot judge.

    A user's own effect was named to be tried, however far it leads from where screening is linear; and screening says
    nothing of what the null takes up all but a little of to first order.
    """
    ranked = sorted(wishes, key=lambda names: -(wishes[names].score + pool.prior.log_mean(names)))
    left = pool.bank(null).surviving(Linearised.of(null.found, null.law))
    faint = {name for name, members in pool.bank(null).members.items() if left[members].max() < _FAINT}
    always = (pool.effects.keys() - EFFECTS) | faint
    chosen = worth_refitting(pool, wishes, width=_SINGLES, behind=WORTH_REFITTING)
    return list(dict.fromkeys([*ranked[:1], *chosen, *(names for names in ranked if names[0] in always)]))


def _together(pool: Pool, wishes: Mapping[Names, Wish]) -> dict[Names, Wish]:
    """Let pairs promise what they do about the null, where neither effect leads alone."""
    best: dict[Names, float] = {}
    for (names, _), value in pool.about_null.items():
        best[names] = max(value, best.get(names, value))
    return {
        names: replace(wish, score=best[names]) if best.get(names, wish.score) > wish.score else wish
        for names, wish in wishes.items()
    }
