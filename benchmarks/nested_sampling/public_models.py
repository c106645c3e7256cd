"""Do posterior means hold? Models of posteriordb (Stan's database) against their published reference posteriors.

    python -m nested_sampling.public_models --out ../docs/results/public_models.json

Priors and likelihoods (up to a factor) are those of the Stan programs; `public_models.json` has data and references.
Where a program leaves a prior flat and improper, it is uniform here, over a range whose ends the posterior does not
touch. A deviation is a posterior mean less the reference's, in reference sds; each reference has its own error, 0.01.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from nested_sampling import one_thread, records

if __name__ == "__main__":
    one_thread.settle()  # before NumPy is loaded

import numpy as np
from scipy.special import logsumexp
from scipy.stats import gamma, halfcauchy, halfnorm, truncnorm

from nested_sampling.problems import FloatArray
from probewise import __version__
from probewise.errors import DoubtfulResultWarning
from probewise.nested import run
from probewise.priors import LogNormal, Normal, Uniform

TABLES = json.loads(Path(__file__).with_name("public_models.json").read_text(encoding="utf-8"))
SEEN = {name: {key: np.array(column) for key, column in table.items()} for name, table in TABLES["data"].items()}
_REFERENCE_ERROR = 0.01  # of a mean, in sds: each has 10,000 independent draws

Function = Callable[[FloatArray], FloatArray]


# ------------------------------------------------------------------ parts of the models


@np.errstate(all="ignore")
def gaussian(off: FloatArray, sd: FloatArray) -> FloatArray:
    """Log density of residuals, (n, n_data), up to a constant; -inf where it is no number: (n,)."""
    height = -0.5 * (off / sd) ** 2 - np.log(sd)
    return np.nan_to_num(height.sum(axis=1), nan=-np.inf, posinf=-np.inf, neginf=-np.inf)


def regression(products: FloatArray, theta: FloatArray) -> FloatArray:
    """Regress linearly, given the `products` of all columns, a constant first, the response last."""
    weight = np.column_stack([-theta[:, :-1], np.ones(len(theta))])
    square = np.einsum("ni,ij,nj->n", weight, products, weight)
    return np.asarray(-0.5 * square / theta[:, -1] ** 2 - products[0, 0] * np.log(theta[:, -1]))


def on(*columns: FloatArray) -> Function:
    """Regress the last column on the others and a constant."""
    table = np.stack([np.ones(len(columns[0])), *columns])
    return partial(regression, table @ table.T)


@np.errstate(all="ignore")
def followed(first: FloatArray, more: FloatArray, share: FloatArray) -> FloatArray:
    """Each value is an entry of `more`, (n, n_times), and a share (n,) of the value before: (n, 1 + n_times)."""
    out = [first]
    for column in more.T:
        out.append(column + share * out[-1])
    return np.stack(out, axis=1)


@np.errstate(all="ignore")
def integrated(slope: Callable[[float, FloatArray], FloatArray], y: FloatArray, step: float) -> FloatArray:
    """Solve y' = slope(t, y) by 120 Runge-Kutta steps of fourth order: y after every sixth, (20, *y.shape)."""
    out = []
    for t in step * np.arange(120):
        a = slope(t, y)
        b = slope(t + step / 2, y + step / 2 * a)
        c = slope(t + step / 2, y + step / 2 * b)
        y = y + step / 6 * (a + 2 * b + 2 * c + slope(t + step, y + step * c))
        out.append(y)
    return np.array(out[5::6])


def root_of_covariance(theta: FloatArray, nugget: FloatArray) -> FloatArray:
    """Cholesky root of a Gaussian process' covariance at its readings; scale and height are the first parameters."""
    x, scale, height = SEEN["gp_pois_regr"]["x"], theta[:, 0, None, None], theta[:, 1, None, None]
    smooth = height**2 * np.exp(-0.5 * ((x[:, None] - x) / scale) ** 2)
    return np.linalg.cholesky(smooth + nugget[:, None, None] * np.eye(len(x)))


# ------------------------------------------------------------------ log likelihoods and quantities, of (n, n_params)


def effects(theta: FloatArray) -> FloatArray:
    """Effects of eight schools, from their scores, mean and sd."""
    return np.column_stack([theta[:, 8:9] + theta[:, 9:] * theta[:, :8], theta[:, 8:]])


def eight_schools_noncentered(theta: FloatArray) -> FloatArray:
    return gaussian(SEEN["eight_schools"]["y"] - effects(theta)[:, :8], SEEN["eight_schools"]["sd"])


def eight_schools_centered(theta: FloatArray) -> FloatArray:
    read = gaussian(SEEN["eight_schools"]["y"] - theta[:, :8], SEEN["eight_schools"]["sd"])
    return read + gaussian(theta[:, :8] - theta[:, 8:9], theta[:, 9:])


def gp_regr(theta: FloatArray) -> FloatArray:
    root = root_of_covariance(theta, theta[:, 2])
    white = np.linalg.solve(root, SEEN["gp_pois_regr"]["y"][:, None])[:, :, 0]
    return gaussian(white, np.ones(1)) - np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)


def rates(theta: FloatArray) -> FloatArray:
    """Log rates of Poisson counts, from their scores."""
    root = root_of_covariance(theta, np.full(len(theta), 1e-10))
    return np.column_stack([theta[:, :2], (root @ theta[:, 2:, None])[:, :, 0]])


def gp_pois_regr(theta: FloatArray) -> FloatArray:
    log_rate = rates(theta)[:, 2:]
    return np.asarray((SEEN["gp_pois_regr"]["k"] * log_rate - np.exp(log_rate)).sum(axis=1))


def garch11(theta: FloatArray) -> FloatArray:
    off, (_, alpha0, alpha1, beta1) = SEEN["garch11"]["y"] - theta[:, :1], theta.T
    more = alpha0[:, None] + alpha1[:, None] * off[:, :-1] ** 2
    found = gaussian(off, np.sqrt(followed(np.full(len(theta), 0.25), more, beta1)))
    return np.where(alpha1 + beta1 < 1, found, -np.inf)


def arma11(theta: FloatArray) -> FloatArray:
    y, (mu, phi, share, sigma) = SEEN["arma11"]["y"], theta.T
    more = y[1:] - mu[:, None] - phi[:, None] * y[:-1]
    return gaussian(followed(y[0] - mu - phi * mu, more, -share), sigma[:, None])


def hmm_example(theta: FloatArray) -> FloatArray:
    first, mean = theta[:, :2, None], theta[:, 2:]
    step = np.log(np.concatenate([first, 1 - first], axis=2))  # from, to
    level = np.zeros_like(mean)
    for k, value in enumerate(SEEN["hmm_example"]["y"]):
        level = (logsumexp(level[:, :, None] + step, axis=1) if k else level) - 0.5 * (value - mean) ** 2
    return np.where((mean[:, 0] > 0) & (mean[:, 1] > mean[:, 0]), logsumexp(level, axis=1), -np.inf)


@np.errstate(all="ignore")
def lotka_volterra(theta: FloatArray) -> FloatArray:
    seen = np.log(list(SEEN["lotka_volterra"].values()))

    def slope(t: float, log_z: FloatArray) -> FloatArray:
        hare, lynx = np.exp(log_z)
        return np.stack([theta[:, 0] - theta[:, 1] * lynx, theta[:, 3] * hare - theta[:, 2]])

    start = np.log(theta[:, 4:6].T)
    path = np.concatenate([start[None], integrated(slope, start, 1 / 6)])
    return gaussian(seen[0] - path[:, 0].T, theta[:, 6:7]) + gaussian(seen[1] - path[:, 1].T, theta[:, 7:])


@np.errstate(all="ignore")
def one_comp_mm_elim_abs(theta: FloatArray) -> FloatArray:
    k_a, k_m, v_m, sigma = theta.T

    def slope(t: float, c: FloatArray) -> FloatArray:
        return np.asarray(15 * k_a * np.exp(-k_a * t) - v_m / 2 * c / (k_m + c))  # 30 mg in 2 l

    path = integrated(slope, np.zeros(len(theta)), 1 / 12)
    return gaussian(np.log(SEEN["one_comp_mm_elim_abs"]["C_hat"]) - np.log(path.T), sigma[:, None])


def models() -> dict[str, tuple[Function, list[Any], Function | None]]:
    """Give log likelihood, priors, and what the reference has if not the parameters, by posteriordb's names."""
    y, wide = SEEN["arK"]["y"], [Uniform(-b, b) for b in (200.0, 50.0, 5.0)]
    lags = [y[5 - k : len(y) - k] for k in (1, 2, 3, 4, 5, 0)]
    logs = [column if name == "group" else np.log(column) for name, column in SEEN["logmesquite"].items()]
    score, top, scale = Normal(0.0, 1.0), Normal(0.0, 5.0), halfcauchy(scale=2.5)
    rate, share = truncnorm(-2, np.inf, loc=1, scale=0.5), truncnorm(-1, np.inf, loc=0.05, scale=0.05)
    process, noise = [gamma(25, scale=0.25), halfnorm(scale=2)], LogNormal(np.exp(-1.0), 1.0)
    unit, size, line = Uniform(0.0, 1.0), LogNormal(10.0, 1.0), on(np.arange(3952.0, 4014.0), SEEN["kilpisjarvi"]["y"])
    return {
        "eight_schools_noncentered": (eight_schools_noncentered, [score] * 8 + [top, halfcauchy(scale=5)], effects),
        "eight_schools_centered": (
            eight_schools_centered,
            [Uniform(-100.0, 100.0)] * 8 + [top, halfcauchy(scale=5)],
            None,
        ),
        "gp_regr": (gp_regr, [*process, halfnorm()], None),
        "gp_pois_regr": (gp_pois_regr, process + [score] * 11, rates),
        "arK": (on(*lags), [Normal(0.0, 10.0)] * 6 + [scale], None),
        "arma11": (arma11, [Normal(0.0, 10.0), Normal(0.0, 2.0), Normal(0.0, 2.0), scale], None),
        "garch11": (garch11, [Uniform(-50.0, 50.0), Uniform(0.0, 50.0), unit, unit], None),
        "hmm_example": (hmm_example, [unit, unit, Normal(3.0, 1.0), Normal(10.0, 1.0)], None),
        "lotka_volterra": (lotka_volterra, [rate, share, rate, share, size, size, noise, noise], None),
        "one_comp_mm_elim_abs": (one_comp_mm_elim_abs, [halfcauchy()] * 4, None),
        "kidscore_momhsiq": (partial(regression, SEEN["kidscore_momhsiq"]["products"]), [*wide, scale], None),
        "logmesquite": (on(*logs), [Uniform(-20.0, 20.0)] * 7 + [Uniform(0.0, 10.0)], None),
        "kilpisjarvi": (line, [Normal(9.31290322580645, 100.0), Normal(0.0, 1 / 30), Uniform(0.0, 10.0)], None),
    }


# ------------------------------------------------------------------ measurement


def measure(name: str, seeds: range, n_live: int) -> dict[str, Any]:
    """Run a model from several seeds and compare its posteriors with the reference.

    `n_eff_by_scatter`: from the mean square of the deviations, of the parameter where it is greatest.
    """
    log_likelihood, priors, quantities = models()[name]
    reference = TABLES["reference"]["eight_schools" if name.startswith("eight") else name]
    begun, deviations, sd_ratios, n_eff, doubts = time.process_time(), [], [], [], []
    for seed in seeds:
        result = run(log_likelihood, priors, vectorized=True, rng=np.random.default_rng(seed), n_live=n_live)
        values = result.theta if quantities is None else quantities(result.theta)
        mean = result.weight @ values
        deviations.append((mean - reference["mean"]) / reference["sd"])
        sd_ratios.append(np.sqrt(result.weight @ (values - mean) ** 2) / reference["sd"])
        n_eff.append(result.n_eff)
        doubts += result.warnings
    farthest, allowed = np.abs(deviations).max(axis=1), 4 / np.sqrt(n_eff)
    square = np.square(deviations).mean(axis=0).max() - _REFERENCE_ERROR**2
    return {
        "model": name,
        "parameters": len(priors),
        "largest_deviation": round(float(farthest.max()), 3),
        "runs_within_allowed": int((farthest <= allowed).sum()),
        "n_eff": round(float(np.median(n_eff))),
        "n_eff_by_scatter": round(1 / square),
        "largest_sd_ratio": round(float(np.exp(np.abs(np.log(sd_ratios)).max())), 3),
        "cpu_s_per_run": round((time.process_time() - begun) / len(seeds), 2),
        "largest_deviation_of_runs": np.round(farthest, 3).tolist(),
        "allowed_of_runs": np.round(allowed, 3).tolist(),
        "mean_deviations": np.round(np.mean(deviations, axis=0), 3).tolist(),
        "mean_sd_ratios": np.round(np.mean(sd_ratios, axis=0), 3).tolist(),
        "doubts": doubts,
    }


def main() -> None:
    """Run every model."""
    parser = argparse.ArgumentParser(prog="python -m nested_sampling.public_models", description=__doc__)
    parser.add_argument("--models", nargs="+", default=list(models()))
    parser.add_argument("--live", type=int, default=400)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    warnings.simplefilter("ignore", DoubtfulResultWarning)  # doubts are in the file
    command = f"python -m nested_sampling.public_models {shlex.join(sys.argv[1:])}"
    head, entries = {"version": __version__, "date": records.today(), "command": command}, []
    for name in options.models:
        entries.append(measure(name, range(options.first, options.first + options.seeds), options.live))
        print(*(f"{key} {value}" for key, value in list(entries[-1].items())[:8]), sep=", ", flush=True)
        records.write_json(options.out, head | {"seeds": options.seeds, "n_live": options.live, "models": entries})


if __name__ == "__main__":
    main()
