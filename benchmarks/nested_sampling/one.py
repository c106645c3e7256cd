"""Run one sampler on one problem in this process and print one JSON line: what `compare` starts for every run.

The clock starts after the imports and one evaluation, and stops when the sampler returns.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import signal
import sys
import time
import warnings
from typing import Any

from nested_sampling import one_thread

one_thread.settle()  # before NumPy is loaded


def cpu_seconds() -> float:
    """Give the cpu time of this process and all its threads."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def peak_megabytes() -> float:
    """Give the most memory that this process has held, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024.0 if sys.platform != "darwin" else 1024.0**2)


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problem", required=True)
    parser.add_argument("--sampler", required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--live", type=int, default=0)
    parser.add_argument("--cap", type=float, required=True)
    options = parser.parse_args()
    # Libraries write on stdout as they please; the record goes to the descriptor it was.
    out = os.dup(1)
    os.dup2(2, 1)
    record = measure(options.problem, options.sampler, options.seed, options.live or None, options.cap, out)
    write(out, record)
    # Libraries may leave threads behind.
    os._exit(0)


def write(out: int, record: dict[str, Any]) -> None:
    """Write one line."""
    os.write(out, json.dumps(record).encode() + b"\n")


def measure(
    problem_name: str, sampler_name: str, seed: int, n_live: int | None, cap: float, out: int
) -> dict[str, Any]:
    """Run within `cap` seconds of cpu time; past them the process writes what it knows and ends."""
    import numpy as np

    from nested_sampling.problems import problem
    from nested_sampling.sampler import Counted
    from nested_sampling.samplers import sampler

    warnings.simplefilter("ignore")
    chosen = sampler(sampler_name)
    known = problem(problem_name)
    n_live = n_live or known.n_live
    known.log_likelihood(known.prior.from_unit_cube(np.full((4, known.n_params), 0.4)))
    counted = Counted(known)
    used = cpu_seconds()

    def give_up(*_: object) -> None:
        write(out, {"status": "DNF", "n_evaluations": counted.n_evaluations, "cpu_s": round(cpu_seconds() - used, 3)})
        os._exit(0)

    signal.signal(signal.SIGXCPU, give_up)
    # A library that stays in compiled code hears no signal: the hard limit ends it.
    limit = math.ceil(used + cap)
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 60))
    before, began = cpu_seconds(), time.perf_counter()
    try:
        outcome = chosen.run(counted, seed, n_live)
    except Exception as error:
        return {"status": f"error: {error!r}"[:300], "n_evaluations": counted.n_evaluations}
    cpu_s, wall_s = cpu_seconds() - before, time.perf_counter() - began
    resource.setrlimit(resource.RLIMIT_CPU, (limit + 60, limit + 60))
    samples = outcome.samples(2000, seed)
    information = float(known.log_likelihood(samples).mean()) - outcome.log_z
    checks = []
    for check in known.checks:
        mean, sd = outcome.mean(check.function(outcome.theta))
        spread = math.hypot(sd / math.sqrt(outcome.n_eff), check.error)
        checks.append(round((mean - check.mean) / spread, 3) if spread > 0 else None)
    return {
        "status": "ok",
        "log_z": outcome.log_z,
        "log_z_error": outcome.log_z_error,
        "n_evaluations": outcome.n_evaluations,
        "cpu_s": round(cpu_s, 4),
        "wall_s": round(wall_s, 3),
        "n_live": outcome.n_live,
        "n_eff": round(outcome.n_eff, 1),
        "information": round(information, 3),
        "worst_check": max((abs(z) for z in checks if z is not None), default=None),
        "insertion_p_value": outcome.insertion_p_value,
        "doubts": list(outcome.doubts),
        "peak_mb": round(peak_megabytes(), 1),
    }


if __name__ == "__main__":
    main()
