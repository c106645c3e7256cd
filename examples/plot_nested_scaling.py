"""
What nested sampling costs
==========================

Shows how evaluations, cpu time and memory of a run grow with the number of parameters, readings, live points and
iterations. The numbers are measured by ``python -m nested_sampling.scaling`` in ``benchmarks/`` and stored; nothing
random is drawn here.
"""

# %%
import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.ticker import MaxNLocator, NullFormatter

near = (Path("docs"), Path("../docs"), Path(sys.argv[0]).resolve().parent.parent / "docs")
file = next(path for docs in near if (path := docs / "results" / "nested_scaling.json").exists())
studies = json.loads(file.read_text(encoding="utf-8"))["studies"]
for name, study in studies.items():
    print(f"{name}: probewise {study['version']}, {study['date']}, {study['command']}")


def draw(name, label, quantities):
    """Plot quantities of one study against its size, logarithmic axes, a panel each."""
    points = studies[name]["points"]
    size = (3.6 * len(quantities), 3)
    _, axes = plt.subplots(1, len(quantities), figsize=size, layout="constrained")
    for ax, (key, title) in zip(axes, quantities.items(), strict=True):
        values = [p[key] for p in points]
        ax.loglog([p["size"] for p in points], values, "o-")
        ax.set_xlabel(label)
        ax.set_title(title, fontsize="medium", loc="left")
        for axis, shown in ((ax.xaxis, [p["size"] for p in points]), (ax.yaxis, values)):
            axis.set_minor_formatter(NullFormatter())
            if max(shown) < 50 * min(shown):  # hardly a decade: powers of ten would be few
                axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
                axis.set_major_formatter(lambda value, _: f"{value:g}")
        ax.grid(True, which="both", alpha=0.3)


cost = {
    "n_evaluations": "evaluations",
    "cpu_s": "cpu time / s",
    "per_live_point_and_nat": "evaluations per live point and nat",
}

# %%
# A correlated Gaussian in more and more dimensions. Information grows in proportion to the dimension, and so does the
# length of a chain. One evaluation per live point and nat would be the least possible.
draw("dimension", "parameters", cost)

# %%
# The SSF as one Gaussian, from ever denser scans. The posterior narrows as the readings multiply: the information grows
# by half a nat per parameter whenever their number grows by a factor of e; the rest is the cost of the likelihood.
draw("readings", "readings", cost)

# %%
# The Gaussian in ten dimensions with more and more live points: the error falls as one over the root of their number.
draw("live points", "live points", {**cost, "log_z_error": "error of log Z / nats"})

# %%
# Memory, with 300 live points and twenty parameters: what the result stores grows with the iterations, as it must;
# beside it is what the run itself holds at its peak.
draw("iterations", "iterations", {"stored_mb": "stored / MB", "beside_mb": "peak beside it / MB"})
