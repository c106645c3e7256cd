"""Does a second run, from a prior near what the first has found, weigh better, and does its error hold?

    python -m nested_sampling.again --seeds 24 --out docs/results/nested_again.json

For each problem and run: mean and sd of z = (log Z - truth) / claimed error over the seeds, beside the limits that
standard normal numbers keep to; the claimed error and the evaluations of one run, on the average. The second run's
evaluations come on top of the first's.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nested_sampling import one_thread, records

if __name__ == "__main__":
    one_thread.settle()  # before NumPy is loaded

import numpy as np

from nested_sampling.problems import Known, problem
from nested_sampling.seeds import document
from probewise.errors import DoubtfulResultWarning
from probewise.nested import NestedResult, repartitioned, run

PROBLEMS = (
    "Gaussian 10-D",
    "shells 2-D",
    "Rosenbrock 5-D",
    "eggbox",
    "LogGamma 10-D",
    "SSF 1 Gaussian",
    "SSF 2 Gaussians",
)


def _summary(known: Known, runs: Sequence[NestedResult]) -> dict[str, Any]:
    error = np.array([np.hypot(r.log_z_error, known.log_z_error) for r in runs])
    z = (np.array([r.log_z for r in runs]) - known.log_z) / error
    return {
        "mean_z": round(float(z.mean()), 2),
        "sd_z": round(float(z.std(ddof=1)), 2),
        "claimed_error": round(float(np.mean([r.log_z_error for r in runs])), 3),
        "evaluations": round(float(np.mean([r.n_calls for r in runs]))),
    }


def measure(name: str, n_seeds: int, n_live: int) -> dict[str, Any]:
    """Run one problem twice for every seed."""
    known = problem(name)
    first, second = [], []
    for seed in range(n_seeds):
        rng = np.random.default_rng([seed, 24])
        first.append(run(known, rng=rng, n_live=n_live, max_cost=1.0))
        nearer = repartitioned(known, first[-1].samples(2000, rng=rng))
        second.append(run(nearer, rng=rng, n_live=n_live, max_cost=1.0))
    return {"problem": name, "first": _summary(known, first), "again": _summary(known, second)}


def main(argv: Sequence[str] | None = None) -> int:
    """Measure every problem and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS))
    parser.add_argument("--seeds", type=int, default=24)
    parser.add_argument("--live", type=int, default=100)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args(argv)
    warnings.simplefilter("ignore", DoubtfulResultWarning)
    rows = []
    for name in arguments.problems:
        rows.append(measure(name, arguments.seeds, arguments.live))
        print(rows[-1], flush=True)
    written = document("again", argv, arguments.seeds, rows, n_live=arguments.live)
    records.write_json(arguments.out, written)
    return 0


if __name__ == "__main__":
    sys.exit(main())
