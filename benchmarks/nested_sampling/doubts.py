"""Does the sampler know when it is wrong? Hard problems, many seeds: who is off, and who says so.

    python -m nested_sampling.doubts --first 1000 --seeds 20 --workers 2 --out doubts.jsonl
    python -m nested_sampling.doubts summarise doubts.jsonl --out ../docs/results/nested_doubts.json

A run is off where its log Z is further from the truth than three of its own errors. Of the runs that are off, at
least 95 % should carry a doubt; of the others, at most 3 %. The campaign goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import warnings
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from nested_sampling import one_thread, records

if __name__ == "__main__":
    one_thread.settle()  # before NumPy is loaded

import numpy as np
from scipy.stats import binomtest

from nested_sampling.hard import HARD
from nested_sampling.problems import Known, problem
from probewise.errors import DoubtfulResultWarning
from probewise.nested import run

OFF = 3.0


def known(name: str) -> Known:
    """Find a problem in the bank, else among the benchmark's others."""
    return HARD[name]() if name in HARD else problem(name)


def one(name: str, seed: int, n_live: int, max_cost: float) -> dict[str, Any]:
    """Run once."""
    posed = known(name)
    begun = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        result = run(posed, rng=np.random.default_rng([seed, 28]), n_live=n_live, max_cost=max_cost)
    return {
        "problem": name,
        "seed": seed,
        "n_live": n_live,
        "log_z": result.log_z,
        "log_z_error": result.log_z_error,
        "z": (result.log_z - posed.log_z) / math.hypot(result.log_z_error, posed.log_z_error),
        "checked": None if result.check is None else [result.check.log_z, result.check.log_z_error],
        "n_check": 0 if result.check is None else result.check.n_calls,
        "memory": result.memory,
        "information": result.information,
        "insertion_p_value": result.insertion_p_value,
        "n_evaluations": result.n_calls,
        "cpu_s": round(time.process_time() - begun, 2),
        "doubts": list(result.warnings),
    }


def _interval(n_hits: int, n: int) -> list[float]:
    """Return Wilson's 95 % interval of a share."""
    return [round(p, 3) for p in binomtest(n_hits, n).proportion_ci(method="wilson")] if n else [0.0, 1.0]


def summarise(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Count who is off and who says so."""
    off = [line for line in lines if abs(line["z"]) > OFF]
    sound = [line for line in lines if abs(line["z"]) <= OFF]
    z = np.array([line["z"] for line in lines])
    n_off, n_sound = (sum(bool(line["doubts"]) for line in part) for part in (off, sound))
    return {
        "runs": len(lines),
        "mean_z": round(float(z.mean()), 2),
        "sd_z": round(float(z.std(ddof=1)), 2) if len(z) > 1 else None,
        "off": len(off),
        "off_and_doubted": n_off,
        "sound": len(sound),
        "sound_but_doubted": n_sound,
        "share_of_off_doubted": _interval(n_off, len(off)),
        "share_of_sound_doubted": _interval(n_sound, len(sound)),
        "claimed_error": round(float(np.median([line["log_z_error"] for line in lines])), 3),
        "memory": round(float(np.median([line["memory"] for line in lines])), 2),
        "n_evaluations": round(float(np.median([line["n_evaluations"] for line in lines]))),
        "cpu_s": round(float(np.median([line["cpu_s"] for line in lines])), 2),
    }


def summary_of(files: Iterable[Path]) -> list[dict[str, Any]]:
    """Sum up files, one entry a problem, and all of them together."""
    lines = [line for file in files for line in records.read_lines(file)]
    names = list(dict.fromkeys(line["problem"] for line in lines))
    entries = [{"problem": n, **summarise([line for line in lines if line["problem"] == n])} for n in names]
    return [*entries, {"problem": "all", **summarise(lines)}]


def table(entries: Iterable[dict[str, Any]]) -> str:
    """Lay out the summary as markdown."""
    head = ("problem", "runs", "mean / sd of z", "off, of them doubted", "sound, of them doubted", "claimed error")
    rows = [
        (
            e["problem"],
            str(e["runs"]),
            f"{e['mean_z']:+.2f} / {math.nan if e['sd_z'] is None else e['sd_z']:.2f}",
            f"{e['off']}, {e['off_and_doubted']}",
            f"{e['sound']}, {e['sound_but_doubted']}",
            f"{e['claimed_error']:.2f}",
            f"{e['memory']:.1f}",
            f"{e['n_evaluations']:,}",
            f"{e['cpu_s']:.1f}",
        )
        for e in entries
    ]
    return records.markdown_table((*head, "memory", "evaluations", "cpu s"), rows)


def main(given: list[str] | None = None) -> None:
    """Run seeds, or sum files up."""
    arguments = sys.argv[1:] if given is None else given
    parser = argparse.ArgumentParser(prog="python -m nested_sampling.doubts", description=__doc__)
    if arguments[:1] == ["summarise"]:
        records.summarise(arguments[1:], summary_of, table)
        return
    parser.add_argument("--problems", nargs="+", default=list(HARD))
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--live", type=int, default=300)
    parser.add_argument("--max-cost", type=float, default=5.0, help="1: no check")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    # Seed by seed, so that an interruption leaves every problem with about as many.
    wanted = product(range(options.first, options.first + options.seeds), options.problems)
    jobs = {(name, seed, options.live): (name, seed, options.live, options.max_cost) for seed, name in wanted}
    records.complete(options.out, jobs, ("problem", "seed", "n_live"), one, options.workers)
    print(table(summary_of([options.out])))


if __name__ == "__main__":
    main()
