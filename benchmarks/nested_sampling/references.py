"""Compute the references that have no closed form, and write them to `references.json`.

    python -m nested_sampling.references --problems "Rosenbrock 5-D" circle "SSF 1 Gaussian"

Rosenbrock: a transfer matrix on two grids. Circle: midpoint quadrature on cells refined where the posterior is.
SSF of one Gaussian: importance sampling in coordinates in which the posterior is nearly normal but for the
correlation, which has a histogram of its own. SSF of more: tempered sequential Monte Carlo, which shares neither code
nor idea with nested sampling; each replicate's estimate of Z is unbiased but for the choice of its temperatures, and
the spread of the replicates is the error (`--tempered` does so for one Gaussian too: the two agree).
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import gammaln, logsumexp

from nested_sampling import one_thread, records, ssf
from nested_sampling.problems import REFERENCES, FloatArray, Known, problem, rosenbrock_reference

_KEPT_SHARE = 0.5  # of the effective sample size that a step of temperature may cost
_SCALES = np.array([1.0, 0.5, 0.2, 0.05, 0.01])


def by_cells(known: Known) -> tuple[float, FloatArray]:
    """Integrate a problem of three parameters over its prior's unit cube by cells that shrink where they matter.

    Every round halves the cells that may hold posterior mass; the margin by which a cell's midpoint may lie below
    the best one falls as the cells do. Returns log Z and the mean of each parameter.
    """
    cells = np.array([256, 128, 32])
    width = 1.0 / cells
    grid = np.meshgrid(*((np.arange(n) + 0.5) / n for n in cells), indexing="ij")
    points = np.stack([g.ravel() for g in grid], axis=-1)
    corners = np.stack(np.meshgrid(*([(-0.25, 0.25)] * 3), indexing="ij"), axis=-1).reshape(-1, 3)
    log_mass: list[FloatArray] = []
    places: list[FloatArray] = []
    best = -math.inf
    for margin in (6000.0, 3000.0, 1200.0, 400.0, 100.0, 40.0, -math.inf):
        height = np.concatenate(
            [known.log_likelihood(known.prior.from_unit_cube(part)) for part in np.array_split(points, 200)]
        )
        best = max(best, float(height.max()))
        done = height < best - margin if math.isfinite(margin) else np.ones(len(height), dtype=bool)
        log_mass.append(height[done] + math.log(width.prod()))
        places.append(points[done])
        points = (points[~done, None, :] + corners * width).reshape(-1, 3)
        width = width / 2
    mass = np.concatenate(log_mass)
    log_z = float(logsumexp(mass))
    theta = known.prior.from_unit_cube(np.concatenate(places))
    return log_z, np.exp(mass - log_z) @ theta


def by_importance(known: Known, *, n_samples: int, seed: int) -> dict[str, Any]:
    """Integrate the SSF problem of one Gaussian by importance sampling.

    The scans fix centre, projected variances and levels, whose posterior is near normal; only the quadrants know of
    the correlation r of x' and y', and A = 1 / (2 var (1 - r^2)) stretches the prior's box there. So the proposal is
    Student's t in (u, v, ln var_u, ln var_v, I_min, I_max) times a histogram of atanh r; both are adapted, then kept
    for the last, largest sample. The amplitude of a single Gaussian does not reach the data.
    """
    rng = np.random.default_rng(seed)
    dof, n_bins, n_rounds = 8, 120, 6
    most = math.atanh(ssf.MAX_CORRELATION)
    edges = np.linspace(-most, most, n_bins + 1)
    width = edges[1] - edges[0]
    share = np.full(n_bins, 1 / n_bins)
    mean = np.array([ssf.U, ssf.V, 2 * math.log(ssf.SD_U), 2 * math.log(ssf.SD_V), ssf.DARK, ssf.BRIGHT])
    covariance = np.diag([0.05] * 6) ** 2
    n_own = len(mean)
    theta, weight, log_weight = np.empty((0, 8)), np.empty(0), np.empty(0)
    for k in range(n_rounds):
        n = n_samples if k == n_rounds - 1 else n_samples // 10
        root = np.linalg.cholesky(1.2 * covariance)
        z = rng.standard_normal((n, n_own)) / np.sqrt(rng.chisquare(dof, n) / dof)[:, None]
        x = mean + z @ root.T
        log_proposal = gammaln((dof + n_own) / 2) - gammaln(dof / 2) - n_own / 2 * math.log(dof * math.pi)
        log_proposal = log_proposal - np.log(np.diag(root)).sum() - (dof + n_own) / 2 * np.log1p((z**2).sum(1) / dof)
        which = rng.choice(n_bins, n, p=share)
        r = np.tanh(edges[which] + width * rng.random(n))
        log_proposal = log_proposal + np.log(share[which] / width) - np.log1p(-(r**2))  # d atanh r = dr / (1 - r^2)
        precision = 1 / (2 * np.exp(x[:, 2:4]) * (1 - r**2)[:, None])
        scale = np.sqrt(precision.prod(axis=1))
        theta = np.column_stack([rng.random(n), x[:, :2], precision, -r * scale, x[:, 4:]])
        log_prior = known.prior.log_prob(theta)
        inside = np.isfinite(log_prior)
        log_weight = np.full(n, -np.inf)
        # (ln var_u, ln var_v, r) -> (A, B, C) stretches volume by A B sqrt(A B).
        log_weight[inside] = (
            log_prior[inside] + known.log_likelihood(theta[inside]) + 3 * np.log(scale[inside]) - log_proposal[inside]
        )
        weight = np.exp(log_weight - logsumexp(log_weight))
        mean = weight @ x
        covariance = ((x - mean) * weight[:, None]).T @ (x - mean)
        found = np.convolve(np.bincount(which, weight, minlength=n_bins), [0.25, 0.5, 0.25], "same")
        share = 0.8 * found / found.sum() + 0.2 / n_bins
    n_eff = float(1 / (weight @ weight))
    means = {}
    for key in ssf.MOMENTS:
        values = ssf.moment(key, theta)
        centre = float(weight @ values)
        means[key] = [centre, float(np.sqrt(weight**2 @ (values - centre) ** 2))]
    return {
        "log_z": float(logsumexp(log_weight)) - math.log(n_samples),
        "log_z_error": math.sqrt(1 / n_eff - 1 / n_samples),
        "n_eff": round(n_eff),
        "mean": means,
    }


@dataclass(frozen=True, eq=False)
class Replicate:
    """One run of sequential Monte Carlo: its log Z and the mean of each check over its particles."""

    log_z: float
    means: FloatArray
    n_calls: int


def tempered(name: str, seed: int, *, n_particles: int, n_moves: int) -> Replicate:
    """Carry particles from prior to posterior through powers of the likelihood (Del Moral, Doucet & Jasra 2006).

    Between two powers every particle makes `n_moves` Metropolis steps in the unit cube: differences of two others
    (ter Braak 2006), single coordinates, and for the SSF a random relabelling of the Gaussians, which leaves prior
    and likelihood unchanged.
    """
    rng = np.random.default_rng(seed)
    known = problem(name)
    n_params = known.n_params
    n_gaussians = (n_params - 2) // 6 if name.startswith("SSF") else 0

    def height(u: FloatArray) -> FloatArray:
        return known.log_likelihood(known.prior.from_unit_cube(u))

    u = rng.random((n_particles, n_params))
    now = height(u)
    power, log_z, n_calls = 0.0, 0.0, n_particles
    while power < 1.0:
        step = _next_step(now, 1.0 - power)
        weight = step * now
        log_z += float(logsumexp(weight)) - math.log(n_particles)
        power = 1.0 if step >= 1.0 - power else power + step
        chance = np.exp(weight - weight.max())
        ladder = np.cumsum(chance) / chance.sum()
        rows = np.searchsorted(ladder, (np.arange(n_particles) + rng.random()) / n_particles)
        rows = rng.permutation(np.minimum(rows, n_particles - 1))
        u, now = u[rows], now[rows]
        for _ in range(n_moves):
            if n_gaussians > 1:
                u = _relabelled(u, n_gaussians, rng)
            # Each half moves by differences of the other, which it does not change meanwhile.
            order = rng.permutation(n_particles)
            for mine, others in ((order[::2], order[1::2]), (order[1::2], order[::2])):
                proposed = _proposed(u[mine], u[others], rng)
                inside = ((proposed > 0) & (proposed < 1)).all(axis=1)
                mine, proposed = mine[inside], proposed[inside]
                new = height(proposed)
                n_calls += len(new)
                taken = np.log(rng.random(len(new))) < power * (new - now[mine])
                u[mine[taken]], now[mine[taken]] = proposed[taken], new[taken]
    theta = known.prior.from_unit_cube(u)
    means = np.array([ssf.moment(key, theta).mean() for key in ssf.MOMENTS]) if n_gaussians else theta.mean(axis=0)
    return Replicate(log_z, means, n_calls)


def _next_step(height: FloatArray, most: float) -> float:
    """Find the step of the power that leaves `_KEPT_SHARE` of the particles' effective number."""

    def surplus(log_step: float) -> float:
        weight = np.exp(math.exp(log_step) * (height - height.max()))
        return float(weight.sum() ** 2 / (weight @ weight) / len(height)) - _KEPT_SHARE

    high = math.log(most)
    return most if surplus(high) >= 0 else math.exp(brentq(surplus, math.log(1e-12), high))


def _proposed(u: FloatArray, others: FloatArray, rng: np.random.Generator) -> FloatArray:
    n, n_params = u.shape
    a = rng.integers(len(others), size=n)
    b = (a + rng.integers(1, len(others), size=n)) % len(others)
    scale = 2.38 / math.sqrt(2 * n_params) * rng.choice(_SCALES, size=(n, 1))
    scale[rng.random(n) < 0.1] = 1.0  # from mode to mode
    change = scale * (others[a] - others[b])
    # Half of them leave a random part of the coordinates alone: one Gaussian, a pair, a single number.
    part = rng.random((n, n_params)) < rng.choice([1.0, 0.5, 0.2, 1.5 / n_params], size=(n, 1))
    part[np.arange(n), rng.integers(n_params, size=n)] = True
    return np.asarray(u + change * part + 1e-6 * part * rng.standard_normal((n, n_params)))


def _relabelled(u: FloatArray, n_gaussians: int, rng: np.random.Generator) -> FloatArray:
    order = np.argsort(rng.random((len(u), n_gaussians)), axis=1)
    groups = u[:, :-2].reshape(len(u), n_gaussians, 6)
    return np.concatenate(
        [np.take_along_axis(groups, order[:, :, None], axis=1).reshape(len(u), -1), u[:, -2:]], axis=1
    )


def combine(replicates: list[Replicate]) -> dict[str, Any]:
    """Average replicates: Z itself, and posterior means weighted by each one's Z; errors by the jackknife."""
    log_z = np.array([r.log_z for r in replicates])
    means = np.stack([r.means for r in replicates])
    n = len(log_z)

    def of(rows: NDArray[np.int64]) -> FloatArray:
        weight = np.exp(log_z[rows] - logsumexp(log_z[rows]))
        return np.concatenate([[logsumexp(log_z[rows]) - math.log(len(rows))], weight @ means[rows]])

    everyone = np.arange(n)
    whole = of(everyone)
    without = np.stack([of(np.delete(everyone, i)) for i in range(n)])
    error = np.sqrt((n - 1) / n * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    return {
        "log_z": float(whole[0]),
        "log_z_error": float(error[0]),
        "log_z_of_replicates": [round(float(v), 4) for v in log_z],
        "n_calls": int(sum(r.n_calls for r in replicates)),
        "mean": {k: [float(m), float(e)] for k, m, e in zip(ssf.MOMENTS, whole[1:], error[1:], strict=True)},
    }


def compute(
    name: str, *, n_particles: int, n_moves: int, n_replicates: int, seed: int, workers: int, by_tempering: bool
) -> dict[str, Any]:
    """Compute one problem's reference."""
    if name.startswith("Rosenbrock"):
        n_params = int(name.split()[1].split("-")[0])
        coarse, (log_z, mean) = rosenbrock_reference(n_params, 3000)[0], rosenbrock_reference(n_params, 5000)
        return {"log_z": log_z, "log_z_error": abs(log_z - coarse), "mean": mean.tolist()}
    if name == "circle":
        log_z, mean = by_cells(problem(name))
        return {"log_z": log_z, "mean": mean.tolist()}
    if not name.startswith("SSF"):
        raise ValueError(f"problem is {name!r}; allowed: Rosenbrock n-D, circle, SSF n Gaussians (others are closed)")
    if name == "SSF 1 Gaussian" and not by_tempering:
        return by_importance(problem(name), n_samples=1_000_000, seed=seed)
    one = partial(tempered, name, n_particles=n_particles, n_moves=n_moves)
    with ProcessPoolExecutor(workers, initializer=one_thread.settle) as pool:
        found = combine(list(pool.map(one, range(seed, seed + n_replicates))))
    return {**found, "n_particles": n_particles, "n_moves": n_moves}


def main(arguments: list[str] | None = None) -> None:
    """Compute what is asked for and add it to the file."""
    parser = argparse.ArgumentParser(prog="python -m nested_sampling.references", description=__doc__)
    parser.add_argument("--problems", nargs="+", required=True)
    parser.add_argument("--particles", type=int, default=4000)
    parser.add_argument("--moves", type=int, default=40, help="Metropolis steps a particle at every temperature")
    parser.add_argument("--replicates", type=int, default=8)
    parser.add_argument("--tempered", action="store_true", help="for one Gaussian too")
    parser.add_argument("--show", action="store_true", help="print the reference and write nothing")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args(arguments)
    for name in options.problems:
        start = time.perf_counter()
        found = compute(
            name,
            n_particles=options.particles,
            n_moves=options.moves,
            n_replicates=options.replicates,
            seed=options.seed,
            workers=options.workers,
            by_tempering=options.tempered,
        )
        command = shlex.join(
            ["python", "-m", "nested_sampling.references", *(sys.argv[1:] if arguments is None else arguments)]
        )
        table = json.loads(REFERENCES.read_text(encoding="utf-8")) if REFERENCES.exists() else {}
        table[name] = {**found, "command": command, "date": records.today()}
        if not options.show:
            records.write_json(REFERENCES, table)
        error = found.get("log_z_error", 0.0)
        print(f"{name}: log Z {found['log_z']:.4f} ± {error:.4f}, {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
