"""Measure this project's sampler against the size of a problem.

    python -m nested_sampling.scaling --out docs/results/nested_scaling.json
    python -m nested_sampling.scaling --out docs/results/nested_scaling.json --quick     # a few minutes

Cost against dimension (a correlated Gaussian), readings (the SSF of one Gaussian, its scans denser and denser),
live points (the same Gaussian in ten dimensions) and memory against iterations (a Gaussian run far past its end).
Every point is a process of its own, on one core; points already in the file are measured again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import Any

from nested_sampling import one_thread, records

if __name__ == "__main__":
    one_thread.settle()  # before NumPy is loaded

import numpy as np

from nested_sampling import ssf as ssf_problem
from nested_sampling.one import cpu_seconds, peak_megabytes
from nested_sampling.ours import ours_result
from nested_sampling.problems import Known, box, gaussian
from nested_sampling.sampler import Counted
from probewise.nested import NestedResult, RoundSummary, run

_FOLDER = Path(__file__).resolve().parent.parent

SIZES: dict[str, tuple[int, ...]] = {
    "dimension": (2, 3, 5, 8, 12, 20, 30),
    "readings": (100, 316, 1000, 3162, 10_000, 31_623, 100_000),
    "live points": (50, 150, 500, 1500, 5000),
    "iterations": (1000, 3000, 10_000, 30_000, 100_000),
}
QUICK: dict[str, tuple[int, ...]] = {
    "dimension": (2, 5, 10),
    "readings": (100, 1000),
    "live points": (50, 150, 500),
    "iterations": (1000, 3000, 10_000),
}


def problem_of(study: str, size: int) -> Known:
    """Make the problem of a point of a study."""
    if study == "dimension":
        return gaussian(size, correlation=0.9)
    if study == "live points":
        return gaussian(10, correlation=0.9)
    if study == "readings":
        posed = ssf_problem.problem(1, n_per_scan=max(10, round((size - 4) / 4)))
        return Known(posed.prior, posed.log_likelihood, float("nan"))
    # Twenty dimensions leave room to shrink: after 100 nats each has shrunk by five.
    return Known(box(20, -5.0, 5.0), lambda theta: -0.5 * (theta**2).sum(axis=1), float("nan"))


def measure(study: str, size: int, n_live: int) -> dict[str, Any]:
    """Measure one point in this process."""
    counted = Counted(problem_of(study, size))
    counted.log_likelihood(counted.prior.from_unit_cube(np.full((4, counted.n_params), 0.4)))
    if study == "iterations":
        return {"size": size, **_memory(counted, size, n_live)}
    n_live = size if study == "live points" else n_live
    counted.n_evaluations = 0
    base, before = peak_megabytes(), cpu_seconds()
    result = ours_result(counted, 0, n_live)
    cpu_s = cpu_seconds() - before
    return {
        "size": size,
        "n_params": counted.n_params,
        "n_live": n_live,
        "log_z_error": round(result.log_z_error, 4),
        "information": round(result.information, 3),
        "n_evaluations": counted.n_evaluations,
        "per_live_point_and_nat": round(counted.n_evaluations / n_live / result.information, 2),
        "cpu_s": round(cpu_s, 3),
        # Beside what the interpreter, the libraries and the problem already held.
        "more_mb": round(peak_megabytes() - base, 1),
    }


def _memory(problem: Counted, n_dead: int, n_live: int) -> dict[str, Any]:
    """Trace the peak of memory up to `n_dead` iterations, beside what the result itself holds."""

    def stop(state: RoundSummary) -> str | None:
        return f"{n_dead} iterations" if state.n_dead >= n_dead else None

    tracemalloc.start()
    result = run(problem, rng=np.random.default_rng(0), n_live=n_live, stop=stop, max_cost=1.0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    stored = _stored_bytes(result)
    return {
        "n_live": n_live,
        "n_dead": result.n_dead,
        "stored_mb": round(stored / 2**20, 3),
        "peak_mb": round(peak / 2**20, 3),
        "beside_mb": round((peak - stored) / 2**20, 3),
    }


def _stored_bytes(result: NestedResult) -> int:
    return sum(value.nbytes for value in vars(result).values() if isinstance(value, np.ndarray))


def in_a_process(study: str, size: int, n_live: int) -> dict[str, Any]:
    """Measure one point in a process of its own."""
    command = [sys.executable, "-m", "nested_sampling.scaling", "--point", study, str(size), "--live", str(n_live)]
    path = os.pathsep.join([str(_FOLDER), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, **one_thread.VARIABLES, "PYTHONPATH": path}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{study} {size} failed: {done.stderr.strip()[-500:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def main(arguments: list[str] | None = None) -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m nested_sampling.scaling", description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--studies", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--live", type=int, default=300)
    parser.add_argument("--quick", action="store_true", help="few small sizes")
    parser.add_argument("--point", nargs=2, metavar=("STUDY", "SIZE"), help="one point, here; prints its line")
    options = parser.parse_args(arguments)
    if options.point:
        print(json.dumps(measure(options.point[0], int(options.point[1]), options.live)))
        return
    if options.out is None:
        parser.error("--out is missing")
    from probewise import __version__

    table = json.loads(options.out.read_text(encoding="utf-8")) if options.out.exists() else {}
    studies = table.get("studies", {})
    command = f"python -m nested_sampling.scaling --live {options.live}" + (" --quick" if options.quick else "")
    for study in options.studies:
        points = []
        for size in (QUICK if options.quick else SIZES)[study]:
            points.append(in_a_process(study, size, options.live))
            print(f"{study} {size}: {points[-1]}", flush=True)
            studies[study] = {
                "command": command,
                "date": records.today(),
                "version": __version__,
                "points": list(points),
            }
            records.write_json(options.out, {"studies": studies})


if __name__ == "__main__":
    main()
