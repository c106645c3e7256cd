"""Draw what `scaling` measured: cost against dimension, readings and live points, memory against iterations.

python -m nested_sampling.scaling_figure ../docs/results/nested_scaling.json --out ../docs/_static/nested_scaling.png
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from probewise._arrays import FloatArray
from probewise.recordings import write_bytes_atomically
from probewise.report.plots.canvas import BLUE, GREY, AxesGrid, grid_of_axes, png, tidy

_COSTS = (
    ("dimension", "dimension of a Gaussian, correlation 0.9"),
    ("readings", "readings, SSF of one Gaussian"),
    ("live points", "live points, Gaussian in 10-D"),
)


def cost_and_memory(studies: Mapping[str, Any]) -> AxesGrid:
    """Draw the four studies, all axes logarithmic."""
    axes = grid_of_axes(2, 2, size_in=(8.4, 6.2))
    for ax, (study, label) in zip(axes.flat, _COSTS, strict=False):
        points = studies[study]["points"]
        size, cpu, evaluations = (np.array([p[k] for p in points]) for k in ("size", "cpu_s", "n_evaluations"))
        ax.loglog(size, cpu, "o-", color=BLUE, markersize=4)
        powers = [_power(size, cost) for cost in (cpu, evaluations)]
        said = f"in the upper half cpu grows as the power {powers[0]:.1f},\nevaluations as {powers[1]:.1f}"
        ax.annotate(said, (0.04, 0.85), xycoords="axes fraction", fontsize="small")
        tidy(ax, x=label, y="cpu (s)")
        _plain(ax, size)
    memory, points = axes.flat[3], studies["iterations"]["points"]
    size, peak, stored = (np.array([p[k] for p in points]) for k in ("n_dead", "peak_mb", "stored_mb"))
    memory.loglog(size, peak, "o-", color=BLUE, markersize=4, label="peak")
    memory.loglog(size, stored, "s--", color=GREY, markersize=4, label="samples stored")
    memory.legend(frameon=False, fontsize="small")
    tidy(memory, x="iterations, Gaussian in 20-D, 300 live points", y="memory (MB)")
    _plain(memory, size)
    return axes


def _power(size: FloatArray, cost: FloatArray) -> float:
    upper = len(size) // 2
    return float(np.polyfit(np.log(size[upper:]), np.log(cost[upper:]), 1)[0])


def _plain(ax: Axes, size: FloatArray) -> None:
    """Label the sizes that were measured, in plain numbers."""
    ax.xaxis.set_major_locator(FixedLocator(size.tolist()))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.0f}" if x < 1e4 else f"{x / 1e3:,.0f}k"))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    studies = json.loads(options.file.read_text(encoding="utf-8"))["studies"]
    write_bytes_atomically(options.out, png(cost_and_memory(studies)))


if __name__ == "__main__":
    main()
