"""Does the sampler know when it is wrong? Hard problems, many seeds: who is off, and who says so.

    python -m nested_sampling.doubts --first 1000 --seeds 20 --workers 2 --out doubts.jsonl
    python -m nested_sampling.doubts merged --kept runs --out merged.jsonl
    python -m nested_sampling.doubts summarise doubts.jsonl --out ../docs/results/nested_doubts.json

A run is off where its log Z is further from the truth than three of its own errors. Of the runs that are off, at
least 95 % should carry a doubt; of the others, at most 3 %. The campaign goes on where it was interrupted. With
`--keep FOLDER` the results are kept, and `merged` asks the same of merges of four of them, and of each one refined.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import product
from pathlib import Path
from typing import Any

from nested_sampling import one_thread, records

if __name__ == "__main__":
    one_thread.settle()  # before NumPy is loaded

import numpy as np

from nested_sampling.hard import HARD
from nested_sampling.problems import Known, problem
from probewise.errors import DoubtfulResultWarning
from probewise.nested import NestedResult, Weighted, merge, refine, run

OFF = 3.0


def known(name: str) -> Known:
    """Find a problem in the bank, else among the benchmark's others."""
    return HARD[name]() if name in HARD else problem(name)


def one(name: str, seed: int, n_live: int, max_cost: float, keep: Path | None) -> dict[str, Any]:
    """Run once, and keep the result where a folder is given."""
    posed = known(name)
    begun = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        result = run(posed, rng=np.random.default_rng([seed, 28]), n_live=n_live, max_cost=max_cost)
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        result.save(keep / f"{name} {seed}.npz")
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


def merged(kept: Path, together: int = 4) -> Iterator[dict[str, Any]]:
    """Merge the kept results of each problem, some at a time; then refine each result, problem by problem."""
    files = {name: sorted(kept.glob(f"{name} *.npz")) for name in HARD}
    for name, own in files.items():
        rng = np.random.default_rng([28, len(own)])
        for first in range(0, len(own) - together + 1, together):
            part = [NestedResult.load(file) for file in own[first : first + together]]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DoubtfulResultWarning)
                joined = merge(part, rng=rng)
            yield _told(
                name, joined, joined.warnings, what="merge", files=[file.stem for file in own[first : first + together]]
            )
    for number, name in product(range(max(map(len, files.values()))), HARD):
        if number < len(files[name]):
            result = NestedResult.load(files[name][number])
            found = refine(result, known(name), rng=np.random.default_rng([29, number]))
            yield _told(name, found, found.warnings, what="refine", files=[files[name][number].stem])


def _told(name: str, found: NestedResult | Weighted, doubts: Sequence[str], **more: Any) -> dict[str, Any]:
    posed = known(name)
    z = (found.log_z - posed.log_z) / math.hypot(found.log_z_error, posed.log_z_error)
    return {"problem": name, **more, "log_z_error": found.log_z_error, "z": z, "doubts": list(doubts)}


def wilson(n_hits: int, n: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share."""
    if n == 0:
        return 0.0, 1.0
    z, p = 1.96, n_hits / n
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return (middle - half) / (1 + z * z / n), (middle + half) / (1 + z * z / n)


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
        "share_of_off_doubted": [round(p, 3) for p in wilson(n_off, len(off))],
        "share_of_sound_doubted": [round(p, 3) for p in wilson(n_sound, len(sound))],
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
    if arguments[:1] == ["merged"]:
        parser.add_argument("--kept", type=Path, required=True)
        parser.add_argument("--out", type=Path, required=True)
        options = parser.parse_args(arguments[1:])
        with records.Lines(options.out) as lines:
            for line in merged(options.kept):
                lines.add(line)
        return
    if arguments[:1] == ["summarise"]:
        parser.add_argument("files", nargs="+", type=Path)
        parser.add_argument("--out", type=Path)
        options = parser.parse_args(arguments[1:])
        entries = summary_of(options.files)
        print(table(entries))
        if options.out:
            from probewise import __version__

            records.write_json(options.out, {"version": __version__, "date": records.today(), "problems": entries})
        return
    parser.add_argument("--problems", nargs="+", default=list(HARD))
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--live", type=int, default=300)
    parser.add_argument("--max-cost", type=float, default=5.0, help="1: no check")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder in which to keep the results")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    done = {(line["problem"], line["seed"], line["n_live"]) for line in records.read_lines(options.out)}
    seeds = range(options.first, options.first + options.seeds)
    # Seed by seed, so that an interruption leaves every problem with about as many.
    wanted = [(n, s, options.live) for s, n in product(seeds, options.problems)]
    with records.Lines(options.out) as lines, ProcessPoolExecutor(options.workers) as pool:
        running = [pool.submit(one, *key, options.max_cost, options.keep) for key in wanted if key not in done]
        for number, future in enumerate(as_completed(running), start=1):
            lines.add(future.result())
            if sys.stderr.isatty():
                print(f"\r{number} of {len(running)} runs", end="", file=sys.stderr, flush=True)
    print(table(summary_of([options.out])))


if __name__ == "__main__":
    main()
