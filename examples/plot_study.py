"""
How many measurements the robot needs
=====================================

Shows what each row of the published study needs: in all, and after the first reading on white. The numbers are
measured by ``probewise study`` over hundreds of circles and stored; nothing random is drawn here.
"""

# %%
import csv
import sys
from pathlib import Path
from types import SimpleNamespace

from probewise.proof.campaign import Estimate
from probewise.proof.pages import readings_needed

near = (Path("docs"), Path("../docs"), Path(sys.argv[0]).resolve().parent.parent / "docs")
file = next(path for docs in near if (path := docs / "results" / "study.csv").exists())
with file.open(encoding="utf-8", newline="") as lines:
    rows = list(csv.DictReader(lines))


def estimate(row, name):
    """Take a number and its bounds from a row of the table."""
    return Estimate(*(float(row[name + end]) for end in ("", "_low", "_high")))


# %%
# A run that does not reach the precision within 100 readings counts as 100.
for row in rows:
    print(f"{row['row']}: {row['runs']} runs, mean {estimate(row, 'mean')}, after white {estimate(row, 'after_white')}")

# %%
# Rows of one population ("inside", "anywhere") search for the same circles, and all have the same noise in units of its
# sd. Each row differs from the first in one factor or two. In brackets: the number of runs.
needed = {
    f"{row['row']} ({row['runs']})": SimpleNamespace(
        **{name: estimate(row, name) for name in ("mean", "median", "after_white")}
    )
    for row in rows
}
readings_needed(needed)
