"""The verdict from probabilities, its reason, and names in words."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from probewise.diagnosis.advice import Alias
from probewise.diagnosis.apparatus import Words
from probewise.diagnosis.search.hypotheses import HypothesisProbabilities
from probewise.diagnosis.verdict import (
    Grounds,
    Hypothesis,
    Judged,
    hypotheses_with_verdict,
    ranked_hypotheses,
    reason_of,
    shared_effects,
    verdict_and_combination,
    with_shared_effects,
)
from probewise.diagnosis.words import join_lists, parameter_in_words

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


OVEN = Words(null="the oven's law", find_signal="switch the heater on", settles_nothing="no reading tells them apart")
GROUNDS = Grounds(OVEN, 100, 24, sentences={"lag": "the probe follows with 8 s", "step": "it jumps by 2 at 40 s"})
LAG, CLEAN, UNKNOWN = Hypothesis(("lag",), 0.7), Hypothesis((), 0.2), Hypothesis(("unknown",), 0.1)

FEW = tuple(Hypothesis((name,), p) for name, p in (("step", 0.80), ("lag", 0.01), ("drift", 0.01)))
OPEN = (Hypothesis(("lag", "step"), 0.5), Hypothesis(("lag",), 0.3), Hypothesis(("drift", "lag"), 0.2))


def judged(verdict, combination=(), **more):
    return Judged(verdict, combination, 1e-4, (LAG, CLEAN, UNKNOWN), **more)


APART = (
    "These 100 readings cannot tell apart a sensor that follows slowly (0.70), nothing missing (0.20) and something "
    "without a name (0.10)"
)
SAID = [
    (judged("named", ("lag",)), {}, "The probe follows with 8 s (p = 0.0001)."),
    (
        judged("named", ("lag", "step")),
        {"p_value_after": 0.002},
        "The probe follows with 8 s; it jumps by 2 at 40 s (p = 0.0001). "
        "Something more is missing: the repaired model has p = 0.002.",
    ),
    (
        replace(judged("noise", ("lag",)), p_value=0.3),
        {},
        "The probe follows with 8 s; nothing is missing from the mean (p = 0.3).",
    ),
    (
        judged("noise", ("lag",)),
        {},
        "The probe follows with 8 s; a test of the mean alone gives p = 0.0001, which no effect explains better than "
        "this noise.",
    ),
    (
        replace(judged("noise", ("lag",)), p_value=0.3),
        {"nuisances": ("the sd falls to an eighth",)},
        "The probe follows with 8 s; the sd falls to an eighth; nothing is missing from the mean (p = 0.3).",
    ),
    (
        replace(judged("named", ("lag",)), hypotheses=OPEN, shared=("lag",), leader=("lag", "step")),
        {},
        "The probe follows with 8 s (p = 0.0001). Beside that, these 100 readings cannot tell apart step (0.50), "
        "nothing more (0.30) and drift (0.20).",
    ),
    (
        replace(judged("cannot_tell", ("lag",)), hypotheses=OPEN, shared=("lag",)),
        {"settles": "repeat run 2"},
        "The probe follows with 8 s. Beside that, these 100 readings cannot tell apart step (0.50), nothing more "
        "(0.30) and drift (0.20); to tell them apart: repeat run 2.",
    ),
    (
        judged("clean"),
        {},
        "The model explains all 100 readings to within their noise "
        "(p = 0.0001, which is rare; nothing that was tried explains them better).",
    ),
    (
        replace(judged("clean"), p_value=0.4),
        {"form": "an SSF of one Gaussian"},
        "The model, an SSF of one Gaussian, explains all 100 readings to within their noise (p = 0.4).",
    ),
    (judged("cannot_tell"), {"settles": "repeat run 2"}, f"{APART}; to tell them apart: repeat run 2."),
    (
        judged("cannot_tell"),
        {"settles": "repeat run 2", "apart": "lag or clean from unknown"},
        f"{APART}; to tell lag or clean from unknown: repeat run 2.",
    ),
    (judged("cannot_tell"), {"settles": ""}, f"{APART}; no reading tells them apart."),
    (
        judged("unknown", ("unknown",)),
        {"beside": ("lag",), "shows_in": ("time", "level")},
        "Beside a sensor that follows slowly, something is missing (p = 0.0001) that no named effect explains; it "
        "shows most in time.",
    ),
    (
        judged("unknown", ("unknown",)),
        {"like": ("the arm was knocked",), "shows_in": ("time",)},
        "Something is missing (p = 0.0001) that no named effect explains; it looks most like this: the arm was "
        "knocked.",
    ),
    (
        judged("unknown", ("unknown",)),
        {"family": "edge_distance, locally", "shows_in": ("time", "edge_distance")},
        "Something is missing (p = 0.0001) that no named effect explains; it shows most in edge distance.",
    ),
    (
        judged("unknown", ("unknown",)),
        {"family": "products of two columns", "shows_in": ("time",)},
        "Something is missing (p = 0.0001) that no named effect explains; it varies as a product of two columns.",
    ),
    (
        judged("unknown", ("unknown",)),
        {"family": "edge_distance, far out"},
        "Outlying readings cluster in edge distance: something is missing there (a test of the mean alone, which takes "
        "them for heavy-tailed noise, gives p = 0.0001).",
    ),
    (
        replace(judged("cannot_tell", ()), hypotheses=judged("named", ("lag",)).hypotheses, withdrawn=True),
        {},
        "Something is missing (p = 0.0001); a sensor that follows slowly fits these readings best, but predicts "
        "held-out readings far worse "
        "than the oven's law without it.",
    ),
    (
        judged("cannot_tell", too_little=True),
        {"n_readings": 1},
        "1 usable reading is too few for a diagnosis; 24 or more are needed.",
    ),
    (
        judged("cannot_tell", too_little=True),
        {},
        "All 100 usable readings are equal: there is no signal to diagnose; switch the heater on.",
    ),
    (  # what hardly has a probability is no open question
        replace(judged("cannot_tell"), hypotheses=FEW),
        {},
        "Most likely step (0.80); no other explanation has more than 0.01.",
    ),
    (
        replace(judged("named", ("lag",)), hypotheses=(Hypothesis(("lag",), 0.97),), shared=("lag",), leader=("lag",)),
        {},
        "The probe follows with 8 s (p = 0.0001).",
    ),
    (  # a p-value that speaks against an unknown effect is not its reason
        replace(judged("unknown", ("unknown",)), p_value=0.65, hypotheses=(UNKNOWN,)),
        {},
        "Something is missing (probability 0.10, though a test of the mean alone has p = 0.65) that no named effect "
        "explains.",
    ),
]


@pytest.mark.parametrize(("judgement", "grounds", "sentence"), SAID)
def test_a_judgement_is_said_in_one_sentence_of_the_apparatus_own_words(judgement, grounds, sentence):
    assert reason_of(judgement, replace(GROUNDS, **grounds)) == sentence


def test_lists_in_a_list_are_parted_by_semicolons():
    assert join_lists(["a lag", "a jump", "a wave"], "or") == "a lag, a jump or a wave"
    assert join_lists(["a lag and a jump", "a wave"], "or") == "a lag and a jump; or a wave"
    assert join_lists(["a lag"]) == "a lag"


@pytest.mark.parametrize(
    ("effect", "name", "unit", "said"),
    [
        ("steps:tau_s", "a", "s", "jump"),
        ("drag:omega", "a", "1", "size"),
        ("interference~again", "hz", "1/d", "frequency"),
        ("lag", "tau_s", "day", "time constant"),
        ("delay", "tau_s", "s", "delay"),
        ("offset_per_run", "values[3 b]", "V", "run 3 b"),
        ("upper_tank_overflow", "value", "", "upper_tank_overflow"),
        ("edge_misplacement", "offset_mm", "mm", "offset"),
    ],
)
def test_a_parameter_is_called_by_what_it_is(effect, name, unit, said):
    assert parameter_in_words(effect, name, unit) == said
