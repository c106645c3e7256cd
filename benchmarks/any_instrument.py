"""Find the centre of a resonance: `probewise.Inquiry` beside optbayesexpt (NIST), reading by reading.

    python benchmarks/any_instrument.py --truths 200 \
        --runs docs/results/any_instrument.jsonl --out docs/results/any_instrument.json

Every truth is a line of `--runs` as it ends; the same command goes on from there.

Both get the same Lorentzian, the same prior, the same 301 settings and the same known noise; truth k is drawn from the
prior, and both read it with the same noise (the generators are seeded by k). A run ends when the posterior sd of the
centre is below 0.01, or after 400 readings. Per engine: how many runs ended, readings (mean and standard error,
median; a run that did not end counts as 400), how often the central 95 % interval at the end holds the truth, runs that
are sure and wrong (off by more than five of their own sds), processor time per reading, and lines of code that a user
writes.

optbayesexpt is run at its defaults, and with what its authors recommend for reliability and quality of choices: no
contraction on resampling, its full utility, more draws, more particles. It is not on every package index; without it
the script says so and ends, with exit code 0. It draws in part from generators of its own, which
no seed reaches, so its rows repeat on average only. Processor times are of one busy machine: compare within one file
only.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np
from tqdm import tqdm

import probewise
from probewise.priors import Normal, Uniform

GOAL = 0.01
NOISE_SD = 0.2
SETTINGS = np.linspace(1.5, 4.5, 301)
MOST_READINGS = 400
WRONG_SDS = 5.0

PRIOR = {
    "centre": Uniform(2.0, 4.0),
    "width": Uniform(0.02, 0.2),
    "height": Uniform(0.5, 2.0),
    "background": Normal(0.0, 0.5),
}

Instrument = Callable[[float], float]


@dataclass(frozen=True)
class Found:
    """How a run ended: readings, mean and sd of the centre, its 95 % interval."""

    n_readings: int
    mean: float
    sd: float
    low: float
    high: float


def ours(read: Instrument, rng: np.random.Generator) -> Found:
    """Find the centre with probewise."""

    def peak(p, x):
        return p["background"] + p["height"] / (1 + ((x - p["centre"]) / p["width"]) ** 2)

    inquiry = probewise.Inquiry(peak, PRIOR, SETTINGS, NOISE_SD, goal={"centre": GOAL}, rng=rng)
    while not inquiry.settled and len(inquiry.readings) < MOST_READINGS:
        inquiry.tell(read(inquiry.next()))
    posterior = inquiry.posterior
    low, high = posterior.interval(0.95)[:, 0]
    return Found(len(inquiry.readings), posterior.mean()[0], posterior.sd()[0], low, high)


def theirs(
    read: Instrument,
    rng: np.random.Generator,
    *,
    n_particles: int = 5000,
    kind: Callable[..., object] | None = None,  # of the benchmark
    **options: object,
) -> Found:
    """Find the centre with optbayesexpt."""
    from optbayesexpt import OptBayesExpt

    def peak(settings, parameters, constants):
        (x,) = settings
        centre, width, height, background = parameters
        return background + height / (1 + ((x - centre) / width) ** 2)

    samples = [marginal.from_unit(rng.random(n_particles)) for marginal in PRIOR.values()]
    experiment = (kind or OptBayesExpt)(peak, (SETTINGS,), samples, (), default_noise_std=NOISE_SD, **options)
    experiment.rng = rng
    n_readings = 0
    while experiment.std()[0] > GOAL and n_readings < MOST_READINGS:
        x = experiment.get_setting()
        experiment.pdf_update((x, read(x[0]), NOISE_SD))
        n_readings += 1
    order = np.argsort(experiment.particles[0])
    ladder = np.cumsum(experiment.particle_weights[order])
    low, high = experiment.particles[0][order][np.searchsorted(ladder, [0.025, 0.975])]
    return Found(n_readings, experiment.mean()[0], experiment.std()[0], low, high)


def theirs_at_best(read: Instrument, rng: np.random.Generator) -> Found:
    """Find the centre with optbayesexpt, without contraction, by its full utility from many draws and particles."""
    from optbayesexpt import OptBayesExpt

    class WithinPrior(OptBayesExpt):
        def enforce_parameter_constraints(self):
            columns = zip(self.particles, PRIOR.values(), strict=True)
            outside = ~np.isfinite(sum(marginal.log_prob(column) for column, marginal in columns))
            self.particle_weights[outside] = 0.0
            self.particle_weights /= self.particle_weights.sum()

    options = {"scale": False, "utility_method": "full_kld_utility", "n_draws": 100}
    return theirs(read, rng, n_particles=20_000, kind=WithinPrior, **options)


ENGINES = {"probewise": ours, "optbayesexpt, defaults": theirs, "optbayesexpt, full utility": theirs_at_best}


def run(engine: Callable[[Instrument, np.random.Generator], Found], k: int) -> dict[str, float]:
    """Look for the resonance of truth k."""
    drawing = np.random.default_rng([k, 7])
    centre, width, height, background = (float(m.from_unit(drawing.random())) for m in PRIOR.values())
    noise = np.random.default_rng([k, 8])

    def read(x: float) -> float:
        return background + height / (1 + ((x - centre) / width) ** 2) + NOISE_SD * noise.standard_normal()

    began = time.process_time()
    found = engine(read, np.random.default_rng([k, 9]))
    took = time.process_time() - began
    return {
        "truth": k,
        "readings": found.n_readings,
        "ended": bool(found.sd <= GOAL),
        "off_sds": float((found.mean - centre) / max(found.sd, 1e-12)),
        "held": bool(found.low <= centre <= found.high),
        "cpu_s": took / found.n_readings,
    }


def summary(rows: list[dict[str, float]]) -> dict[str, object]:
    """Summarise the runs of one engine."""
    readings = np.array([row["readings"] if row["ended"] else MOST_READINGS for row in rows], dtype=float)
    held = float(np.mean([row["held"] for row in rows]))
    return {
        "runs": len(rows),
        "ended": int(sum(row["ended"] for row in rows)),
        "readings_mean": round(float(readings.mean()), 2),
        "readings_se": round(float(readings.std(ddof=1) / np.sqrt(len(rows))), 2),
        "readings_median": float(np.median(readings)),
        "held_share": round(held, 4),
        "held_se": round(float(np.sqrt(held * (1 - held) / len(rows))), 4),
        "sure_and_wrong": int(sum(row["ended"] and abs(row["off_sds"]) > WRONG_SDS for row in rows)),
        "cpu_ms_per_reading": round(1000 * float(np.median([row["cpu_s"] for row in rows])), 1),
    }


def difference(first: list[dict[str, float]], second: list[dict[str, float]]) -> dict[str, float]:
    """Compare readings truth by truth."""
    apart = np.array([a["readings"] - b["readings"] for a, b in zip(first, second, strict=True)], dtype=float)
    return {
        "mean": round(float(apart.mean()), 2),
        "se": round(float(apart.std(ddof=1) / np.sqrt(len(apart))), 2),
    }


def lines(function: Callable[..., object]) -> int:
    """Count the lines of code of a function: no docstring, no blank lines, no imports, no signature."""
    body = inspect.getsource(function).split('"""')[-1].splitlines()
    return sum(bool(line.strip()) and " import " not in line for line in body)


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--truths", type=int, default=200, metavar="N")
    parser.add_argument("--runs", type=Path, required=True, metavar="FILE.jsonl")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    try:
        importlib.import_module("optbayesexpt")
    except ImportError as error:
        print(f"skipped: there is nothing to compare with ({error}); github.com/usnistgov/optbayesexpt has it")
        sys.exit(0)
    warnings.simplefilter("ignore")  # of both: their effects are in the figures
    known = arguments.runs.read_text().splitlines() if arguments.runs.exists() else []
    truths = [json.loads(line) for line in known][: arguments.truths]
    with arguments.runs.open("a") as file:
        for k in tqdm(range(len(truths), arguments.truths)):
            truths.append({name: run(engine, k) for name, engine in ENGINES.items()})
            file.write(json.dumps(truths[-1]) + "\n")
            file.flush()
    rows = {name: [truth[name] for truth in truths] for name in ENGINES}
    first, *others = ENGINES
    found = {
        "command": f"python benchmarks/any_instrument.py --truths {arguments.truths}",
        "date": date.today().isoformat(),
        "probewise": probewise.__version__,
        "seeds": "truth [k, 7], noise [k, 8], engine [k, 9], k from 0",
        "user_lines": {"probewise": lines(ours), "optbayesexpt": lines(theirs)},
        "engines": {name: summary(each) for name, each in rows.items()},
        f"readings of {first} less those of": {name: difference(rows[first], rows[name]) for name in others},
    }
    arguments.out.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
