"""Whether a single name explains more than what has none, on hand-made evidences."""

from types import SimpleNamespace

import pytest

from probewise.diagnosis.search.searched import Evidences


def _fit(**log_z):
    """Fit under noise models, by name; white is the plain one."""
    evidence = {
        () if noise == "white" else tuple(noise.split("__")): SimpleNamespace(log_z=z) for noise, z in log_z.items()
    }
    return SimpleNamespace(evidence=evidence, log_z=max(log_z.values()))


def _evidences(unknown, *, mean=None, formula=-50.0, **null):
    fits = {(0, ()): _fit(white=-413.0, **null)}
    fits |= {(0, names): _fit(white=z) for names, z in (mean or {}).items()}
    fits[0, ("formula:reading:y:t^2",)] = _fit(white=-413.0 + formula)
    return Evidences(fits, unknown={(0, (), ()): unknown})


@pytest.mark.parametrize(
    ("evidences", "expected"),
    [
        (_evidences(-398.0, correlated_noise=-397.0), True),
        (_evidences(-396.0, correlated_noise=-397.0), False),
        (_evidences(-398.0, mean={("lag",): -390.0}), True),
        (_evidences(-398.0, mean={("lag", "offset_drift"): -390.0}), False),
        (_evidences(-398.0, correlated_noise__outliers=-390.0), False),
        (_evidences(-398.0, drifting_noise=-390.0), False),
        (_evidences(-398.0, correlated_noise=-397.0, formula=20.0), False),
    ],
    ids=["noise", "unknown", "mean", "pair", "two faults", "no name of a noise", "formula"],
)
def test_a_single_name_explains_more_than_what_has_none_or_does_not(evidences, expected):
    assert evidences.one_name_outweighs_unnamed() is expected
