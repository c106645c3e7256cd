"""A headline is short, in words, and says which verdict it is, whatever was found."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from probewise.diagnosis import EffectFound, Hypothesis
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.words import EFFECTS_IN_WORDS
from probewise.effects import EFFECTS, NUISANCES, VOCABULARY
from probewise.recordings import Instrumentation
from probewise.report.headline import MOST_WORDS, headline

NAMES = sorted(VOCABULARY)
PLAN = SimpleNamespace(instrumentation=Instrumentation())
NOISE = ("quantisation", "correlated_noise")


def found(
    verdict, combination=(), *, p_value=1e-9, after=0.5, rivals=(), shares=None, n=408, few=False, beside=(),
    withdrawn=False, shared=(), leader=(), open_beside=(),
):  # fmt: skip
    named = [EffectFound(name, 0.9, 20.0 - k, "", ()) for k, name in enumerate((*combination, *beside))]
    stated = [Hypothesis(tuple(names), 0.9 / max(len(rivals), 1)) for names in rivals]
    return SimpleNamespace(
        recording=SimpleNamespace(usable=np.ones(n, dtype=bool), readings=np.arange(float(n)), plan=PLAN),
        apparatus=LightSensorApparatus(),
        verdict=verdict,
        combination=tuple(combination),
        p_value=p_value,
        improvement=SimpleNamespace(p_value_after=after),
        effects=tuple(named) if combination != ("unknown",) else (),
        where=(),
        noise=SimpleNamespace(model="+".join(name for name in combination if name in NOISE) or "white"),
        hypotheses=tuple(stated) or (Hypothesis(tuple(combination), 0.99),),
        unknown_shares=shares or {},
        too_little=few,
        withdrawn=withdrawn,
        shared=shared,
        leader=leader,
        stated=shared if leader else tuple(combination),
        beside_shared=tuple(Hypothesis(tuple(names), p) for names, p in open_beside),
    )


def rivalled(verdict, combination, rival, **more):
    """A verdict with .6 of the probability, whose rival has .3."""
    diagnosis = found(verdict, combination, **more)
    diagnosis.hypotheses = (Hypothesis(combination, 0.6), Hypothesis(rival, 0.3))
    return diagnosis


def several(most):
    return itertools.chain.from_iterable(itertools.combinations(NAMES, k) for k in range(1, most + 1))


def verdicts():
    yield from (found("clean", p_value=p) for p in (0.5, 1e-4))
    yield from (found(v, names, after=p) for names in several(2) for v in ("named", "noise") for p in (0.5, 1e-6))
    yield from (found("named", NAMES[k : k + n]) for n in (3, 4, 9) for k in range(len(NAMES) - n))
    yield from (found("cannot_tell", a[:1], rivals=(a[:1], a[1:])) for a in itertools.combinations(NAMES, 2))
    yield from (found("cannot_tell", a[:1], rivals=[(k,) for k in a]) for a in itertools.combinations(NAMES[::3], 3))
    yield from (found("cannot_tell", (a,), p_value=0.2, rivals=((), (a,))) for a in NAMES)
    yield from (found("cannot_tell", (), rivals=((), ("unknown",), (a, "outliers"))) for a in NAMES)
    families = [*EFFECTS, "time", "place within scans, locally", "edge_distance, far out", "what was seen before"]
    yield from (found("unknown", ("unknown",), shares={name: 1.0}) for name in families)
    yield from (found("unknown", shares={"time": 1.0}, beside=names) for names in several(2))
    yield from (found("cannot_tell", few=True, n=n) for n in (1, 3))


def test_a_headline_has_twenty_words_at_most_and_no_name_of_code():
    for diagnosis in verdicts():
        said = headline(diagnosis)
        assert 3 <= len(said.split()) <= MOST_WORDS, said
        assert "_" not in said
        assert said[0].isupper() or said[0].isdigit()
        assert said.endswith(".")
        assert "  " not in said


def test_every_effect_has_words_of_its_own():
    for name in (*EFFECTS, *NUISANCES):
        assert name in EFFECTS_IN_WORDS, f"say {name} in words in diagnosis/words.py"
    assert len(set(EFFECTS_IN_WORDS.values())) == len(EFFECTS_IN_WORDS)


SLOW = "a sensor that follows slowly"
MISSING = "Something is missing"
SAID = [
    (found("named", ("upper_tank_overflow",)), "The model leaves out upper tank overflow."),
    (found("named", ("lag", "quantisation")), f"The model leaves out {SLOW}."),
    (found("named", ("flicker", "backlash")), "The model leaves out a flickering lamp and backlash (play) of the arm."),
    (
        found("cannot_tell", ("lag",), rivals=(("lag", "outliers"), ("backlash", "outliers"))),
        f"{MISSING}: {SLOW} or backlash (play) of the arm; these readings cannot tell which.",
    ),
    (
        found("named", ("lag",), shared=("lag",), leader=("lag", "outliers"),
              open_beside=[(("outliers",), 0.5), (("glint",), 0.5)]),
        f"The model leaves out {SLOW}; besides, outlying readings or a glint at one place.",
    ),
    (
        found("cannot_tell", ("lag", "outliers"), rivals=[("lag", "outliers"), ("backlash", "outliers")],
              shared=("outliers",)),
        f"Beside outlying readings, something is missing: {SLOW} or backlash (play) of the arm.",
    ),
    (
        found("cannot_tell", rivals=((), ("lag",))),
        f"These readings cannot tell whether anything is missing; if so, most likely {SLOW}.",
    ),
    (
        found("cannot_tell", rivals=(("lag",),), withdrawn=True),
        f"{MISSING}; {SLOW} fits best, but predicts new readings worse.",
    ),
    (found("cannot_tell", rivals=(("lag",),)), f"{MISSING}, but these readings cannot tell what."),
    (
        found("unknown", ("unknown",), shares={"formula:reading:y:x^2, x beyond 3": 1.0}),
        f"{MISSING} that no known effect explains; it looks most like a term x^2, x beyond 3 in y.",
    ),
    (
        found("cannot_tell", ("hysteresis",), rivals=[("hysteresis",), ("lag",)]),
        f"{MISSING}: an offset that depends on the direction or {SLOW}.",
    ),
    (
        found("cannot_tell", rivals=((), ("lag",), ("glint",))),
        f"These readings cannot tell whether anything is missing; if so, {SLOW} or another.",
    ),
    (
        found("cannot_tell", rivals=[(name,) for name in ("hysteresis", "lag", "battery_sag", "halo")]),
        f"{MISSING}: an offset that depends on the direction, {SLOW} or 2 others.",
    ),
    (rivalled("named", ("lag",), ("glint",)), f"The model leaves out {SLOW}; less likely, a glint at one place."),
    (rivalled("named", ("lag",), ()), f"The model leaves out {SLOW}; less likely, nothing is missing."),
    (
        rivalled("named", ("lag", "outliers"), ("glint",), shared=("lag",), leader=("lag", "outliers")),
        f"The model leaves out {SLOW}; less likely, a glint at one place.",
    ),
    (
        rivalled("named", ("lag", "outliers"), ("lag", "glint"), shared=("lag",), leader=("lag", "outliers")),
        f"The model leaves out {SLOW}.",
    ),
    (rivalled("named", ("lag",), ("lag", "outliers")), f"The model leaves out {SLOW}."),
    (
        rivalled("unknown", ("unknown",), ("lag",)),
        f"{MISSING} that no known effect explains; less likely, {SLOW}.",
    ),
    (
        rivalled("clean", (), ("hysteresis",), p_value=0.4),
        "Nothing is missing: the model explains all 408 readings to within their noise; others are possible.",
    ),
    (
        found("cannot_tell", rivals=[(name,) for name in NAMES[:12]]),
        f"{MISSING}, but these readings cannot tell what.",
    ),
    (found("named", ("lag",), after=1e-5), f"The model leaves out {SLOW}. Something more is missing."),
    (
        found("named", ("cubic:velocity:angle", "lag", "outliers"), after=1e-5),
        "The model leaves out 3 effects, the largest of them a cubic term of angle in the rate of velocity.",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("diagnosis", "said"), SAID, ids=[f"{k}-{d.verdict}" for k, (d, _) in enumerate(SAID)])
def test_the_verdict_is_said_in_words(diagnosis, said):
    assert headline(diagnosis) == said


def test_equal_readings_are_no_signal():
    diagnosis = found("cannot_tell", few=True)
    diagnosis.recording.readings[:] = 7.0
    assert headline(diagnosis) == "All 408 readings are equal: there is no signal to diagnose."


def test_a_headline_has_the_size_and_the_date_where_they_fit():
    diagnosis = found("named", ("ambient_step",))
    sentence = "the reading rises by -247 ± 28 at 1898 ± 1 year"
    diagnosis.effects = (EffectFound("ambient_step", 0.9, 9.0, sentence, ()),)
    assert headline(diagnosis) == "The reading rises by −247 ± 28 at 1898 ± 1 year."
    diagnosis.effects = (EffectFound("ambient_step", 0.9, 9.0, " ".join([sentence] * 3), ()),)
    assert headline(diagnosis).startswith("The model leaves out")
