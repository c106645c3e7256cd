"""p-values of many clean systems: does the global test alarm as often as it says?

A challenge on systems spends most of its time on the search for effects, on which the p-value does not depend once the
noise is known. Here clean cases of such a challenge are fitted and tested without that search, some twenty times as
many in the same time. One exception: where the noise is a random walk, only the search finds effects that explain the
readings as well, so the alarms of a challenge are more.

    python benchmarks/systems_alarms.py --cases 4000 --seed 31 --workers 2 --out alarms
"""

from __future__ import annotations

import argparse
import datetime
import json
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from probewise._progress import progress_shown
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.search.search import search
from probewise.diagnosis.verdict import run_global_test
from probewise.errors import DoubtfulResultWarning, ProbewiseError
from probewise.proof.campaign import run_campaign
from probewise.proof.challenge import Task
from probewise.proof.systems.cases import draw_system_case, system_stratum_of, write_system_case
from probewise.recordings import write_text_atomically
from probewise.systems import read_run_table, read_simulator, table_for

LEVELS = 0.01, 0.02, 0.05, 0.1, 0.2, 0.5


def p_value_of_case(task: Task) -> dict[str, Any]:
    """Draw a clean case, fit its system, and test the residuals; "failed" has the reason where that is impossible."""
    warnings.simplefilter("ignore", DoubtfulResultWarning)
    (blind,) = task.generators(1)
    try:
        case = draw_system_case(task.seed, task.number)
        with tempfile.TemporaryDirectory() as directory:
            file, table, _, _ = write_system_case(case, directory)
            simulator = read_simulator(file)
            seen = read_run_table(table, time=simulator.time, run=simulator.run)
        searched = search(prepare_system(simulator, table_for(simulator, seen)), depth=0)
        test = run_global_test(searched, rng=blind)
    except ProbewiseError as error:
        return {"failed": f"{type(error).__name__}: {error}"}
    return {
        "system": case.drawn.kind.name,
        "law": case.drawn.kind.law is not None,
        "noise": case.noise.name,
        "found": "+".join(test.noise) or "white",
        "readings": test.problem.n_points,
        "p_value": test.p_value,
    }


def shares_below_levels(p_values: Sequence[float]) -> dict[str, dict[str, float]]:
    """Return, for each level, the share of p-values below it, its 95 % interval (Wilson's), and how unlikely it is.

    "p_value" is the probability, two-sided, of a count as far from the expected one if the test keeps its level.
    """
    out = {}
    for level in LEVELS:
        count = int(np.sum(np.asarray(p_values) < level))
        test = stats.binomtest(count, len(p_values), level)
        low, high = test.proportion_ci(method="wilson")
        values = {"share": count / len(p_values), "low": float(low), "high": float(high), "p_value": test.pvalue}
        out[f"{level:g}"] = {name: round(float(value), 4) for name, value in values.items()}
    return out


def summary(results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Summarise by the noise of the case, and for white noise also by the system."""
    done = [result for result in results.values() if "failed" not in result]
    white = [result for result in done if result["noise"] == "white"]

    def by(name: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        groups = {value: [r["p_value"] for r in rows if r[name] == value] for value in sorted({r[name] for r in rows})}
        return {value: {"cases": len(own), **shares_below_levels(own)["0.05"]} for value, own in groups.items()}

    return {
        "cases": len(done),
        "failed": len(results) - len(done),
        "white": {"cases": len(white), **shares_below_levels([result["p_value"] for result in white])},
        "below .05 by noise": by("noise", done),
        "below .05 by system, white noise": by("system", white),
    }


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=400)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    clean = (n for n in range(100 * asked.cases) if system_stratum_of(n)[0].kind == "clean")
    tasks = {f"alarm/{number}": Task(asked.seed, number) for number in islice(clean, asked.cases)}
    asked.out.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(asked.workers) as pool, progress_shown(quiet=False) as progress:
        results = run_campaign(
            p_value_of_case,
            tasks,
            path=asked.out / "cases.jsonl",
            settings={"seed": asked.seed, "of": "p-values of clean systems"},
            executor=pool,
            progress=progress,
            noun="clean systems",
        )
    document = {
        "command": f"benchmarks/systems_alarms.py --cases {asked.cases} --seed {asked.seed}",
        "date": datetime.date.today().isoformat(),
        **summary(results),
    }
    text = json.dumps(document, indent=1)
    print(text)
    write_text_atomically(asked.out / "systems_alarms.json", text + "\n")


if __name__ == "__main__":
    main()
