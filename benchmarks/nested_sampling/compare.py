"""Compare samplers on the same problems in one run, and lay out the table.

    python -m nested_sampling.compare --problems eggbox circle --samplers ours dynesty nestle \\
        --seeds 3 --out compare.jsonl --cap 300
    python -m nested_sampling.compare --out compare.jsonl          # the table alone

Every run has a process of its own, on one core, one after another; samplers take turns within a problem and a seed,
so that what else the machine does weighs on all alike. Runs already in the file are not repeated.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any

from nested_sampling import one_thread, records

_FOLDER = Path(__file__).resolve().parent.parent
_KEY = ("problem", "sampler", "seed", "live", "cap")
# A claimed log Z further off than this many claimed errors is wrong.
_N_ERRORS = 4.0
_ENOUGH_SEEDS = 3


def run_one(key: dict[str, Any]) -> dict[str, Any]:
    """Run in a process of its own and read its line."""
    command = [sys.executable, "-m", "nested_sampling.one"]
    for name in _KEY:
        command += [f"--{name}", str(key[name])]
    path = os.pathsep.join([str(_FOLDER), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, **one_thread.VARIABLES, "PYTHONPATH": path}
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=5 * key["cap"] + 300, check=False
        )
    except subprocess.TimeoutExpired:
        return {**key, "status": "DNF"}
    if not done.stdout.strip():
        killed = done.returncode < 0
        return {**key, "status": "DNF" if killed else f"error: {done.stderr.strip().splitlines()[-1:]}"}
    return {**key, **json.loads(done.stdout.splitlines()[-1])}


def campaign(
    problems: Iterable[str], samplers: Iterable[str], *, seeds: range, live: int, cap: float, out: Path
) -> None:
    """Make every run that is not in the file yet."""
    seen = {tuple(line[k] for k in _KEY) for line in records.read_lines(out)}
    with records.Lines(out) as lines:
        for problem, seed, sampler in product(problems, seeds, samplers):
            values = (problem, sampler, seed, live, cap)
            if values not in seen:
                record = {**run_one(dict(zip(_KEY, values, strict=True))), "date": records.today()}
                lines.add(record)
                print(_told(record), flush=True)


def _told(record: dict[str, Any]) -> str:
    head = f"{record['problem']}, {record['sampler']}, seed {record['seed']}: "
    if record["status"] != "ok":
        return f"{head}{record['status']}"
    return (
        f"{head}{record['log_z']:.3f} ± {record['log_z_error']:.3f}, {record['n_evaluations']} evaluations, "
        f"{record['cpu_s']:.2f} s"
    )


def summarise(lines: Iterable[dict[str, Any]], truths: dict[str, tuple[float, float]]) -> list[dict[str, Any]]:
    """Sum up runs: one row a problem and sampler, in the order they first occur.

    Parameters
    ----------
    lines
        Records of `campaign`.
    truths
        log Z of each problem and its own error.

    Returns
    -------
    Rows with the mean offset from the truth, the claimed error (root mean square), the actual one (root mean square
    offset, where there are three seeds or more), medians of evaluations and cpu time, evaluations times the square
    of either error, evaluations per live point and nat, and the ratio of cpu time to the best correct peer's.
    """
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for line in lines:
        groups.setdefault((line["problem"], line["sampler"]), []).append(line)
    rows = [_row(problem, sampler, group, truths[problem]) for (problem, sampler), group in groups.items()]
    for row in rows:
        peers = [r for r in rows if r["problem"] == row["problem"] and not r["sampler"].startswith("ours")]
        right = [r for r in peers if r["correct"]]
        for quantity in ("cpu_s", "work", "work_claimed"):
            best = min((r[quantity] for r in right if r[quantity] is not None), default=None)
            usable = best and row[quantity] is not None
            row[f"{quantity}_ratio"] = row[quantity] / best if usable else None
    return rows


def _row(problem: str, sampler: str, group: list[dict[str, Any]], truth: tuple[float, float]) -> dict[str, Any]:
    done = [line for line in group if line["status"] == "ok"]
    row: dict[str, Any] = {
        "problem": problem,
        "sampler": sampler,
        "n_seeds": len(group),
        "n_done": len(done),
        "statuses": sorted({line["status"] for line in group}),
    }
    names = "offset claimed actual n_evaluations cpu_s work work_claimed per_nat worst_check"
    row |= dict.fromkeys(names.split())
    row["correct"] = False
    if not done:
        return row
    log_z, error = truth
    offsets = [line["log_z"] - log_z for line in done]
    claimed = math.sqrt(statistics.fmean(line["log_z_error"] ** 2 for line in done))
    n_evaluations = statistics.median(line["n_evaluations"] for line in done)
    enough = len(done) >= _ENOUGH_SEEDS
    actual = math.sqrt(statistics.fmean(o * o for o in offsets)) if enough else None
    n_live, nats = done[0]["n_live"], statistics.fmean(line["information"] for line in done)
    row |= {
        "offset": statistics.fmean(offsets),
        "claimed": claimed,
        "actual": actual,
        "n_evaluations": n_evaluations,
        "cpu_s": statistics.median(line["cpu_s"] for line in done),
        "work": n_evaluations * actual**2 if actual is not None else None,
        "work_claimed": n_evaluations * claimed**2,
        "per_nat": n_evaluations / (n_live * nats) if n_live and nats > 0 else None,
        "worst_check": max((line["worst_check"] for line in done if line["worst_check"] is not None), default=None),
        # Every run must end and be right.
        "correct": len(done) == len(group)
        and all(
            abs(o) < _N_ERRORS * math.hypot(line["log_z_error"], error) for o, line in zip(offsets, done, strict=True)
        ),
    }
    return row


def table(rows: Iterable[dict[str, Any]]) -> str:
    """Lay out the rows as markdown."""

    def number(value: float | None, form: str) -> str:
        return "–" if value is None or not math.isfinite(value) else format(value, form)

    head = (
        "problem",
        "sampler",
        "ln Z − truth",
        "claimed error",
        "actual error",
        "evaluations",
        "cpu s",
        "evaluations × error²: actual",
        "claimed",
        "evaluations per live point and nat",
        "worst posterior z",
        "cpu / best correct peer",
        "work / best (actual)",
        "right",
    )
    body = []
    for row in rows:
        verdict = "yes" if row["correct"] else "no"
        if row["offset"] is not None and not math.isfinite(row["offset"]):
            verdict = "no reference"
        if row["n_done"] < row["n_seeds"]:
            other = "; ".join(s for s in row["statuses"] if s != "ok")
            verdict = f"{other} ({row['n_seeds'] - row['n_done']} of {row['n_seeds']})"
        body.append(
            (
                row["problem"],
                row["sampler"],
                number(row["offset"], "+.3f"),
                number(row["claimed"], ".3f"),
                number(row["actual"], ".3f"),
                number(row["n_evaluations"], ",.0f"),
                number(row["cpu_s"], ".2f"),
                number(row["work"], ",.0f"),
                number(row["work_claimed"], ",.0f"),
                number(row["per_nat"], ".1f"),
                number(row["worst_check"], ".1f"),
                number(row["cpu_s_ratio"], ".2f"),
                number(row["work_ratio"], ".2f"),
                verdict,
            )
        )
    return records.markdown_table(head, body)


def main(arguments: list[str] | None = None) -> None:
    """Run what is asked for, then print the table of all that the file holds."""
    from nested_sampling.problems import problem
    from nested_sampling.samplers import NAMES

    parser = argparse.ArgumentParser(prog="python -m nested_sampling.compare", description=__doc__)
    parser.add_argument("--problems", nargs="+", default=[])
    parser.add_argument("--samplers", nargs="+", default=["ours"], choices=NAMES)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--live", type=int, default=0, help="live points of all; 0: the problem's, or each one's own")
    parser.add_argument("--cap", type=float, default=300.0, help="seconds of cpu time a run")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", type=Path, help="write the table's numbers here too")
    options = parser.parse_args(arguments)
    for name in options.problems:
        problem(name)  # a misspelt name ends the campaign before it begins
    seeds = range(options.first, options.first + options.seeds)
    campaign(options.problems, options.samplers, seeds=seeds, live=options.live, cap=options.cap, out=options.out)
    lines = records.read_lines(options.out)
    known = {name: problem(name) for name in dict.fromkeys(line["problem"] for line in lines)}
    rows = summarise(lines, {name: (k.log_z, k.log_z_error) for name, k in known.items()})
    print(table(rows))
    if options.json:
        records.write_json(options.json, {"date": records.today(), "rows": rows})


if __name__ == "__main__":
    main()
