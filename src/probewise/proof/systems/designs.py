"""Experimental designs of runs: irregular sampling, sweeps, steps and oscillations, irrelevant columns."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.proof.systems.kind import Columns, SystemKind
from probewise.proof.systems.table import SystemTable

_PAUSE = 0.15  # pause between runs, as a share of the first run's length


def irregular_times(rng: np.random.Generator, n: int, gap: float) -> FloatArray:
    """Draw n times from 0, whose gaps lie between 0.6 and 1.4 times `gap`, (n,)."""
    return np.concatenate([[0.0], np.cumsum(gap * rng.uniform(0.6, 1.4, n - 1))])


def random_steps(rng: np.random.Generator, n: int, levels: FloatArray, length: int) -> FloatArray:
    """Return random levels, none twice in succession, each held for 0.5 to 2 times `length` rows, (n,)."""
    out: list[float] = []
    while len(out) < n:
        choices = [level for level in levels if not out or level != out[-1]]
        out += [float(rng.choice(choices))] * int(rng.integers(max(length // 2, 2), 2 * length))
    return np.array(out[:n])


def random_waves(rng: np.random.Generator, t: FloatArray, size: float, fastest: float) -> FloatArray:
    """Return a sum of four sinusoids at times `t`, frequencies 0.1 to 1 times `fastest`, rms `size`; shape of `t`."""
    hz = fastest * rng.uniform(0.1, 1.0, 4)
    waves = np.sin(2 * np.pi * hz[:, None] * t + rng.uniform(0, 2 * np.pi, 4)[:, None])
    return np.asarray(size * waves.sum(axis=0) / np.sqrt(2.0))


def sweep_there_and_back(rng: np.random.Generator, n: int, low: float, high: float) -> FloatArray:
    """Return a rising and then a falling sweep between `low` and `high` in random steps, (n,)."""
    up = n // 2
    first, second = np.sort(rng.uniform(0, 1, up)), np.sort(rng.uniform(0, 1, n - up))[::-1]
    return np.asarray(low + (high - low) * np.concatenate([first, second]))


def design_runs(kind: SystemKind, *, rng: np.random.Generator) -> SystemTable:
    """Return the table of all runs of a case; the last two are held out, the last one is in a new range of inputs."""
    n_runs = kind.n_runs + 2
    each = int(np.clip(rng.integers(150, 420) // kind.n_runs, 24, 120))
    columns: dict[str, list[FloatArray]] = {}
    run: list[FloatArray] = []
    clock = 0.0
    for k in range(n_runs):
        n = int(each * rng.uniform(0.8, 1.2))
        regime = 1.5 if k == n_runs - 1 else 1.0
        t, own = kind.design(rng, n, regime)
        if not kind.restarts_time:
            t = t + clock
            clock = float(t[-1]) + _PAUSE * float(t[-1] - t[0]) * rng.uniform(0.5, 1.5) + float(t[1] - t[0])
        whole = {**own, **_irrelevant_columns(kind, n, regime, rng)}
        if kind.time is not None:
            whole[kind.time] = t
        for name, values in whole.items():
            decimals = {**kind.decimals, **{c.name: c.decimals for c in kind.logged}}[name]
            columns.setdefault(name, []).append(np.round(values, decimals))
        run.append(np.full(n, k))
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    return SystemTable(joined, np.concatenate(run).astype(np.int64), kind.time, n_runs)


def _irrelevant_columns(kind: SystemKind, n: int, regime: float, rng: np.random.Generator) -> Columns:
    out = {}
    for column in kind.logged:
        walk = np.cumsum(rng.standard_normal(n)) / np.sqrt(n) + rng.standard_normal()
        beyond = column.beyond if regime > 1 else 0.0
        out[column.name] = column.middle + beyond + column.wander * walk + column.jitter * rng.standard_normal(n)
    return out
