"""Does Laplace's approximation weigh hypotheses as nested sampling does, within a nat?

    python benchmarks/laplace_agreement.py --numbers 402 --plan paper --seed 20270303 --workers 2 \
        --out docs/results/laplace.jsonl

The first so many recordings of a challenge, those in one plan, each diagnosed as `probewise diagnose --thorough` does
it. The file has a line a case, and a run that was stopped goes on from it.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from probewise.diagnosis import diagnose, weigh_thoroughly
from probewise.errors import DoubtfulResultWarning, NotConvergedError
from probewise.proof.campaign import Campaign, Result, estimated_share
from probewise.proof.challenge import Task
from probewise.proof.refits import NullRefit
from probewise.proof.sensors import PLANS, draw_case

_FIELDS = ("label", "n_gaussians", "gap", "error", "agree", "doubts")


def weigh_case(task: Task, *, plan: str) -> dict[str, Any]:
    """Draw one case and, in the plan asked for, tell both evidences of each hypothesis that was weighed twice."""
    try:
        case = draw_case(task.seed, task.number, norm_after_refit=NullRefit())
    except NotConvergedError as error:  # no such effect can be so large
        return {"left_out": str(error)}
    if case.plan != plan:
        return {"left_out": case.plan}
    blind, nested = (
        np.random.default_rng(child) for child in np.random.SeedSequence([task.seed, task.number]).spawn(2)
    )
    begun_s = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        found = diagnose(case.recording, thorough=partial(weigh_thoroughly, rng=nested), rng=blind)
    weighings = [{name: getattr(w, name) for name in _FIELDS} for w in found.weighings]
    return {"weighings": weighings, "cpu_s": round(time.process_time() - begun_s, 2)}


def summary(results: Sequence[Result]) -> str:
    """Count hypotheses, and leading hypotheses alone, by the number of Gaussians of the SSF."""
    cases = [result["weighings"] for result in results if "weighings" in result]
    lines = [f"{len(cases)} recordings, {np.mean([r['cpu_s'] for r in results if 'cpu_s' in r]):.0f} cpu s each"]
    for name, most in (("all weighed twice", None), ("the leading one of each", 1)):
        chosen = [w for weighings in cases for w in weighings[:most]]
        orders = sorted({w["n_gaussians"] for w in chosen})
        for label, own in [
            ("", chosen),
            *((f", order {n}", [w for w in chosen if w["n_gaussians"] == n]) for n in orders),
        ]:
            agree = estimated_share([w["agree"] for w in own])
            gaps, errors = (np.array([w[key] for w in own]) for key in ("gap", "error"))
            lines.append(
                f"{name}{label}: {agree.value:.3f} ({agree.low:.3f} to {agree.high:.3f}) of {agree.n} in a nat; nested "
                f"less Laplace {np.median(gaps):+.2f} (median), {np.quantile(np.abs(gaps), 0.95):.2f} (95 % below), "
                f"{gaps[np.argmax(np.abs(gaps))]:+.2f} (worst); error {np.median(errors):.2f} (median); "
                f"{sum(bool(w['doubts']) for w in own)} with doubts"
            )
    return "\n".join(lines)


def main() -> None:
    """Weigh the cases that are missing in the file, then print the summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--numbers", type=int, default=402)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--plan", choices=sorted(PLANS), default="paper")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    work, settings = partial(weigh_case, plan=options.plan), {"seed": options.seed, "plan": options.plan}
    tasks = {task.key: task for task in (Task(options.seed, number) for number in range(options.numbers))}
    campaign = Campaign(work, tasks, settings, noun="cases")
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        print(summary([*campaign.run(path=options.out, executor=pool).values()]))


if __name__ == "__main__":
    main()
