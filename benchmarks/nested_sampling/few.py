"""For slow likelihoods: few live points, then importance sampling: evaluations and errors over many seeds.

    python -m nested_sampling.few --seeds 20 --out docs/results/nested_few.json

Each run has few live points and no check; `refine` then sharpens it, and its draws count as evaluations. Where the
refinement is doubtful the run's own evidence is used. Work is evaluations times the square of the claimed error, and
its ratio that to the best correct peer's.
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
from nested_sampling.samplers import Counted
from nested_sampling.seeds import document
from probewise.errors import DoubtfulResultWarning
from probewise.nested import refine, run

# The best correct peer's evaluations times its claimed error squared: one run each, 2026-11-21 and before.
PEERS: dict[str, tuple[str, float]] = {
    "circle": ("nautilus", 2.3),
    "shells 2-D": ("nautilus", 4.8),
    "eggbox": ("UltraNest", 758.0),
    "Rosenbrock 2-D": ("nautilus", 1.5),
    "Rosenbrock 5-D": ("nestle", 1936.0),
    "Gaussian 10-D": ("nestle", 1324.0),
}


def measure(name: str, seeds: range, n_live: int, n_draws: int) -> dict[str, Any]:
    """Run one problem for every seed."""
    known = problem(name)
    rows = []
    for seed in seeds:
        counted = Counted(known)
        rng = np.random.default_rng([seed, 28])
        first = run(counted, rng=rng, n_live=n_live, max_cost=1.0)
        searched = counted.n_evaluations
        sharp = refine(first, counted, rng=rng, n_draws=n_draws)
        used = sharp if sharp.sound else first
        error = float(np.hypot(used.log_z_error, known.log_z_error))
        rows.append(
            ((used.log_z - known.log_z) / error, used.log_z_error, counted.n_evaluations, searched, sharp.sound)
        )
    z, error, n_evaluations, searched, sound = (np.array(column) for column in zip(*rows, strict=True))
    work = float(np.mean(n_evaluations) * np.mean(error**2))
    return {
        "problem": name,
        "evaluations": round(float(n_evaluations.mean())),
        "of_these_the_search": round(float(searched.mean())),
        "claimed_error": round(float(np.sqrt(np.mean(error**2))), 4),
        "work": round(work, 2),
        "peer": PEERS[name][0] if name in PEERS else None,
        "work_ratio": round(work / PEERS[name][1], 3) if name in PEERS else None,
        "sound": int(sound.sum()),
        "mean_z": round(float(z.mean()), 2),
        "sd_z": round(float(z.std(ddof=1)), 2),
        "worst_z": round(float(np.abs(z).max()), 2),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Measure every problem and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", default=list(PEERS))
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--live", type=int, default=100)
    parser.add_argument("--draws", type=int, default=4000)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args(argv)
    warnings.simplefilter("ignore", DoubtfulResultWarning)
    rows = []
    for name in arguments.problems:
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        rows.append(measure(name, seeds, arguments.live, arguments.draws))
        print(rows[-1], flush=True)
    written = document("few", argv, arguments.seeds, rows, n_live=arguments.live, n_draws=arguments.draws)
    records.write_json(arguments.out, written)
    return 0


if __name__ == "__main__":
    sys.exit(main())
