"""Does Laplace's approximation weigh hypotheses as nested sampling does, within a nat?

    python benchmarks/laplace_agreement.py --cases 200 --seed 6161 --out docs/results/laplace.jsonl

Concealed recordings of the challenge, each diagnosed as `probewise diagnose --thorough` does it. The file has a
line a case and a run that was stopped goes on from it.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from functools import partial
from pathlib import Path

import numpy as np

from probewise.challenge import NullRefit
from probewise.challenge.estimates import share
from probewise.diagnosis import diagnose, weigh_thoroughly
from probewise.errors import DoubtfulResultWarning
from probewise.world.challenge import draw_case


def weigh_case(seed: int, number: int) -> dict:
    """Draw one case, diagnose it thoroughly, and tell both evidences of each hypothesis that was weighed twice."""
    case = draw_case(seed, number, surviving=NullRefit())
    blind, nested = (np.random.default_rng(child) for child in np.random.SeedSequence([seed, number]).spawn(2))
    begun_s = time.process_time()
    found = diagnose(case.recording, thorough=partial(weigh_thoroughly, rng=nested), rng=blind)
    fields = ("label", "n_gaussians", "gap", "error", "agree", "doubts")
    weighings = [{name: getattr(w, name) for name in fields} for w in found.weighings]
    return {"number": number, "weighings": weighings, "cpu_s": time.process_time() - begun_s}


def summary(cases: list[dict]) -> str:
    """Count hypotheses, and leading hypotheses alone, by the number of Gaussians of the SSF."""
    lines = []
    for name, most in (("all weighed twice", None), ("the leading one of each case", 1)):
        chosen = [w for case in cases for w in case["weighings"][:most]]
        for n in sorted({w["n_gaussians"] for w in chosen}):
            own = [w for w in chosen if w["n_gaussians"] == n]
            agree = share([w["agree"] for w in own])
            gaps = np.array([w["gap"] for w in own])
            middle, widest = float(np.median(gaps)), float(gaps[np.argmax(np.abs(gaps))])
            lines.append(
                f"{name}, order {n}: {agree.value:.3f} ({agree.low:.3f} to {agree.high:.3f}) of {agree.n} in a nat, "
                f"nested less Laplace {middle:+.2f} (median), {widest:+.2f} (worst)"
            )
    return "\n".join(lines)


def main() -> None:
    """Weigh the cases that are missing in the file, then print the summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    known = [json.loads(line) for line in arguments.out.read_text().splitlines()] if arguments.out.exists() else []
    done = {case["number"] for case in known}
    warnings.simplefilter("ignore", DoubtfulResultWarning)
    with arguments.out.open("a") as file:
        for number in (k for k in range(arguments.cases) if k not in done):
            known.append(weigh_case(arguments.seed, number))
            file.write(json.dumps(known[-1]) + "\n")
            file.flush()
    print(summary(known))


if __name__ == "__main__":
    main()
