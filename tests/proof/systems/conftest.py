"""A system small enough to solve by hand: x' = u - k x (or with k = 0, x' = u), three runs of uneven rows."""

import numpy as np
import pytest

from probewise.proof.systems.forms import SystemEffect, forms_of
from probewise.proof.systems.kinds import SystemKind, SystemTable
from probewise.proof.systems.simulate import simulate_noise_free

T = np.array([0.0, 0.7, 1.0, 1.9, 2.4, 3.5, 4.0])


def small(*, k=0.5, x0=2.0, linear=False, n_runs=3, u=None):
    text = f"""
reading, unit, time, run = "x", "m", "t_s", "run"
parameters = {{"k": (0, 1)}}
states = {{"x": {x0!r}}}
hold = "{"linear" if linear else "previous"}"

def rates(s, p, u):
    return {{"x": u["u"] - p["k"] * s["x"]}}
"""
    kind = SystemKind(
        name="by hand",
        text=text,
        shared={"k": (k, k)},
        gap=0.0,
        design=lambda rng, t, regime: {},
        decimals={"u": 0},
        sd=0.01,
    )
    u = np.zeros(len(T)) if u is None else np.asarray(u, dtype=float)
    warm = np.linspace(-1.0, 1.0, len(T) * n_runs)
    rows = SystemTable(
        {"t_s": np.concatenate([T + 10 * r for r in range(n_runs)]), "u": np.tile(u, n_runs), "warm": warm},
        np.repeat(np.arange(n_runs), len(T)),
        "t_s",
        n_runs,
    )
    return kind, rows, {"k": k}


def with_form(name, numbers, **options):
    """Simulate the small system with a form, (n_points,); also return its rows and the readings without."""
    kind, rows, parameters = small(**options)
    bare = simulate_noise_free(kind, rows, parameters)
    form = next(form for form in forms_of(bare) if form.name == name)
    return simulate_noise_free(kind, rows, parameters, [SystemEffect(form, numbers)]).readings, rows, bare.readings


@pytest.fixture
def solve():
    """Readings of the small system with one form of the vocabulary and its numbers, its rows, and those without."""
    return with_form
