"""Add what says the same in other words to the cases of a campaign on systems that was begun without it.

To each case with one effect of the given sizes, the rivals of its effect are added (for the rows of the oracle); to
each with an effect, the loss of what was said in other words. Both are found by the world alone, from the
noise-free readings; the diagnosis is not repeated. The campaign's own command then makes its table anew.

    python benchmarks/systems_aliases.py challenge_systems/cases.jsonl --sizes 12 --workers 2
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from tqdm import tqdm

from probewise.proof.campaign import read_campaign
from probewise.proof.system_challenge import nats_of_alternatives
from probewise.proof.systems.cases import draw_system_case
from probewise.recordings import write_text_atomically


def lacks_rivals(result: Mapping[str, Any], sizes: list[float]) -> bool:
    """Return whether a case has one effect, of one of these sizes, whose rivals are not on file."""
    return result["kind"] == "single" and result["size"] in sizes and "rival_nats" not in result["hidden"][0]


def with_aliases(seed: int, number: int, result: dict[str, Any], sizes: list[float]) -> dict[str, Any]:
    """Return the result of a case with its rivals and the loss of what was said in other words."""
    case = draw_system_case(seed, number)
    if lacks_rivals(result, sizes):
        result["hidden"][0]["rival_nats"] = dict(case.effects[0].rivals)
    return {**result, "alternative_nats": nats_of_alternatives(case, result)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--sizes", type=float, nargs="+", default=[12.0])
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    campaign = read_campaign(arguments.cases)
    results: dict[str, Any] = dict(campaign.results)
    seed, sizes = int(campaign.settings["seed"]), arguments.sizes
    keys = [
        key
        for key, result in results.items()
        if "failed" not in result
        and result["kind"] != "clean"
        and ("alternative_nats" not in result or lacks_rivals(result, sizes))
    ]
    with ProcessPoolExecutor(arguments.workers) as pool:
        asked = [pool.submit(with_aliases, seed, int(k.split("/")[1]), results[k], sizes) for k in keys]
        for key, future in tqdm(zip(keys, asked, strict=True), total=len(keys)):
            results[key] = future.result()
    lines = [{"format": "campaign/1", "settings": dict(campaign.settings)}]
    lines += [{"key": key, "result": result} for key, result in results.items()]
    write_text_atomically(arguments.cases, "".join(json.dumps(line) + "\n" for line in lines))


if __name__ == "__main__":
    main()
