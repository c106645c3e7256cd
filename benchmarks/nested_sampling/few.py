"""For slow likelihoods: evaluations and errors of `nested.run_in_few_calls` over many seeds, beside the best peer's.

    python -m nested_sampling.few --seeds 20 --out docs/results/nested_few.json

Each problem is asked for the error that its best correct peer claims. Two ratios to that peer: of evaluations, which
is fair where the error was reached, and of evaluations times squared claimed error, the cost of an error of one nat.
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

from nested_sampling.problems import problem
from nested_sampling.sampler import Counted
from nested_sampling.seeds import document
from probewise.errors import DoubtfulResultWarning
from probewise.nested import run_in_few_calls

# The best correct peer's evaluations and claimed error, one run each, 2026-11-21 and before; of nestle the product of
# evaluations and squared error is known, which is put here at an error of 0.2.
PEERS: dict[str, tuple[str, float, float]] = {
    "circle": ("nautilus", 23_000, 0.01),
    "shells 2-D": ("nautilus", 48_000, 0.01),
    "eggbox": ("UltraNest", 21_000, 0.19),
    "Rosenbrock 2-D": ("nautilus", 15_000, 0.01),
    "Rosenbrock 5-D": ("nestle", 1936 / 0.2**2, 0.2),
    "Gaussian 10-D": ("nestle", 1324 / 0.2**2, 0.2),
}


def measure(name: str, seeds: range) -> dict[str, Any]:
    """Run one problem for every seed."""
    known = problem(name)
    peer, evaluations, wanted = PEERS[name]
    rows = []
    for seed in seeds:
        counted = Counted(known)
        found = run_in_few_calls(counted, rng=np.random.default_rng([seed, 28]), error=wanted)
        error = float(np.hypot(found.log_z_error, known.log_z_error))
        rows.append(((found.log_z - known.log_z) / error, error, counted.n_evaluations, found.run is None, found.sound))
    z, error, n_evaluations, drawn, sound = (np.array(column) for column in zip(*rows, strict=True))
    work = float(np.mean(n_evaluations) * np.mean(error**2))
    return {
        "problem": name,
        "wanted": wanted,
        "evaluations": round(float(n_evaluations.mean())),
        "claimed_error": round(float(np.sqrt(np.mean(error**2))), 4),
        "reached": int((error <= 1.2 * wanted).sum()),
        "by_draws": int(drawn.sum()),
        "sound": int(sound.sum()),
        "peer": peer,
        "evaluations_ratio": round(float(n_evaluations.mean()) / evaluations, 2),
        "work_ratio": round(work / (evaluations * wanted**2), 2),
        "mean_z": round(float(z.mean()), 2),
        "sd_z": round(float(z.std(ddof=1)), 2),
        "worst_z": round(float(np.abs(z).max()), 2),
        "z": [round(float(one), 2) for one in z],
        "errors": [round(float(one), 4) for one in error],
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Measure every problem and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", default=list(PEERS))
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args(argv)
    warnings.simplefilter("ignore", DoubtfulResultWarning)
    rows = []
    for name in arguments.problems:
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        rows.append(measure(name, seeds))
        print(rows[-1], flush=True)
    written = document("few", argv, arguments.seeds, rows)
    records.write_json(arguments.out, written)
    return 0


if __name__ == "__main__":
    sys.exit(main())
