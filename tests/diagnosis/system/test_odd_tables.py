"""Tables that are odd and allowed: a verdict, never a crash."""

import numpy as np
import pytest

from probewise.diagnosis import diagnose_system
from probewise.systems import Law, Simulator

_N = 40
_X, _T = np.linspace(0.0, 1.0, _N), 0.5 * np.arange(_N)
_Y = 1.0 + 2.0 * _X + 0.05 * np.random.default_rng(0).standard_normal(_N)
_HALF = np.where(_X < 0.5, np.nan, _Y)


def _line(**more):
    return Simulator("y", "V", {"a": (-5, 5), "b": (-5, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"], **more)


_RUNS_AWAY = Simulator(
    "y", "V", {"a": (-3, 3)}, law=Law({"s": 0.5}, lambda s, p, u: {"s": p["a"] * s["s"] ** 2}), time="t"
)
_TABLES = {
    "all times equal": (_line(time="t"), {"t": np.zeros(_N), "x": _X, "y": _Y}),
    "repeated times": (_line(time="t"), {"t": np.repeat(_T[::4], 4), "x": _X, "y": _Y}),
    "runs of one row": (_line(run="r"), {"r": np.arange(float(_N)), "x": _X, "y": _Y}),
    "a run without a reading": (_line(run="r"), {"r": np.repeat([1.0, 2.0], _N // 2), "x": _X, "y": _HALF}),
    "a column of runs that nobody named": (_line(), {"x": _X, "run": np.repeat([1.0, 2.0], _N // 2), "y": _Y}),
    "columns named as covariates are": (_line(), {"x": _X, "time": _T, "level": _X**2, "previous": _X, "y": _Y}),
    "readings that are met exactly": (_line(time="t"), {"t": _T, "x": _X, "y": 1.0 + 2.0 * _X}),
    "one reading out of this world": (_line(), {"x": _X, "y": np.where(np.arange(_N) == 20, 1e9, _Y)}),
    "a law that runs away": (_RUNS_AWAY, {"t": 0.02 * _T, "y": 1 / (2 - 0.03 * _T) + 0.01 * (_Y - 1 - 2 * _X)}),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", _TABLES)
def test_an_odd_table_gets_a_verdict(name):
    simulator, table = _TABLES[name]
    diagnosis = diagnose_system(simulator, table, rng=np.random.default_rng(1))
    assert diagnosis.verdict in ("clean", "named", "noise", "cannot_tell", "unknown")
    assert sum(h.probability for h in diagnosis.judged.hypotheses) == pytest.approx(1.0)
