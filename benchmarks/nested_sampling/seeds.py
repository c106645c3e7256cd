"""Does the error of log Z hold? Many seeds of one problem, and what a perfect sampler would show.

    python -m nested_sampling.seeds --problem eggbox --seeds 1000 --first 0 --workers 2 --out seeds/eggbox.jsonl
    python -m nested_sampling.seeds summarise seeds/*.jsonl --out docs/results/nested_seeds.json

A run's standardised residual is z = (log Z - truth) / its claimed error. Over n seeds of a perfect sampler z has mean
0 and sd 1, within limits that depend on n alone. Each seed is one line of the file, and seeds already there are not
repeated. The posterior is checked by means of known functions: `z` of such a mean is its distance from the truth over
the sd that its effective number of samples promises.
"""

from __future__ import annotations

import argparse
import math
import shlex
import sys
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from nested_sampling import one_thread, records

if __name__ == "__main__":
    one_thread.settle()  # before NumPy is loaded

import numpy as np
from scipy.stats import chi2, kstest, norm, t

from nested_sampling.one import cpu_seconds
from nested_sampling.ours import ours
from nested_sampling.problems import Known, problem
from nested_sampling.sampler import Counted

# Agreed limits where there are any: number of seeds -> most of abs(mean), least and most sd.
_AGREED = {1000: (0.1, 0.93, 1.07), 100: (0.35, 0.8, 1.25)}
_CHANCE = 1e-3  # a perfect sampler leaves either limit this often at other numbers of seeds
# With a tenth of a percent a check, the chance that one of twenty fails is 2 %.
_CHECK_CHANCE = 1e-3


def limits(n: int) -> tuple[float, float, float]:
    """Give the limits that the mean and the sd of n standard normal numbers keep to: most |mean|, least, most sd."""
    if n in _AGREED:
        return _AGREED[n]
    spread = np.sqrt(chi2.ppf([_CHANCE / 2, 1 - _CHANCE / 2], n - 1) / (n - 1))
    return float(norm.isf(_CHANCE / 2) / math.sqrt(n)), float(spread[0]), float(spread[1])


@cache
def _problem(name: str) -> Known:
    return problem(name)


def run_seed(name: str, seed: int, n_live: int) -> dict[str, Any]:
    """Run one seed; a function of the module, so that another process can."""
    known = _problem(name)
    counted = Counted(known)
    before = cpu_seconds()
    found = ours(counted, seed, n_live)
    cpu_s = cpu_seconds() - before
    # Mean and sd of every check, so that the reference may improve after the run.
    checks = {check.name: found.mean(check.function(found.theta)) for check in known.checks}
    return {
        "problem": name,
        "seed": seed,
        "n_live": found.n_live,
        "log_z": found.log_z,
        "log_z_error": found.log_z_error,
        "n_evaluations": found.n_evaluations,
        "cpu_s": round(cpu_s, 4),
        "n_eff": round(found.n_eff, 1),
        "insertion_p_value": found.insertion_p_value,
        "doubts": list(found.doubts),
        "checks": {key: [round(mean, 8), round(sd, 8)] for key, (mean, sd) in checks.items()},
    }


def summarise(lines: Sequence[dict[str, Any]], known: Known) -> dict[str, Any]:
    """Sum up the seeds of one problem and number of live points.

    Returns
    -------
    Mean and sd of z with their limits and whether they are kept; uniformity of the insertion p-values; how many runs
    called themselves doubtful; the checks of the posterior; medians of the cost.

    A truth with an error of its own (all seeds share it) widens the limit of the mean by two of it, in claimed errors.
    The insertion p-value of a run is corrected for its several tests and so is not uniform but never too small: the
    test is one-sided, against an excess of small ones.
    """
    n = len(lines)
    log_z, error = (np.array([line[key] for line in lines]) for key in ("log_z", "log_z_error"))
    z = (log_z - known.log_z) / error
    most, low, high = limits(n)
    most += 2 * known.log_z_error / float(np.median(error))
    mean, sd = float(z.mean()), float(z.std(ddof=1))
    p_values = np.array([line["insertion_p_value"] for line in lines])
    # Runs made before the reference knew a mean have not noted theirs.
    noted = [check for check in known.checks if any(check.name in line["checks"] for line in lines)]
    checks = [_checked(check.name, check.mean, check.error, lines) for check in noted]
    return {
        "seeds": n,
        "n_live": lines[0]["n_live"],
        "truth": round(known.log_z, 4),
        "truth_error": round(known.log_z_error, 4),
        "mean_z": round(mean, 3),
        "sd_z": round(sd, 3),
        "mean_limit": round(most, 3),
        "sd_limits": [round(low, 3), round(high, 3)],
        "held": bool(abs(mean) <= most and low <= sd <= high),
        "worst_z": round(float(z[np.argmax(np.abs(z))]), 2),
        "claimed_error": round(float(np.median(error)), 4),
        "actual_error": round(float(np.sqrt(np.mean((log_z - known.log_z) ** 2))), 4),
        "insertion_ks_p": round(float(kstest(p_values, "uniform", alternative="greater").pvalue), 4),
        "insertion_below_0.05": int((p_values < 0.05).sum()),
        "doubtful": sum(bool(line["doubts"]) for line in lines),
        "checks": checks,
        "checks_held": all(check["held"] for check in checks),
        "n_evaluations": int(np.median([line["n_evaluations"] for line in lines])),
        "cpu_s": round(float(np.median([line["cpu_s"] for line in lines])), 3),
    }


def _checked(name: str, truth: float, error: float, lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Compare one posterior mean over the seeds with its truth.

    `bias_z`: mean offset over its standard error, taken from the seeds' own scatter, so that it needs no claimed
    error; it should look like a draw of Student's t. `rms_z`: root mean square of the offsets over the sd that each
    run's effective samples promise; shares of separate modes scatter by more, since the few live points of a mode
    decide them.
    """
    rows = [(*line["checks"][name], line["n_eff"]) for line in lines if name in line["checks"]]
    mean, sd, n_eff = (np.array(column) for column in zip(*rows, strict=True))
    n = len(mean)
    offset = mean - truth
    scatter = math.hypot(float(offset.std(ddof=1)) / math.sqrt(n), error) if n > 1 else math.nan
    bias = float(offset.mean()) / scatter if scatter > 0 else 0.0
    promised = np.maximum(sd / np.sqrt(n_eff), 1e-300)
    return {
        "name": name,
        "truth": round(truth, 5),
        "mean": round(float(mean.mean()), 5),
        "bias_z": round(bias, 2),
        "rms_z": round(float(np.sqrt(np.mean((offset / promised) ** 2))), 2),
        "held": bool(abs(bias) < t.isf(_CHECK_CHANCE / 2, n - 1)),
    }


def summary_of(files: Iterable[Path]) -> list[dict[str, Any]]:
    """Sum up files, one entry a problem and number of live points."""
    groups: dict[tuple[str, int], dict[int, dict[str, Any]]] = {}
    for file in files:
        for line in records.read_lines(file):
            groups.setdefault((line["problem"], line["n_live"]), {})[line["seed"]] = line
    out = []
    for (name, n_live), by_seed in groups.items():
        seeds = sorted(by_seed)
        if len(seeds) < 2:
            continue
        command = f"python -m nested_sampling.seeds --problem {shlex.quote(name)} --live {n_live}"
        command += f" --first {seeds[0]} --seeds {seeds[-1] - seeds[0] + 1}"
        known = problem(name)
        if not math.isfinite(known.log_z):
            print(f"{name}: its reference has not been computed; run python -m nested_sampling.references")
            continue
        out.append({"problem": name, "command": command, **summarise([by_seed[s] for s in seeds], known)})
    return out


def table(entries: Iterable[dict[str, Any]]) -> str:
    """Lay out the summary as markdown."""
    head = ("problem", "seeds", "mean z (limit)", "sd z (limits)", "held", "claimed, actual error", "insertion KS p")
    rows = []
    for e in entries:
        worst = max((abs(c["bias_z"]) for c in e["checks"]), default=None)
        rows.append(
            (
                e["problem"],
                str(e["seeds"]),
                f"{e['mean_z']:+.3f} ({e['mean_limit']:.2f})",
                f"{e['sd_z']:.3f} ({e['sd_limits'][0]:.2f} to {e['sd_limits'][1]:.2f})",
                "yes" if e["held"] else "no",
                f"{e['claimed_error']:.3f}, {e['actual_error']:.3f}",
                f"{e['insertion_ks_p']:.3f}",
                str(e["doubtful"]),
                "–" if worst is None else f"{worst:.1f}" + ("" if e["checks_held"] else " (too far)"),
                f"{e['n_evaluations']:,}",
                f"{e['cpu_s']:.2f}",
            )
        )
    return records.markdown_table((*head, "doubtful", "worst posterior bias z", "evaluations", "cpu s"), rows)


def main(arguments: list[str] | None = None) -> None:
    """Run seeds, or sum files up."""
    given = sys.argv[1:] if arguments is None else arguments
    if given[:1] == ["summarise"]:
        records.summarise(given[1:], summary_of, table)
        return
    parser = argparse.ArgumentParser(prog="python -m nested_sampling.seeds", description=__doc__)
    parser.add_argument("--problem", required=True)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--live", type=int, default=0, help="live points; 0: 300")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(given)
    name, n_live = options.problem, options.live or 300
    problem(name)
    seeds = range(options.first, options.first + options.seeds)
    jobs = {(name, seed, n_live): (name, seed, n_live) for seed in seeds}
    records.complete(options.out, jobs, ("problem", "seed", "n_live"), run_seed, options.workers)
    print(table(summary_of([options.out])))


if __name__ == "__main__":
    main()
