"""How often could a diagnosis of a simulator be right? Add the rivals of each effect to the cases of a campaign.

Campaigns of `probewise challenge --systems` that were begun before rivals were kept lack them. Each single effect of
the given sizes is drawn again, and its rivals, found by the world alone, are added to its case. The campaign's table,
made anew by its own command, then has the rows of the oracle.

    python benchmarks/systems_rivals.py challenge_systems/cases.jsonl --sizes 12 --workers 2
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from tqdm import tqdm

from probewise.campaign import read_campaign
from probewise.recordings import write_text_atomically
from probewise.world.systems import draw_system_case


def rivals_of(seed: int, number: int) -> Mapping[str, float]:
    """Return the rivals of the only effect of a case: name and loss in nats."""
    return draw_system_case(seed, number).effects[0].rivals


def lacks_rivals(result: Mapping[str, Any], sizes: list[float]) -> bool:
    """Return whether a case has one effect, of one of these sizes, whose rivals are not on file."""
    single = result.get("kind") == "single" and result["size"] in sizes and "failed" not in result
    return single and "rival_nats" not in result["hidden"][0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--sizes", type=float, nargs="+", default=[12.0])
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    campaign = read_campaign(arguments.cases)
    results, seed = dict(campaign.results), int(campaign.settings["seed"])
    keys = [key for key, result in results.items() if lacks_rivals(result, arguments.sizes)]
    numbers = [int(key.split("/")[1]) for key in keys]
    with ProcessPoolExecutor(arguments.workers) as pool:
        found = list(tqdm(pool.map(rivals_of, [seed] * len(keys), numbers), total=len(keys)))
    for key, rivals in zip(keys, found, strict=True):
        results[key]["hidden"][0]["rival_nats"] = dict(rivals)
    lines = [{"format": "campaign/1", "settings": dict(campaign.settings)}]
    lines += [{"key": key, "result": result} for key, result in results.items()]
    write_text_atomically(arguments.cases, "".join(json.dumps(line) + "\n" for line in lines))


if __name__ == "__main__":
    main()
