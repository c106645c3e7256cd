"""The verdict from probabilities."""

from types import SimpleNamespace

import pytest

from probewise.diagnosis.advice import Alias
from probewise.diagnosis.search.hypotheses import HypothesisProbabilities
from probewise.diagnosis.verdict import (
    Hypothesis,
    Judged,
    hypotheses_with_verdict,
    ranked_hypotheses,
    shared_effects,
    verdict_and_combination,
    with_shared_effects,
)

NOISE = frozenset({"outliers"})


def verdict(probabilities, *, p_value=1e-6, aliases=(), same=(), **more):
    found = ranked_hypotheses(probabilities, lambda mean: mean)
    return verdict_and_combination(
        found, p_value, noise_names=NOISE, aliases=aliases, aliased_with=lambda _: frozenset(same), **more
    )


def searched(probabilities):
    """A search with these probabilities by effects on mean and noise, of which all out of vocabulary are unknown."""
    posterior = HypothesisProbabilities(probabilities)
    rare = [mean for mean, _ in probabilities if mean in (("arm_knock",), ("bent_rails",))]
    return SimpleNamespace(
        posterior=posterior,
        evidences=SimpleNamespace(reported_as=lambda mean: ("unknown",) if mean in rare else mean),
        leading_combination_out_of_vocabulary=lambda: max(rare, key=lambda m: posterior.marginal_over_noise[m]),
    )


def of_probabilities(hypotheses, *, same=()):
    return verdict_and_combination(
        hypotheses, 1e-6, noise_names=NOISE, aliases=(), aliased_with=lambda _: frozenset(same)
    )


def test_a_decided_rare_effect_is_reported_by_name_on_an_alarm_only():
    found = searched({(("arm_knock",), ()): 0.9, (("bent_rails",), ()): 0.04, (("lag",), ()): 0.06})
    hypotheses, rare, _ = hypotheses_with_verdict(found, 1e-6, of_probabilities)
    assert rare == ("arm_knock",)
    assert [h.effects for h in hypotheses] == [("arm_knock",), ("lag",), ("unknown",)]
    hypotheses, rare, _ = hypotheses_with_verdict(found, 0.02, of_probabilities)
    assert (rare, hypotheses[0].effects) == ((), ("unknown",))


def test_a_rare_effect_split_by_noise_behind_another_name_leaves_the_verdict_unknown():
    """By name it would be .29 and .26, behind the lag's .43: weaker than the unknown that it was."""
    found = searched(
        {
            (("arm_knock",), ()): 0.29,
            (("arm_knock",), ("correlated_noise",)): 0.26,
            (("lag",), ()): 0.43,
            (("unknown",), ()): 0.02,
        }
    )
    hypotheses, rare, _ = hypotheses_with_verdict(found, 1e-6, of_probabilities)
    assert rare == ()
    assert (hypotheses[0].effects, hypotheses[0].probability) == (("unknown",), pytest.approx(0.57))


def test_physics_is_named_on_an_alarm_only():
    sure = {(("lag",), ()): 0.9, ((), ()): 0.1}
    assert verdict(sure) == ("named", ("lag",))
    assert verdict(sure, p_value=0.2) == ("cannot_tell", ())


def test_a_rival_that_the_readings_cannot_tell_from_the_leader_keeps_it_from_being_named():
    two = {(("lag",), ()): 0.6, (("backlash",), ()): 0.4}
    assert verdict(two) == ("named", ("lag",))
    assert verdict(two, same=[("backlash",)]) == ("cannot_tell", ("lag",))
    assert verdict({(("lag",), ()): 0.8, (("backlash",), ()): 0.2}, same=[("backlash",)]) == ("cannot_tell", ("lag",))
    assert verdict({(("lag",), ()): 0.9, (("backlash",), ()): 0.1}, same=[("backlash",)]) == ("named", ("lag",))


def of_words(probability):
    """Probabilities by effects on mean and noise, from those by names in a row; none is clean."""
    parts = {tuple(names.split()): p for names, p in probability.items()}
    return {(tuple(n for n in k if n not in NOISE), tuple(n for n in k if n in NOISE)): p for k, p in parts.items()}


@pytest.mark.parametrize(
    ("probability", "said", "combination"),
    [
        ({"": 0.6, "lag": 0.4}, "clean", ()),
        ({"": 0.2, "unknown": 0.6, "lag": 0.2}, "unknown", ("unknown",)),
        ({"": 0.2, "backlash": 0.8}, "named", ("backlash",)),
        ({"": 0.2, "backlash": 0.4, "lag": 0.4}, "cannot_tell", ("backlash",)),
        ({"": 0.1, "backlash": 0.4, "glint": 0.3, "lag": 0.2}, "cannot_tell", ("backlash",)),
        ({"": 0.1, "backlash": 0.4, "tilt": 0.2, "glint": 0.3}, "cannot_tell", ("backlash",)),
        ({"": 0.1, "outliers": 0.9}, "noise", ("outliers",)),
        ({"": 0.1, "backlash outliers": 0.9}, "named", ("backlash", "outliers")),
        ({"": 0.45, "glint": 0.3, "lag": 0.25}, "cannot_tell", ()),
        ({"": 0.3, "glint": 0.4, "lag": 0.3}, "cannot_tell", ("glint",)),  # nothing is named below one half,
        ({"glint": 0.4, "glint outliers": 0.2, "lag": 0.4}, "named", ("glint",)),  # whatever noise is beside it
    ],
)
def test_verdicts_follow_the_probabilities(probability, said, combination):
    aliases = (Alias(("backlash", "tilt"), 1.0, "turn the sensor", 8), Alias(("backlash", "lag"), 0.99, "go back", 8))
    assert verdict(of_words(probability), aliases=aliases) == (said, combination)


def test_a_credible_set_is_the_fewest_that_hold_the_mass():
    found = ranked_hypotheses(of_words({"": 0.02, "backlash": 0.7, "backlash lag": 0.26, "glint": 0.02}), lambda m: m)
    assert Judged("named", ("backlash",), 0.0, found).credible == ("backlash", "backlash+lag")


def test_the_leader_is_the_effect_on_the_mean_with_the_most_probability_over_all_noises():
    """An alias of a hundredth does not tip the class over one half, either."""
    split = {(("lag",), ()): 0.33, (("lag",), ("outliers",)): 0.27, (("drift",), ()): 0.4}
    assert verdict(split) == ("named", ("lag",))
    pair = Alias(("drift", "lag"), 0.95, "repeat", 26)
    split = {(("lag",), ()): 0.49, (("lag",), ("outliers",)): 0.42, (("drift",), ()): 0.02, ((), ()): 0.07}
    assert verdict(split, aliases=(pair,), same=[("drift",)]) == ("named", ("lag",))
    assert verdict({((), ("outliers",)): 0.6, (("lag",), ()): 0.4}) == ("noise", ("outliers",))


def by_what_is_shared(verdict, combination, probabilities, *, p_value=1e-6, aliases=()):
    hypotheses = tuple(Hypothesis(names, p) for names, p in probabilities.items())
    judged = with_shared_effects(Judged(verdict, combination, p_value, hypotheses, aliases=aliases), NOISE)
    return judged.verdict, judged.combination, judged.repaired_by


def test_an_effect_that_nearly_all_hypotheses_share_is_named_whatever_is_open_beside_it():
    """The model is repaired by the most probable set that holds it."""
    probabilities = {("drift", "lag"): 0.25, ("lag", "outliers"): 0.2, ("glint", "lag"): 0.5, ("drift",): 0.05}
    judged = by_what_is_shared("cannot_tell", ("glint", "lag"), probabilities)
    assert judged == ("named", ("lag",), ("glint", "lag"))
    doubtful = by_what_is_shared("cannot_tell", ("glint", "lag"), probabilities, p_value=0.2)
    assert doubtful[0] == "cannot_tell"


def test_an_effect_with_a_credible_alias_is_not_shared():
    """Half of the probability is not enough: of 0.52 and 0.48, the prior alone decides."""
    assert by_what_is_shared("cannot_tell", ("lag",), {("lag",): 0.52, ("drift",): 0.48})[0] == "cannot_tell"
    joint = {("drift", "lag"): 0.8, ("lag",): 0.1, ("drift",): 0.1}  # each is in nine tenths, both in eight
    assert by_what_is_shared("cannot_tell", ("drift", "lag"), joint)[1] == ("drift", "lag")
    assert len(shared_effects(joint)) == 1


def test_a_shared_fault_of_the_noise_names_no_physics():
    probabilities = {("lag", "outliers"): 0.4, ("drift", "outliers"): 0.4, ("outliers",): 0.2}
    judged = by_what_is_shared("cannot_tell", ("lag", "outliers"), probabilities)
    assert judged[:2] == ("cannot_tell", ("lag", "outliers"))


def test_noise_is_no_verdict_if_most_of_the_probability_is_on_the_mean():
    """The leader is sought among classes of aliases: a jump and its twin, not a lone drift that is more probable."""
    probabilities = {("outliers",): 0.3, ("drift",): 0.26, ("step",): 0.24, ("jump",): 0.2}
    pair = Alias(("jump", "step"), 1.0, "repeat", 26)
    judged = by_what_is_shared("noise", ("outliers",), probabilities, aliases=(pair,))
    assert judged[:2] == ("cannot_tell", ("step",))
    assert by_what_is_shared("noise", ("outliers",), probabilities, aliases=(pair,), p_value=0.3)[1] == ()
    assert by_what_is_shared("noise", ("outliers",), {("outliers",): 0.5, ("drift",): 0.5})[0] == "noise"
