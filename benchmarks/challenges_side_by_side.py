"""Two campaigns of a challenge on the same cases: what became better or worse from one engine to the other.

    python benchmarks/challenges_side_by_side.py EARLIER.jsonl[.xz] LATER.jsonl[.xz] --out side_by_side.csv

The table of a challenge is computed of the cases that are in both files. Of what is right or wrong in each case, the
cases that changed are counted, with the two-sided probability of such a difference if both engines were as good
(McNemar's exact test).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from probewise.proof.campaign import Result, read_campaign
from probewise.proof.tables import (
    credible_set_holds_truth,
    is_confidently_wrong,
    is_leading_name_right,
    is_out_of_vocabulary,
    is_recognised_as_out_of_vocabulary,
    names_effect_on_mean,
    score,
    score_systems,
)
from probewise.recordings import write_text_atomically
from probewise.recordings.table import csv_text_of_rows

COUNTED: Mapping[str, tuple[Callable[[Result], bool], Callable[[Result], bool]]] = {
    "clean, alarm at .05": (lambda r: r["kind"] == "clean", lambda r: r["p_value"] <= 0.05),
    "clean, alarm at .01": (lambda r: r["kind"] == "clean", lambda r: r["p_value"] <= 0.01),
    "clean, physics named": (lambda r: r["kind"] == "clean", names_effect_on_mean),
    "single effect, right name first": (lambda r: r["kind"] == "single", is_leading_name_right),
    "two effects, right names first": (lambda r: r["kind"] == "pair", is_leading_name_right),
    "out of vocabulary, unknown or named right": (is_out_of_vocabulary, is_recognised_as_out_of_vocabulary),
    "aliased pair, cannot_tell": (lambda r: r["kind"] == "alias", lambda r: r["verdict"] == "cannot_tell"),
    "credible set holds the truth": (lambda r: True, lambda r: credible_set_holds_truth(r, merged=False)),
    "wrong name stated above .9": (lambda r: True, is_confidently_wrong),
}
"""What is counted in each case, by name: which cases, and what of them."""


def changed_counts(earlier: list[Result], later: list[Result]) -> list[dict[str, Any]]:
    """Return, for each quantity of `COUNTED`: cases, counts in both campaigns, cases that changed, and a p-value."""
    rows = []
    for name, (is_one, holds) in COUNTED.items():
        pairs = [(holds(a), holds(b)) for a, b in zip(earlier, later, strict=True) if is_one(a)]
        lost, won = sum(a and not b for a, b in pairs), sum(b and not a for a, b in pairs)
        p_value = binomtest(lost, lost + won).pvalue if lost + won else 1.0
        rows.append(
            {
                "what": name,
                "cases": len(pairs),
                "earlier": sum(a for a, _ in pairs),
                "later": sum(b for _, b in pairs),
                "only earlier": lost,
                "only later": won,
                "p_value": round(p_value, 4),
            }
        )
    return rows


def main() -> None:
    """Compare two files; print what changed, and write the rows of both tables beside each other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("earlier", type=Path)
    parser.add_argument("later", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    read = read_campaign(arguments.earlier), read_campaign(arguments.later)
    of, other = (each.settings.get("of") for each in read)
    if of != other:
        parser.error(f"{arguments.earlier} is a campaign of {of or 'light sensors'}, {arguments.later} is not")
    both, table = [each.results for each in read], score_systems if of == "systems" else score
    keys = [key for key in both[1] if key in both[0] and not any("failed" in results[key] for results in both)]
    earlier, later = ([results[key] for key in keys] for results in both)
    n_verdicts = sum(a["verdict"] == b["verdict"] for a, b in zip(earlier, later, strict=True))
    n_leaders = sum(sorted(a["combination"]) == sorted(b["combination"]) for a, b in zip(earlier, later, strict=True))
    print(f"{len(keys)} cases in both; the same verdict in {n_verdicts}, the same leading hypothesis in {n_leaders}")
    changed = changed_counts(earlier, later)
    print(csv_text_of_rows(changed[0], (row.values() for row in changed)), end="")
    rows = [
        {
            "what": old.name.strip(),
            "cases": old.found.n,
            **{f"earlier {part}": round(getattr(old.found, part), 4) for part in ("value", "low", "high")},
            **{f"later {part}": round(getattr(new.found, part), 4) for part in ("value", "low", "high")},
        }
        for old, new in zip(table(earlier), table(later), strict=True)
    ]
    write_text_atomically(arguments.out, csv_text_of_rows(rows[0], (row.values() for row in rows)))


if __name__ == "__main__":
    main()
