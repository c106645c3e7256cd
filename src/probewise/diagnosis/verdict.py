"""The verdict, from probabilities, a global test of the null's mean, and aliases; and its reason in words."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis.advice import Alias, NextMeasurement, aliases_with_separating_plans
from probewise.diagnosis.apparatus import SETTLED, Words
from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.locate import ALARM, LARGEST_P, bayes_factor_p_value
from probewise.diagnosis.outlying import FAR_OUT
from probewise.diagnosis.search.hypotheses import (
    Searched,
    WeighedFit,
    effects_out_of_vocabulary,
    noise_effects_in_vocabulary,
    require_converged_fit,
)
from probewise.diagnosis.sensors import fine_structure_slopes
from probewise.diagnosis.unknown_bases import PRODUCTS
from probewise.diagnosis.words import (
    UNKNOWN,
    Names,
    combination_label,
    effects_in_words,
    hypothesis_in_words,
    join_lists,
    join_names,
    p_in_words,
)
from probewise.effects import PROPOSAL, NoiseEffect

N_DRAWS = 999  # number of residual draws under the null
NEGLIGIBLE = 1e-3  # probability up to which a hypothesis or an effect is not listed


@dataclass(frozen=True, eq=False)
class GlobalTest:
    """Result of the global test of the null: p-value, and the most probable noise, names of its effects.

    `problem` is the fit linearised under that noise; `draws` (n_rows, 999) are projected residuals under the null.
    """

    null: WeighedFit
    noise: Names
    problem: Linearised
    draws: FloatArray
    p_value: float


def run_global_test(searched: Searched, *, rng: np.random.Generator) -> GlobalTest:
    """Test whether effects are missing in the mean of the null; the p-value is 1 where all readings are equal.

    It is the largest over the SSF's order (number of Gaussians) and higher ones, and with fine structure: the evidence
    accepts another Gaussian only if it gains ten nats or more, and a smaller misfit of an SSF that is no mixture is not
    physics. So an alarm must hold at every order, and with fine structure about the freest form. Once a p-value exceeds
    .05, the rest is not tested.

    Raises NotConvergedError if the fit of the null did not converge, with enough readings to tell.
    """
    prepared, null, noise = searched.prepared, searched.null, searched.posterior.likeliest_noise()
    if not prepared.has_too_little_data:
        require_converged_fit(null.found, Linearised.of(null.found, null.law))
    fits, tested, p_value = searched.evidences.fits, list[tuple[Linearised, FloatArray]](), 0.0
    forms = [null, *(fits[n, ()] for n in sorted(n for n, names in fits if not names and n > null.n_gaussians))]
    # A known prior is kept at every order: an orientation error shows only relative to it.
    fine = [(forms[-1], True)] if prepared.null is None else []
    for form, is_fine in [*((form, False) for form in forms), *fine]:
        found, law = form.found, form.evidence[form.possible_noise(noise)].likeliest_law
        beside = fine_structure_slopes(found.model, found.z, prepared.usable_rows) if is_fine else None
        problem = Linearised.of(found, law, beside)
        draws = problem.draw_null_residuals(N_DRAWS, rng=rng)
        tested.append((problem, draws))
        p_value = max(p_value, bayes_factor_p_value(problem, searched.template_banks_for_global_test(found), draws))
        if p_value > LARGEST_P:
            break
    # Constant readings have no noise to compare a residual with.
    return GlobalTest(null, noise, *tested[0], 1.0 if prepared.has_only_equal_readings else p_value)


OUT_OF_THE_QUESTION = 0.2
"""Share of a leader's probability up to which its rivals are not credible; priors differ by less."""


def shared_effects(probabilities: Mapping[Names, float]) -> Names:
    """Return the effects that are in nearly all hypotheses at once, sorted; () if there are none.

    The hypotheses without one of them have together at most a fifth of the probability of those with all of them, so
    that no alias of one is credible. `probabilities` are by the effects of each hypothesis.
    """
    total, shared, of_effect = sum(probabilities.values()), frozenset[str](), dict[str, float]()
    for names, p in probabilities.items():
        for name in names if names != UNKNOWN else ():
            of_effect[name] = of_effect.get(name, 0.0) + p
    likely = [name for name, p in of_effect.items() if total - p <= OUT_OF_THE_QUESTION * p]
    for name in sorted(likely, key=lambda name: (-of_effect[name], name)):  # the most probable first
        with_all = sum(p for names, p in probabilities.items() if shared | {name} <= {*names})
        if total - with_all <= OUT_OF_THE_QUESTION * with_all:
            shared |= {name}
    return tuple(sorted(shared))


Verdict: TypeAlias = Literal["clean", "named", "cannot_tell", "unknown", "noise"]


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects and its probability; () is clean, ("unknown",) what is out of vocabulary and not named."""

    effects: Names
    probability: float

    @property
    def label(self) -> str:
        """Name in a credible set: effects joined by "+", or "clean"."""
        return combination_label(self.effects)


@dataclass(frozen=True, eq=False)
class Judged:
    """The verdict on a recording, with probabilities.

    `combination`: the effects of the verdict, sorted; () if clean or none is named, UNKNOWN if unknown. Where no
    hypothesis decides but nearly all have some effects, the `shared` ones, it holds these, and those of the `leader`
    with a probability above one half. The model is repaired by the `leader`. `p_value`: of the global test
    of the mean, under the noise model found. `hypotheses`: all, most probable first. `unknown_shares`: probability of
    each form, such as "place", that an unknown effect could have. `too_little`: whether there are too few readings for
    a verdict, or all are equal. `withdrawn`: whether the leader predicts held-out readings far worse than the null.
    """

    verdict: Verdict
    combination: Names
    p_value: float
    hypotheses: tuple[Hypothesis, ...]
    aliases: tuple[Alias, ...] = ()
    unknown_shares: Mapping[str, float] = field(default_factory=dict)
    too_little: bool = False
    withdrawn: bool = False
    shared: Names = ()
    leader: Names = ()

    @property
    def repaired_by(self) -> Names:
        """The set of effects by which the model is repaired: the `combination`, or the larger set that leads."""
        return self.leader or self.combination

    @property
    def stated(self) -> Names:
        """The effects that the verdict states without reserve: the `combination`, or of that the `shared` effects."""
        return self.shared if self.leader else self.combination

    @property
    def beside_shared(self) -> tuple[Hypothesis, ...]:
        """What may act beside the `shared` effects, most probable first; () is nothing more."""
        beside = [
            Hypothesis(_without(h.effects, self.shared), h.probability)
            for h in self.hypotheses
            if {*self.shared} <= {*h.effects}
        ]
        return tuple(sorted(beside, key=lambda h: -h.probability))

    def probability_of(self, effects: Names | str) -> float:
        """Return the probability of a hypothesis, 0 of one that is not among those compared.

        Of a name alone, as "lag", it is the probability that this effect acts, whatever acts beside it.
        """
        if isinstance(effects, str):
            return sum(h.probability for h in self.hypotheses if effects in h.effects)
        return next((h.probability for h in self.hypotheses if h.effects == tuple(effects)), 0.0)

    @property
    def unknown_probability(self) -> float:
        """Probability of an effect on the mean that is out of vocabulary and not named."""
        return self.probability_of(UNKNOWN)

    @property
    def clean_probability(self) -> float:
        """Probability that no effect is missing, neither on the mean nor on the noise."""
        return self.probability_of(())

    @property
    def credible(self) -> tuple[str, ...]:
        """Labels of the fewest hypotheses that hold a probability of 95 %, most probable first."""
        ranked = sorted(self.hypotheses, key=lambda h: -h.probability)
        held = list(itertools.accumulate(h.probability for h in ranked))
        return tuple(h.label for k, h in enumerate(ranked) if k == 0 or held[k - 1] < SETTLED)

    @property
    def unknown_candidates(self) -> tuple[tuple[str, float], ...]:
        """Forms that an unknown effect could have, with probabilities, largest first; empty if there hardly is one."""
        if self.unknown_probability < NEGLIGIBLE:
            return ()
        shares = sorted(self.unknown_shares.items(), key=lambda item: -item[1])
        return tuple((name, self.unknown_probability * share) for name, share in shares if share > 0.01)


def _without(names: Iterable[str], others: Iterable[str]) -> Names:
    return tuple(name for name in names if name not in others)


def judge(searched: Searched, test: GlobalTest, *, unknown_weight: float = 1.0) -> Judged:
    """Return the verdict, with probabilities and aliases, from a search and the global test.

    The probability of what is out of vocabulary counts `unknown_weight` times against all others.
    """
    prepared = searched.prepared
    pairs = tuple(aliases_with_separating_plans(searched, test.problem, test.null.found))
    effects, certain = prepared.effects.values(), frozenset(searched.certain)
    on_noise = frozenset(e.name for e in effects if isinstance(e, NoiseEffect) and e.change_of_readings is None)

    def aliased_combinations(combination: Names) -> frozenset[Names]:
        noise = prepared.noise_effect_names & {*combination}
        others = searched.combinations_aliased_with(_without(combination, noise))
        return frozenset(tuple(sorted({*names, *noise})) for names in others)

    def verdict_on(hypotheses: tuple[Hypothesis, ...]) -> tuple[Verdict, Names]:
        if prepared.has_too_little_data:
            return "cannot_tell", ()
        return verdict_and_combination(
            hypotheses, test.p_value, noise_names=on_noise, aliases=pairs, aliased_with=aliased_combinations,
            certain=certain,
        )  # fmt: skip

    hypotheses, rare, (verdict, combination) = hypotheses_with_verdict(
        searched, test.p_value, verdict_on, unknown_weight=unknown_weight
    )
    forms, too_little = searched.probabilities_of_unknown_forms(besides=rare), prepared.has_too_little_data
    judged = Judged(verdict, combination, test.p_value, hypotheses, pairs, forms, too_little)
    return judged if too_little else with_shared_effects(judged, on_noise, certain=certain)


def hypotheses_with_verdict(
    searched: Searched,
    p_value: float,
    verdict_on: Callable[[tuple[Hypothesis, ...]], tuple[Verdict, Names]],
    *,
    unknown_weight: float = 1.0,
) -> tuple[tuple[Hypothesis, ...], Names, tuple[Verdict, Names]]:
    """Return the hypotheses, most probable first, the rare effects that they name (or ()), and the verdict on them.

    A combination with effects out of vocabulary counts as unknown, unless these are rare effects that are decided, the
    p-value of the global test is .01 or less, and the verdict is then that they are named. Decided are those of the
    leader, no proposed formula, if hardly anything else out of vocabulary explains the readings: of what would count as
    unknown, the combinations with them have half of the probability, and all others at most a fifth of that.
    """
    posterior, reported_as = searched.posterior, searched.evidences.reported_as
    unknown = {mean: p for mean, p in posterior.marginal_over_noise.items() if reported_as(mean) == UNKNOWN}
    rare = effects_out_of_vocabulary(searched.leading_combination_out_of_vocabulary())
    own = sum(p for mean, p in unknown.items() if effects_out_of_vocabulary(mean) == rare)
    is_decided = own >= 0.5 and sum(unknown.values()) - own <= OUT_OF_THE_QUESTION * own
    if rare and is_decided and p_value <= ALARM and not any(name.startswith(PROPOSAL) for name in rare):
        hypotheses = ranked_hypotheses(
            posterior.probabilities, lambda mean: mean if effects_out_of_vocabulary(mean) == rare else reported_as(mean)
        )
        verdict, combination = verdict_on(hypotheses)
        if verdict == "named" and {*rare} <= {*combination}:
            return hypotheses, rare, (verdict, combination)
    hypotheses = ranked_hypotheses(posterior.probabilities, reported_as, unknown_weight=unknown_weight)
    return hypotheses, (), verdict_on(hypotheses)


def with_shared_effects(
    judged: Judged, noise_names: frozenset[str], *, certain: frozenset[str] = frozenset()
) -> Judged:
    """Return the judgement by what hypotheses have in common, where none of them alone decides.

    - `noise` needs half of the probability for nothing on the mean. With less the verdict is `cannot_tell`, with the
      most probable combination that has an effect on the mean, by classes of aliases.
    - Instead of `cannot_tell` the shared effects are `named` if one of them is on the mean: they act whatever is left
      open beside them. As for any other name, the p-value must be .01 or less. Beside them the combination has those
      effects of the leading set that have more than half of the probability: the best answer, though not certain.

    `noise_names`, `certain`: effects on the noise; effects that the readings show beyond doubt, which need no
    significant test.
    """
    probability = {h.effects: h.probability for h in judged.hypotheses}
    shared = shared_effects(probability)
    judged = replace(judged, shared=shared)
    if judged.verdict == "noise" and sum(p for names, p in probability.items() if {*names} <= noise_names) < 0.5:
        on_mean = {k: p for k, p in probability.items() if k != UNKNOWN and not {*k} <= noise_names}
        classes = [_combination_and_alias_swaps(names, judged.aliases) & on_mean.keys() for names in on_mean]
        likeliest = max(classes, key=lambda members: sum(on_mean[names] for names in members), default=set())
        leader = max(likeliest, key=lambda names: on_mean[names], default=()) if judged.p_value <= ALARM else ()
        judged = replace(judged, verdict="cannot_tell", combination=leader)
    physics = {*shared} - noise_names
    if judged.verdict != "cannot_tell" or not physics or (judged.p_value > ALARM and not physics <= certain):
        return judged
    leader = max((names for names in probability if {*shared} <= {*names}), key=lambda names: probability[names])
    likely = [name for name in leader if sum(p for names, p in probability.items() if name in names) > 0.5]
    return replace(judged, verdict="named", combination=tuple(sorted({*shared, *likely})), leader=leader)


def ranked_hypotheses(
    probabilities: Mapping[tuple[Names, Names], float],
    reported_as: Callable[[Names], Names],
    *,
    unknown_weight: float = 1.0,
) -> tuple[Hypothesis, ...]:
    """Join effects on mean and noise into hypotheses, most probable first; unknown is one under any noise.

    `probabilities` are by the effects on the mean and those on the noise; `reported_as` gives the name of the former.
    """
    joined: dict[Names, float] = {}
    for (mean, noise), p in probabilities.items():
        key = reported_as(mean)
        key = key if key == UNKNOWN else tuple(sorted((*key, *noise_effects_in_vocabulary(noise))))
        joined[key] = joined.get(key, 0.0) + p * (unknown_weight if key == UNKNOWN else 1.0)
    total = sum(joined.values())
    ranked = sorted(joined.items(), key=lambda item: -item[1])
    return tuple(Hypothesis(key, p / total) for key, p in ranked)


def verdict_and_combination(
    hypotheses: tuple[Hypothesis, ...],
    p_value: float,
    *,
    noise_names: frozenset[str],
    aliases: tuple[Alias, ...],
    aliased_with: Callable[[Names], frozenset[Names]],
    certain: frozenset[str] = frozenset(),
) -> tuple[Verdict, Names]:
    """Return the verdict and the combination it names.

    Clean or unknown is the verdict if it has half the probability. Otherwise the most probable combination of effects
    on the mean, whatever effects on the noise are beside them, is `named` if it has half the probability. If all its
    effects are on the noise, the verdict is `noise`. It is `cannot_tell` instead,

    - with half the probability or more, if one aliased with it (`aliased_with`) has over a fifth of its probability;
    - with less, of effects on the mean, or if it has half together with all that differ from it by one effect swapped
      for its alias (`aliases`);
    - with less, if clean or unknown is more probable, or if there is no combination: then none is named;
    - if the p-value of the global test is above .01, of effects on the mean: then none is named, but those in
      `certain`, which the readings show beyond doubt.
    """
    by_mean, fullest = dict[Names, float](), dict[Names, Names]()
    for hypothesis in sorted(hypotheses, key=lambda h: -h.probability):
        mean = _without(hypothesis.effects, noise_names) or hypothesis.effects  # those on the noise alone stay apart
        by_mean[mean] = by_mean.get(mean, 0.0) + hypothesis.probability
        fullest.setdefault(mean, hypothesis.effects)
    unknown, clean = by_mean.get(UNKNOWN, 0.0), by_mean.get((), 0.0)
    named = {effects: p for effects, p in by_mean.items() if effects not in ((), UNKNOWN)}
    top = max(named, key=lambda effects: named[effects], default=())
    of_class = _combination_and_alias_swaps(top, aliases)
    verdict: Verdict = "named"
    if unknown >= 0.5:
        verdict, top = "unknown", UNKNOWN
    elif clean >= 0.5:
        verdict, top = "clean", ()
    elif not named:
        verdict = "cannot_tell"
    elif named[top] >= 0.5:
        if any(named.get(other, 0.0) > OUT_OF_THE_QUESTION * named[top] for other in aliased_with(top)):
            verdict = "cannot_tell"
    elif len(of_class) > 1 and sum(named.get(member, 0.0) for member in of_class) >= 0.5:
        verdict = "cannot_tell"
    elif max(clean, unknown) > named[top]:
        verdict, top = "cannot_tell", ()
    combination = fullest.get(top, top)
    if verdict == "named" and {*top} <= noise_names:
        return "noise", combination
    if verdict == "named" and named[top] < 0.5:
        return "cannot_tell", combination
    doubtful = verdict == "named" and not {*combination} <= noise_names | certain
    return ("cannot_tell", ()) if doubtful and p_value > ALARM else (verdict, combination)


def _combination_and_alias_swaps(names: Names, aliases: tuple[Alias, ...]) -> set[Names]:
    both_ways = [pair for a in aliases for pair in (a.effects, a.effects[::-1])]
    return {names} | {tuple(sorted({*names} - {name} | {other})) for name, other in both_ways if name in names}


TO_SEPARATE = "; to tell "
"""Introduces the next readings in the reason of `cannot_tell`."""
ALL = "them apart"  # what they tell if they separate all hypotheses that the reason names
NOTHING_MORE = "nothing more"  # the hypothesis of no effect beside those that are certain
NOTHING = "nothing missing"  # the hypothesis of no effect at all
OPEN = 0.05  # least probability of a rival: what has less is no open question


@dataclass(frozen=True)
class Grounds:
    """The facts, in addition to the verdict, for the sentence that gives its reason."""

    words: Words
    n_readings: int  # usable ones
    least_readings: int  # the fewest for a verdict
    form: str = ""  # of the calibrated SSF, if there is one
    sentences: Mapping[str, str] = field(default_factory=dict)  # on each effect, by name
    like: tuple[str, ...] = ()  # sentences on the effects that the unknown one resembles
    family: str = ""  # the most probable family of bases of the unknown effect, such as "time"
    beside: tuple[str, ...] = ()  # effects that act in addition to the unknown one
    shows_in: tuple[str, ...] = ()  # covariates of effects and residuals, in the order of `Diagnosis.where`
    p_value_after: float = 1.0  # of the global test of the repaired model
    settles: str | None = None  # the readings that would separate what is open; "" if none do, None if not known
    apart: str = ALL  # which of the hypotheses they separate
    nuisances: tuple[str, ...] = ()  # sentences on noise that was found beside what has a name in the vocabulary


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
    if judged.verdict == "unknown":
        return _unknown_sentence(judged, grounds)
    if judged.verdict == "cannot_tell":
        cure = "" if grounds.settles is None else f"; {grounds.words.settles_nothing}"
        if grounds.settles:
            cure = f"{TO_SEPARATE}{grounds.apart}: {grounds.settles}"
        said = _joined_effect_sentences(judged.shared, grounds)
        if said:
            return f"{said}. Beside that, {_open_question(judged.beside_shared, grounds, NOTHING_MORE)}{cure}."
        asked = _open_question(judged.hypotheses, grounds, NOTHING)
        return f"{asked[:1].upper()}{asked[1:]}{cure}."
    named = _joined_effect_sentences(judged.stated, grounds, *grounds.nuisances)
    if judged.verdict == "noise":
        mean = f"nothing is missing from the mean ({p})"
        if judged.p_value < ALARM:
            mean = f"a test of the mean alone gives {p}, which no effect explains better than this noise"
        return f"{named}; {mean}."
    said, after = f"{named} ({p}).", grounds.p_value_after
    if judged.leader and judged.beside_shared[0].probability < SETTLED:
        said += f" Beside that, {_open_question(judged.beside_shared, grounds, NOTHING_MORE)}."
    return said + (f" Something more is missing: the repaired model has {p_in_words(after)}." if after < ALARM else "")


def separating_readings_in_words(
    searched: Searched, judged: Judged, asked: NextMeasurement | None
) -> tuple[str | None, str]:
    """Return `settles` and `apart` of `Grounds`: the next readings, and which hypotheses of the reason they separate.

    Nothing is known of hypotheses that differ in their noise alone, or that are not among those compared.
    """
    on_noise, told = searched.prepared.noise_effect_names, [h.effects for h in _rivals_to_name(judged.hypotheses)]
    if judged.shared:
        told = [tuple(sorted({*judged.shared, *h.effects})) for h in _rivals_to_name(judged.beside_shared)]
    named: dict[Names, str] = {}
    on_mean = {tuple(sorted({*names} - on_noise)) for names in told}
    formulas = {names for names in asked.effects if effects_out_of_vocabulary(names)} - on_mean if asked else set()
    for names in told:
        if names == UNKNOWN:  # without a formula it predicts what the null does
            named |= dict.fromkeys(formulas or {()}, hypothesis_in_words(names))
        else:
            beside = tuple(sorted({*names} - {*judged.shared}))
            label = hypothesis_in_words(beside, nothing=NOTHING_MORE if judged.shared else NOTHING)
            named.setdefault(tuple(sorted({*names} - on_noise)), label)
    if len(named) < 2:
        return None, ""
    classes = asked.classes_among(named) if asked is not None else []
    if asked is None or len(classes) == 1 < len(classes[0]):
        return "", ""
    if sum(map(len, classes)) < 2:
        return None, ""
    labels = list(dict.fromkeys(" or ".join(dict.fromkeys(named[asked.effects[k]] for k in own)) for own in classes))
    if len(labels) < 2:  # formulas for one unknown effect
        return None, ""
    return asked.description, ALL if set(labels) == set(named.values()) else " from ".join(labels)


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


def _open_question(hypotheses: Sequence[Hypothesis], grounds: Grounds, nothing: str) -> str:
    """Say which hypotheses these readings cannot tell apart, or which one is likeliest, without a full stop."""
    named = _rivals_to_name(hypotheses)
    said = [f"{hypothesis_in_words(h.effects, nothing=nothing)} ({h.probability:.2f})" for h in named]
    if len(said) > 1:
        return f"these {grounds.n_readings} readings cannot tell apart {join_lists(said)}"
    rest = max((h.probability for h in hypotheses if h not in named), default=0.0)
    return f"most likely {said[0]}; no other explanation has more than {max(rest, 0.01):.2f}"


def _rivals_to_name(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    return [h for k, h in enumerate(hypotheses[:3]) if k == 0 or h.probability >= OPEN]


def _joined_effect_sentences(names: Sequence[str], grounds: Grounds, *more: str) -> str:
    said = "; ".join([*(grounds.sentences[name] for name in names if name in grounds.sentences), *more])
    return grounds.words.as_sentence(said)
