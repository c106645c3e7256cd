"""The verdict's reason in words."""

from dataclasses import replace

import pytest

from probewise.diagnosis.apparatus import Words
from probewise.diagnosis.verdict import Grounds, Hypothesis, Judged, reason_of

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
