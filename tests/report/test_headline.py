"""A headline is short, in words, and says which verdict it is, whatever was found."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from probewise.diagnosis import EffectFound, Hypothesis
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.words import EFFECTS_IN_WORDS, effect_in_words
from probewise.effects import EFFECTS, NUISANCES, VOCABULARY
from probewise.recordings import Instrumentation
from probewise.report.headline import MOST_WORDS, headline

NAMES = sorted(VOCABULARY)
PLAN = SimpleNamespace(instrumentation=Instrumentation())


def found(
    verdict,
    combination=(),
    *,
    p_value=1e-9,
    after=0.5,
    rivals=(),
    shares=None,
    n=408,
    few=False,
    beside=(),
    withdrawn=False,
    shared=(),
    leader=(),
    open_beside=(),
):
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
        hypotheses=tuple(stated) or (Hypothesis(tuple(combination), 0.99),),
        judged=SimpleNamespace(
            unknown_shares=shares or {},
            too_little=few,
            withdrawn=withdrawn,
            shared=shared,
            leader=leader,
            stated=shared if leader else tuple(combination),
            beside_shared=tuple(Hypothesis(tuple(names), p) for names, p in open_beside),
        ),
    )


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


@pytest.mark.parametrize("name", NAMES)
def test_one_effect_alone_is_said_in_full(name):
    assert headline(found("named", (name,))) == f"The model leaves out {effect_in_words(name)}."


def test_an_effect_of_a_users_own_goes_by_its_name():
    assert headline(found("named", ("upper_tank_overflow",))) == "The model leaves out upper tank overflow."


def test_the_largest_effect_comes_first():
    said = headline(found("named", ("flicker", "backlash")))
    assert said == "The model leaves out a flickering lamp and backlash (play) of the arm."


def test_rivals_are_told_by_what_they_do_not_share():
    said = headline(found("cannot_tell", ("lag",), rivals=(("lag", "outliers"), ("backlash", "outliers"))))
    assert "outlying" not in said
    assert "a sensor that follows slowly or backlash" in said


def test_what_all_rivals_share_is_named_and_what_is_open_beside_it_is_said():
    open_beside = [(("outliers",), 0.5), (("glint",), 0.5)]
    said = headline(found("named", ("lag",), shared=("lag",), leader=("lag", "outliers"), open_beside=open_beside))
    assert (
        said == "The model leaves out a sensor that follows slowly; besides, outlying readings or a glint at one place."
    )
    rivals = [("lag", "outliers"), ("backlash", "outliers")]
    said = headline(found("cannot_tell", rivals[0], rivals=rivals, shared=("outliers",)))
    assert said.startswith("Beside outlying readings, something is missing: a sensor that follows slowly or")


def test_nothing_is_no_rival_of_something_missing():
    said = headline(found("cannot_tell", rivals=((), ("lag",))))
    assert (
        said
        == "These readings cannot tell whether anything is missing; if so, most likely a sensor that follows slowly."
    )


def test_only_of_an_effect_that_was_withdrawn_it_is_said_that_it_predicts_worse():
    said = headline(found("cannot_tell", rivals=(("lag",),), withdrawn=True))
    assert said.endswith("a sensor that follows slowly fits best, but predicts new readings worse.")
    said = headline(found("cannot_tell", rivals=(("lag",),)))
    assert said == "Something is missing, but these readings cannot tell what."


def test_a_formula_is_no_covariate():
    said = headline(found("unknown", ("unknown",), shares={"formula:reading:y:x^2, x beyond 3": 1.0}))
    assert said == "Something is missing that no known effect explains; it looks most like a term x^2, x beyond 3 in y."


def test_the_likeliest_of_rivals_too_long_to_be_listed_is_named():
    rivals = [("hysteresis",), ("lag",)]
    said = headline(found("cannot_tell", rivals[0], rivals=rivals))
    assert said.startswith("Something is missing, most likely an offset that depends on the direction;")


def test_many_rivals_of_which_none_is_probable_are_not_named():
    said = headline(found("cannot_tell", rivals=[(name,) for name in NAMES[:12]]))
    assert said == "Something is missing, but these readings cannot tell what."


def test_what_is_missing_after_the_repair_is_said():
    assert headline(found("named", ("lag",), after=1e-5)).endswith("Something more is missing.")


def test_the_largest_effect_is_named_rather_than_that_more_is_missing():
    said = headline(found("named", ("cubic:velocity:angle", "lag", "outliers"), after=1e-5))
    assert said == "The model leaves out 3 effects, the largest of them a cubic term of angle in the rate of velocity."


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
