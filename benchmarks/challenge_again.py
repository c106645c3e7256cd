"""Diagnose the cases of chosen kinds of a campaign again, with the engine of today.

    python benchmarks/challenge_again.py CASES.jsonl[.xz] --kind outside --workers 2 --out again.jsonl

An interrupted run resumes where it stopped. `challenges_side_by_side.py` compares the two files.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from probewise.proof.campaign import read_campaign
from probewise.proof.challenge import challenge, run_case, run_system_case

_WORK = {"": run_case, "systems": run_system_case}


def main() -> None:
    """Diagnose the cases that are missing in the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--kind", action="append", required=True, help="a kind of cases, as outside; may be repeated")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    earlier = read_campaign(options.cases)
    of = str(earlier.settings.get("of", ""))
    if of not in _WORK:
        parser.error(f"{options.cases} is a campaign of {of}, not of light sensors or systems")
    keys = [key for key, result in earlier.results.items() if result.get("kind") in options.kind]
    if not keys:
        parser.error(f"{options.cases} holds no case of kind {', '.join(options.kind)}")
    seeds, numbers = zip(*(map(int, key.split(" / ")) for key in keys), strict=True)
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        challenge(numbers, seed=seeds[0], work=_WORK[of], of=of).run(path=options.out, executor=pool)


if __name__ == "__main__":
    main()
