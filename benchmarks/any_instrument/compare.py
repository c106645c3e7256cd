"""Compare `probewise.Inquiry` with optbayesexpt (NIST), truth by truth.

    cd benchmarks
    python -m any_instrument.compare resonance --truths 200 \\
        --runs ../docs/results/any_instrument.jsonl --out ../docs/results/any_instrument.json
    python -m any_instrument.compare wall --truths 200 \\
        --runs ../docs/results/any_instrument_wall.jsonl --out ../docs/results/any_instrument_wall.json

Every truth is a line of `--runs` as it ends; the same command goes on from there.

All engines get the same model, the same prior, the same settings and the same known noise; truth k is drawn from the
prior, and all read it with the same noise (the generators are seeded by k). A run ends when the posterior sds are
below the goals, or after the problem's greatest number of readings. Per engine: how many runs ended, readings (mean
and standard error, median; a run that did not end counts as that greatest number), how often the central 95 % intervals
at the end hold the truth, runs that are sure and wrong (ended, and off by more than five of their own sds), processor
time per reading, and lines of code that a user writes.

optbayesexpt is run at its defaults, and with what its authors recommend for reliability and quality of choices: no
contraction on resampling, its full utility, more draws, more particles. It is not on every package index; without it
the script says so and ends, with exit code 0. It draws in part from generators of its own, which
no seed reaches, so the rows of its full utility repeat on average only. Processor times are of one busy machine:
compare within one file only, and hold numeric libraries to one thread (OMP_NUM_THREADS=1, OPENBLAS_NUM_THREADS=1).
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
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import probewise
from any_instrument.problem import Engine, Problem
from any_instrument.range_finder import WALL
from any_instrument.resonance import RESONANCE

PROBLEMS = {"resonance": RESONANCE, "wall": WALL}
WRONG_SDS = 5.0


def run(problem: Problem, engine: Engine, k: int) -> dict[str, Any]:
    """Look for truth k."""
    truth = problem.draw(np.random.default_rng([k, 7]))
    noise = np.random.default_rng([k, 8])
    began = time.process_time()
    found = engine(lambda setting: problem.read(truth, setting, noise), np.random.default_rng([k, 9]))
    took = time.process_time() - began
    true = np.array([truth[name] for name in problem.goals])
    return {
        "truth": k,
        "readings": found.n_readings,
        "ended": bool((found.sd <= list(problem.goals.values())).all()),
        "off_sds": ((found.mean - true) / np.maximum(found.sd, 1e-12)).tolist(),
        "held": ((found.low <= true) & (true <= found.high)).tolist(),
        "cpu_s": took / found.n_readings,
    }


def summary(problem: Problem, rows: list[dict[str, Any]]) -> dict[str, object]:
    """Summarise the runs of one engine."""
    readings = np.array([row["readings"] if row["ended"] else problem.most_readings for row in rows], dtype=float)
    held = np.array([row["held"] for row in rows])
    wrong = [row["ended"] and max(map(abs, row["off_sds"])) > WRONG_SDS for row in rows]
    return {
        "runs": len(rows),
        "ended": int(sum(row["ended"] for row in rows)),
        "readings_mean": round(float(readings.mean()), 2),
        "readings_se": round(float(readings.std(ddof=1) / np.sqrt(len(rows))), 2),
        "readings_median": float(np.median(readings)),
        "held": dict(zip(problem.goals, held.sum(axis=0).tolist(), strict=True)),
        "sure_and_wrong": int(sum(wrong)),
        "cpu_ms_per_reading": round(1000 * float(np.median([row["cpu_s"] for row in rows])), 1),
    }


def difference(problem: Problem, first: list[dict[str, Any]], second: list[dict[str, Any]]) -> dict[str, float]:
    """Compare readings truth by truth."""
    most = problem.most_readings
    counts = [[row["readings"] if row["ended"] else most for row in rows] for rows in (first, second)]
    apart = np.subtract(*counts).astype(float)
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
    parser.add_argument("problem", choices=list(PROBLEMS))
    parser.add_argument("--truths", type=int, default=200, metavar="N")
    parser.add_argument("--runs", type=Path, required=True, metavar="FILE.jsonl")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    try:
        package = importlib.import_module("optbayesexpt")
    except ImportError as error:
        print(f"skipped: there is nothing to compare with ({error}); github.com/usnistgov/optbayesexpt has it")
        sys.exit(0)
    warnings.simplefilter("ignore")  # of both: their effects are in the figures
    problem = PROBLEMS[arguments.problem]
    known = arguments.runs.read_text().splitlines() if arguments.runs.exists() else []
    truths = [json.loads(line) for line in known][: arguments.truths]
    with arguments.runs.open("a") as file:
        for k in tqdm(range(len(truths), arguments.truths)):
            truths.append({name: run(problem, engine, k) for name, engine in problem.engines.items()})
            file.write(json.dumps(truths[-1]) + "\n")
            file.flush()
    rows = {name: [truth[name] for truth in truths] for name in problem.engines}
    first, *others = problem.engines
    found = {
        "command": f"python -m any_instrument.compare {arguments.problem} --truths {arguments.truths}",
        "date": date.today().isoformat(),
        "probewise": probewise.__version__,
        "optbayesexpt": getattr(package, "__version__", "unknown"),
        "seeds": "truth [k, 7], noise [k, 8], engine [k, 9], k from 0",
        "user_lines": {name: lines(engine) for name, engine in list(problem.engines.items())[:2]},
        "engines": {name: summary(problem, each) for name, each in rows.items()},
        f"readings of {first} less those of": {name: difference(problem, rows[first], rows[name]) for name in others},
    }
    arguments.out.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
