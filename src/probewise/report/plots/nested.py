"""Diagnostics and posterior of a nested-sampling run: trace, corner, insertion ranks, course of the run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from scipy.special import bdtrik

from probewise._arrays import FloatArray
from probewise._kinds import require_kind, require_like
from probewise._words import unit_of_name
from probewise.errors import require
from probewise.nested import NestedResult
from probewise.nested.result import Samples
from probewise.report.plots import canvas
from probewise.report.words import value_and_interval_texts, value_with_error, words_without_unit

# Darker points have more weight, so that they show on white; lightness falls evenly, so that it can be read in grey.
_WEIGHT: Colormap = LinearSegmentedColormap.from_list(
    "probewise_weight", ["#dcdcdc", "#8fbbdb", canvas.BLUE, "#00233b"]
)
_MASSES = (0.68, 0.95)
_SHADES = ("#aecfe6", "#4d9bcb")  # colours of the larger and of the smaller mass
_A_RUN, _NEW = "a NestedResult, as nested.run returns it", "new points"
_DEPTH = "−ln X (X: prior mass left)"
_FEW = 6  # parameters up to which a corner plot fits a page and has numbers


def trace_plot(result: NestedResult, *, parameters: Sequence[str] | None = None) -> canvas.AxesGrid:
    """Draw each parameter of the dead points against the remaining log volume, darker where the posterior mass is.

    On top: posterior mass per nat of log volume. `parameters` are the names to draw, in this order; default: all.

    Return the axes, (1 + number of parameters drawn, 1). ParameterError for an unknown name or none.
    """
    columns = _checked_parameter_columns(result, parameters)
    axes = canvas.grid_of_axes(len(columns) + 1, 1, size_in=(canvas.PANEL_IN, 1.9 + 1.3 * len(columns)), sharex=True)
    depth, mass = _depth_and_mass_per_nat(result)
    shown = np.argsort(mass, kind="stable")
    _draw_mass(axes[0, 0], depth, mass)
    canvas.label_axes(axes[0, 0], x="", y="mass per nat", title=_evidence_text(result))
    for ax, i in zip(axes[1:, 0], columns, strict=True):
        ax.scatter(
            depth[shown], result.theta[shown, i], s=5, linewidths=0, rasterized=True, c=mass[shown], cmap=_WEIGHT
        )
        canvas.label_axes(ax, x="", y=_parameter_label(result.names[i]))
    axes[-1, 0].set(xlim=(0, depth[-1]), xlabel=_DEPTH)
    canvas.figure_of(axes).align_ylabels(list(axes[:, 0]))
    return axes


def corner_plot(result: Samples, *, parameters: Sequence[str] | None = None) -> canvas.AxesGrid:
    """Draw the marginal posterior of each parameter, and 68 % and 95 % regions of each pair.

    Intervals of single parameters are central ones; up to six parameters, which fit the width of a page, also have
    their median and 95 % interval written above. Regions of pairs are those of highest density, from a histogram of the
    weighted samples smoothed by a kernel that narrows as the effective sample size grows. `parameters` are the names to
    draw, in this order; default: all.

    Return the axes, (n, n), of the n parameters drawn, None above the diagonal. ParameterError for an unknown name or
    none.
    """
    columns = _checked_parameter_columns(result, parameters)
    n, spans = len(columns), [_axis_limits(result, i) for i in columns]
    side = min(1.9, canvas.PAGE_IN / n) if n <= _FEW else 1.25
    axes = canvas.grid_of_axes(n, n, size_in=(max(n * side, 3.6), max(n * side, 3.6)))
    for (row, column), ax in np.ndenumerate(axes):
        if column > row:
            ax.remove()
            axes[row, column] = None
            continue
        if row == column:
            _draw_marginal(ax, result, columns[row], spans[row], titled=n <= _FEW)
        else:
            _draw_pair(ax, result, (columns[column], columns[row]), (spans[column], spans[row]))
            ax.yaxis.set_major_locator(MaxNLocator(3, prune="both"))
        ax.set_xlim(spans[column])
        ax.tick_params(labelsize=canvas.SMALL_PT)
        ax.tick_params(axis="x", labelrotation=45)
        ax.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
        ax.set_xlabel(_parameter_label(result.names[columns[column]]))
        ax.set_ylabel(_parameter_label(result.names[columns[row]]) if row != column else "")
        ax.label_outer()
    if n > 1:
        shades = zip(_MASSES, reversed(_SHADES), strict=True)
        canvas.figure_of(axes[0, 0]).legend(
            handles=[Patch(facecolor=colour, label=f"{100 * mass:.0f} %") for mass, colour in shades],
            title=f"{_evidence_text(result)}\nposterior within",
            loc="upper right",
            frameon=False,
            fontsize=canvas.SMALL_PT,
            title_fontsize=canvas.SMALL_PT,
        )
    return axes


def insertion_plot(result: NestedResult, *, ax: Axes | None = None) -> Axes:
    """Draw the histogram of insertion ranks of new points, with the band expected of a correct sampler.

    Every new point is equally likely to take any rank (Fowlie, Handley & Su 2020). Too many low ranks mean that chains
    are too short to leave the likelihood bound; too many high ranks mean that a region was lost. The band holds all
    bars at once in 99 of 100 correct runs (binomial, Šidák's correction); bars outside it are red.
    """
    require_kind("result", result, NestedResult, _A_RUN)
    ax = canvas.axes_or_new(ax, size_in=(6.4, 3.6))
    canvas.label_axes(ax, x="rank among the live points (0: worst, 1: best)", y=_NEW)
    n = result.insertion_rank.size
    if n == 0:
        ax.text(0.5, 0.5, "no point was inserted", transform=ax.transAxes, ha="center", va="center")
        return ax
    edges = np.linspace(0.0, 1.0, int(np.clip(n / 60, 4, 25)) + 1)
    # With m ranked points, each of the m + 1 ranks is spread evenly over its part of the axis from 0 to 1.
    rank, parts = result.insertion_rank, result.insertion_n_ranked + 1.0
    first, width = rank / parts, (rank + 1.0) / parts - rank / parts
    counts = np.diff([np.clip((edge - first) / width, 0.0, 1.0).sum() for edge in edges])
    n_bars = len(counts)
    tail = (1.0 - 0.99 ** (1.0 / n_bars)) / 2.0
    low, high = (float(np.ceil(bdtrik(q, n, 1.0 / n_bars))) for q in (tail, 1.0 - tail))  # quantiles of a binomial
    colour = np.where((counts < low) | (counts > high), canvas.VERMILLION, _SHADES[0])
    ax.bar(edges[:-1], counts, 1.0 / n_bars, align="edge", color=colour, edgecolor="white", linewidth=0.6)
    ax.axhspan(low, high, label="99 % of correct runs", **canvas.BAND)
    ax.axhline(n / n_bars, color=canvas.BLACK, label="uniform")
    ax.set(xlim=(0, 1), xlabel=f"{ax.get_xlabel()}; {n} {_NEW}, p = {result.insertion_p_value:.2g}")
    canvas.legend_above(ax)
    return ax


def run_plot(result: NestedResult) -> canvas.AxesGrid:
    """Draw the course of a run: likelihood, posterior mass, live points and cumulative evidence against log volume.

    Return the axes, (4, 1). The likelihood's axis leaves out values far below those that carry posterior mass.
    """
    require_kind("result", result, NestedResult, _A_RUN)
    axes = canvas.grid_of_axes(4, 1, size_in=(7.0, 7.6), sharex=True)
    depth, mass = _depth_and_mass_per_nat(result)
    likelihood, posterior, alive, evidence = axes[:, 0]
    peak = float(result.log_likelihood.max())
    below = max(20.0 * (peak - float(result.log_likelihood[int(np.argmax(mass))])), 30.0)
    floor = max(float(result.log_likelihood.min()), peak - below)
    likelihood.plot(depth, result.log_likelihood, color=canvas.BLUE)
    likelihood.set_ylim(floor - 0.03 * (peak - floor), peak + 0.05 * (peak - floor))
    canvas.label_axes(likelihood, x="", y="ln likelihood", title=_evidence_text(result))
    _draw_mass(posterior, depth, mass)
    canvas.label_axes(posterior, x="", y="posterior per nat")
    alive.plot(depth, result.n_at_death, color=canvas.BLUE)
    alive.set_ylim(0, 1.1 * float(result.n_at_death.max()))
    canvas.label_axes(alive, x="", y="live points")
    error = result.log_z_error
    evidence.axhspan(result.log_z - error, result.log_z + error, label="ln Z ± its error", **canvas.BAND)
    so_far = np.logaddexp.accumulate(result.log_weight) + result.log_z
    evidence.plot(depth, so_far, color=canvas.BLUE, label="from the points so far")
    evidence.set_ylim(result.log_z - max(6.0, 4 * error), result.log_z + max(1.0, 2 * error))
    evidence.legend(frameon=False, fontsize=canvas.SMALL_PT, loc="lower right")
    evidence.set_xlim(0, depth[-1])
    canvas.label_axes(evidence, x=_DEPTH, y="ln Z")
    evidence.figure.align_ylabels(list(axes[:, 0]))
    return axes


def _draw_mass(ax: Axes, depth: FloatArray, mass: FloatArray) -> None:
    ax.fill_between(depth, mass, **canvas.FILLED)
    ax.plot(depth, mass, color=canvas.BLUE)
    ax.set_ylim(bottom=0)


def _evidence_text(result: Samples) -> str:
    return f"ln Z = {value_with_error(result.log_z, result.log_z_error)}"


def _checked_parameter_columns(result: Samples, parameters: Sequence[str] | None) -> list[int]:
    require_like("result", result, ("names", "theta"), f"{_A_RUN}, or weighted samples")
    require(result.names, "names", result.names, "one parameter or more; without any there is nothing to draw")
    if parameters is None:
        return list(range(len(result.names)))
    unknown = [name for name in parameters if name not in result.names]
    require(not unknown and parameters, "parameters", tuple(parameters), f"one or more of {result.names}")
    return [result.names.index(name) for name in parameters]


def _parameter_label(name: str) -> str:
    unit = unit_of_name(name)
    return words_without_unit(name) + (f" ({unit})" if unit else "")


def _depth_and_mass_per_nat(result: NestedResult) -> tuple[FloatArray, FloatArray]:
    """Return -ln X and the posterior mass per nat of it, (n_dead,): a death among n live points takes 1 / n nats."""
    return -result.log_volume, result.weight * result.n_at_death


def _axis_limits(result: Samples, column: int) -> tuple[float, float]:
    """Return a parameter's axis limits: its central 99 % interval with a margin, within the range of the points."""
    values = result.theta[:, column]
    low, high = result.interval(0.99)[:, column]
    margin = 0.15 * (high - low)
    low, high = max(low - margin, values.min()), min(high + margin, values.max())
    if not high > low:
        margin = max(abs(low), 1.0) * 1e-3
        low, high = low - margin, high + margin
    return float(low), float(high)


def _draw_marginal(ax: Axes, result: Samples, column: int, span: tuple[float, float], *, titled: bool) -> None:
    density, edges = np.histogram(result.theta[:, column], bins=80, range=span, weights=result.weight)
    centres = (edges[:-1] + edges[1:]) / 2
    total = max(float(density.sum()), 1e-300)
    middle = float(density @ centres) / total
    sd = np.sqrt(float(density @ (centres - middle) ** 2) / total) / (edges[1] - edges[0])
    # Three quarters of Silverman's width, since posteriors may have several modes; reflected at the prior's ends.
    width = max(0.8 * sd * max(result.n_eff, 1.0) ** -0.2, 0.5)
    density = gaussian_filter1d(density, width, mode="reflect")
    cuts = result.interval(_MASSES[1])[:, column], result.interval(_MASSES[0])[:, column]
    ax.plot(centres, density, color=canvas.BLUE)
    for (low, high), colour in zip(cuts, _SHADES, strict=True):
        ax.fill_between(centres, density, where=list((centres >= low) & (centres <= high)), color=colour, lw=0)
    ax.set_ylim(0, 1.1 * max(float(density.max()), 1e-300))
    ax.set_yticks([])
    ax.spines[["top", "right", "left"]].set_visible(False)
    if titled:
        median = float(result.quantiles([0.5])[0, column])
        low, high = (float(end) for end in cuts[0])
        ax.set_title("\n".join(value_and_interval_texts(median, low, high)), fontsize=canvas.SMALL_PT)


def _draw_pair(
    ax: Axes, result: Samples, columns: tuple[int, int], spans: tuple[tuple[float, float], tuple[float, float]]
) -> None:
    x, y = (result.theta[:, i] for i in columns)
    density, x_edges, y_edges = np.histogram2d(x, y, bins=48, range=spans, weights=result.weight)
    # A span is about six sds of 48 bins; three quarters of Silverman's width in the plane.
    width = float(np.clip(6.0 * max(result.n_eff, 1.0) ** (-1 / 6), 0.8, 3.0))
    smooth = gaussian_filter(density, width, mode="reflect")
    ordered = np.sort(smooth.ravel())[::-1]
    ladder = np.cumsum(ordered) / max(float(ordered.sum()), 1e-300)
    levels = [float(ordered[min(int(np.searchsorted(ladder, m)), ordered.size - 1)]) for m in reversed(_MASSES)]
    top = float(ordered[0])
    ax.set_ylim(spans[1])
    if not 0 < levels[0] < levels[1] < top:
        ax.plot(x, y, linestyle="none", marker=".", markersize=2, color=canvas.BLUE)
        return
    middles = [(edges[:-1] + edges[1:]) / 2 for edges in (x_edges, y_edges)]
    ax.contourf(*middles, smooth.T, levels=[*levels, top * 1.001], colors=_SHADES)
    ax.contour(*middles, smooth.T, levels=levels, colors=canvas.BLUE, linewidths=0.6)
