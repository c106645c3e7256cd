"""Basis functions over every covariate, for unknown effects: changes of the readings that no named effect describes.

A mismatch that depends smoothly on a covariate adds to the readings, multiplies the signal, or displaces the sensor. So
there are smooth functions of covariates: alone, times the signal, and times the slope of the readings along the
motion; over time and place all three, over another covariate those that make sense. Other bases are steps (change
points) over time and place, windows, one value per scan or angle, memories of earlier readings, and transients at the
ends of scans. Where columns are logged beside the readings, products of two are bases too: a function of one column
cannot imitate a product of two that vary independently.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.evidence import Linearised, OrthonormalBlocks
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.templates import TemplateBank

PRODUCTS = "products of two columns"  # the family of products of covariates
MEMORY = "what was seen before"  # the family of what a reading keeps of earlier ones
SCAN_ENDS = "ends of scans"  # the family of transients at the ends of scans or runs
_LIKE = 0.9  # cosine from which a basis duplicates a named effect
_ROUNDING = 1e-13  # of a template's squares: a direction of which the fit leaves no more is absorbed
_MOST_GROUPS = 24
_N_STEPS = 15  # change points of a covariate
_MEMORIES = (3.0, 10.0, 30.0)  # readings
_TERMS = (3, 8, 20)  # of smooth functions; of a gain or a displacement the first two
_WINDOWS = (4, 8, 16)  # parts of a covariate


class _BasisMultipliers(NamedTuple):
    """Factors by which a function of a covariate is multiplied to give a basis, (n_points,) each; number of scans.

    `adds`: 1, an added error; `gain`: the signal; `shift`: the slope along the axis of motion, a displacement;
    `turned`: the sign of the motion, an error that reverses with it.
    """

    adds: FloatArray
    gain: FloatArray
    shift: FloatArray
    turned: FloatArray
    n_scans: int


def bank_of_unknown_effects(
    covariates: Sequence[Covariate],
    signal: FloatArray,
    slope: FloatArray,
    scan: IntArray | None,
    *,
    multiplied: Sequence[Covariate] = (),
) -> TemplateBank:
    """Build the template bank of unknown effects: basis functions over every covariate, in families of equal prior.

    `signal`, `slope`: predicted reading above its minimum, and its slope along the motion, (n_usable,) each; `scan`:
    number of each row's scan, (n_usable,), None where rows are in no order; `multiplied`: covariates of which the
    product of every two is a basis, all in one family.
    """
    numbers = np.zeros(len(signal), dtype=np.int64) if scan is None else scan
    order = np.argsort(numbers, kind="stable")  # those of each scan together
    starts, back = np.flatnonzero(np.diff(numbers[order], prepend=-1)), np.argsort(order)
    sign = np.zeros(len(signal))
    for covariate in covariates:
        if covariate.name == "direction":
            sign[covariate.rows] = covariate.values
    along_axis = slope * np.where(sign == 0, 1.0, sign)
    ways = _BasisMultipliers(np.ones(len(signal)), signal, along_axis, sign, len(starts))
    found = []
    for covariate in covariates:  # a family such as "time" or, of windows and steps, "time, locally"
        name = covariate.published_name if covariate.scan is None else f"{covariate.published_name} within scans"
        for template in _bases_of_covariate(covariate, ways):
            whole = template.shape[1] > 1 or covariate.name == "slope"
            found.append((name if whole else f"{name}, locally", template))
    scaled = [(c, (c.values - c.values.mean()) / (c.values.std() or 1.0)) for c in multiplied]
    factors = [_on_all_rows(values[:, None], c, len(signal)) for c, values in scaled]
    found += [(PRODUCTS, first * second) for first, second in combinations(factors, 2)]
    if scan is not None:
        found += [(MEMORY, template[back]) for template in _memory_bases(signal[order], starts)]
        found += [(SCAN_ENDS, template[back]) for template in _scan_end_bases(len(signal), starts)]
    kept = [(name, template) for name, template in found if np.any(template)]
    return TemplateBank.of([t for _, t in kept], [name for name, _ in kept])


def bases_unlike_named(bases: TemplateBank, named: TemplateBank, problem: Linearised) -> TemplateBank:
    """Return the bases without those that a template of a named effect holds, the fit's parameters projected out.

    A basis of one column with a cosine of 0.9 or more with a template's span is left out. One of several columns that
    has its span becomes zero: it explains nothing, and its share of the prior is not given to the others.
    """
    if not bases.templates:
        return bases
    own = OrthonormalBlocks.of(problem, bases.templates)
    single = np.flatnonzero(bases.widths == 1)
    held, twins = np.zeros(len(single), dtype=np.bool_), np.zeros(len(bases.widths), dtype=np.bool_)
    there = np.split(np.any(own.u, axis=0), own.starts[1:])
    spans = [at + np.flatnonzero(part) for at, part in zip(own.starts, there, strict=True)]
    for cosines in _cosines(named, problem, own.u):
        held |= _are_held(cosines[:, :, own.starts[single]])
        n_directions = np.count_nonzero(np.any(cosines, axis=2), axis=1)
        for k, span in enumerate(spans):
            alike = cosines[n_directions == len(span)][:, :, span] if len(span) > 1 else cosines[:0]
            twins[k] |= bool(np.any(np.linalg.svd(alike, compute_uv=False)[:, len(span) - 1 :] >= _LIKE))
    templates = [0.0 * template if twin else template for template, twin in zip(bases.templates, twins, strict=True)]
    kept = np.delete(np.arange(len(bases.widths)), single[held])
    return replace(bases, templates=tuple(templates)).take_entries(kept)


def without_products_like(bases: TemplateBank, formulas: TemplateBank, problem: Linearised) -> TemplateBank:
    """Return the bases without the products that a template of a formula holds, the fit's parameters projected out."""
    products = bases.indices_by_label.get(PRODUCTS, np.zeros(0, dtype=np.int64))
    if products.size == 0 or not formulas.templates:
        return bases
    own = OrthonormalBlocks.of(problem, [bases[k] for k in products]).u
    held = np.any([_are_held(cosines) for cosines in _cosines(formulas, problem, own)], axis=0)
    return bases.take_entries(np.delete(np.arange(len(bases.labels)), products[held]))


def _cosines(bank: TemplateBank, problem: Linearised, columns: FloatArray) -> Iterator[FloatArray]:
    """Yield cosines of orthonormal columns, (n_rows, k), with directions of each template of a group, (n, width, k).

    The fit is projected out of both; cosines of a direction that it absorbs are 0.
    """
    for _, _, left, along in bank.projected(problem, columns):
        squares, axes = np.linalg.eigh(left)
        lengths = np.sqrt(np.where(squares > _ROUNDING * problem.law.n_kept, squares, np.inf))
        yield axes.transpose(0, 2, 1) @ along / lengths[:, :, None]


def _are_held(cosines: FloatArray) -> BoolArray:
    return np.asarray(np.sqrt(np.sum(cosines**2, axis=1)).max(axis=0) >= _LIKE)


def _bases_of_covariate(covariate: Covariate, ways: _BasisMultipliers) -> Iterator[FloatArray]:
    if covariate.groups:
        yield from _group_bases(covariate, ways)
    elif covariate.scan is not None:
        yield _cosine_bases(covariate, ways.adds, 6)
        yield _cosine_bases(covariate, ways.shift, 3)
        yield from _window_bases(covariate, ways.adds, _WINDOWS if ways.n_scans <= 6 else _WINDOWS[1:2])
    elif covariate.name == "place":
        yield from _smooth_bases(covariate, _TERMS, ways.adds, ways.shift)
        yield from _smooth_bases(covariate, _TERMS[:2], ways.gain)
        yield _cosine_bases(covariate, ways.turned, 3)
        yield _cosine_bases(covariate, ways.turned * ways.shift, 3)
        yield from _step_bases(covariate, ways.shift)
        yield from _window_bases(covariate, ways.adds, _WINDOWS)
    elif covariate.name == "time":
        yield from _smooth_bases(covariate, (3, 8, 24, 64), ways.adds)  # a wave may be of any frequency
        for way in (ways.gain, ways.shift):
            yield from _smooth_bases(covariate, _TERMS[:2], way)
            yield from _step_bases(covariate, way)
        yield from _step_bases(covariate, ways.adds)
        yield from _window_bases(covariate, ways.adds, _WINDOWS)
    elif covariate.name in ("level", "edge_distance"):
        yield from _smooth_bases(covariate, _TERMS, ways.adds)
        side = np.where(ways.gain > 0.5 * ways.gain.max(), 1.0, -1.0)
        yield _cosine_bases(covariate, side * ways.adds, _TERMS[1])
        yield _cosine_bases(covariate, ways.turned, 3)
        yield from _window_bases(covariate, ways.adds, _WINDOWS)
    elif covariate.name == "slope":
        yield _cosine_bases(covariate, ways.adds, 3)
        yield _on_all_rows(covariate.values[:, None], covariate, len(ways.adds))
        yield _on_all_rows(np.abs(covariate.values)[:, None], covariate, len(ways.adds))
    else:  # a logged column of the recording
        for way in (ways.adds, ways.gain):
            yield from _smooth_bases(covariate, _TERMS[:2], way)


def _smooth_bases(covariate: Covariate, terms: Sequence[int], *ways: FloatArray) -> Iterator[FloatArray]:
    yield from (_cosine_bases(covariate, way, n) for n in terms for way in ways)


def _group_bases(covariate: Covariate, ways: _BasisMultipliers) -> Iterator[FloatArray]:
    codes = np.unique(covariate.values, return_inverse=True)[1]
    if codes.max() >= _MOST_GROUPS:
        return
    member = _on_all_rows((codes[:, None] == np.arange(codes.max() + 1)).astype(np.float64), covariate, len(ways.adds))
    for way in (ways.adds, ways.gain, ways.shift):
        yield member * way[:, None]
    for way in (ways.adds, ways.shift):
        yield from (column[:, None] * way[:, None] for column in member.T)


def _memory_bases(signal: FloatArray, starts: IntArray) -> Iterator[FloatArray]:
    """Yield exponential averages (of 3, 10, 30 readings) and maximum of the signal within scans; the maximum alone."""
    held, keep = np.empty((len(signal), len(_MEMORIES) + 1)), np.exp(-1 / np.array(_MEMORIES))
    for first, end in pairwise([*starts.tolist(), len(signal)]):
        state = np.full(len(keep), signal[first])
        for k in range(first, end):
            state = keep * state + (1 - keep) * signal[k]
            held[k, :-1] = state
        held[first:end, -1] = np.maximum.accumulate(signal[first:end])
    yield held
    yield held[:, -1:]


def _scan_end_bases(n_points: int, starts: IntArray) -> Iterator[FloatArray]:
    """Yield pairs of columns: decay from a scan's start, growth towards its end, over 2 and over 8 readings."""
    n_rows, rows = np.diff(starts, append=n_points), np.arange(n_points)
    first, last = np.repeat(starts, n_rows), np.repeat(starts + n_rows - 1, n_rows)
    each = (first[:, None] == starts).astype(np.float64)
    for length in (2.0, 8.0):
        begin, end = np.exp(-(rows - first) / length), np.exp(-(last - rows) / length)
        yield np.stack([begin, end], axis=1)
        if len(starts) <= _MOST_GROUPS:
            yield np.concatenate([each * begin[:, None], each * end[:, None]], axis=1)


def _cosine_bases(covariate: Covariate, way: FloatArray, n_terms: int) -> FloatArray:
    """Return cosines along the covariate times `way`, (n_points, n_columns), finer where `way` squared is larger."""
    values, weight = covariate.values, way[covariate.rows] ** 2
    distinct, codes = np.unique(values, return_inverse=True)
    share = np.cumsum(np.bincount(codes, weight + 1e-3 * weight.mean()))
    if share[-1] == 0:
        return np.zeros((len(way), n_terms))
    along = (share / share[-1] - 0.5 * np.diff(share, prepend=0.0) / share[-1])[codes]
    if covariate.name == "level":  # most readings are at its ends, but curvature shows in between
        along = 0.5 * along + 0.5 * (values - distinct[0]) / np.ptp(distinct)
    waves = np.cos(np.pi * along[:, None] * np.arange(0 if np.ptp(way) else 1, n_terms + 1))
    return _on_all_rows(waves * way[covariate.rows, None], covariate, len(way))


def _step_bases(covariate: Covariate, way: FloatArray) -> Iterator[FloatArray]:
    """Yield 15 bases: `way` after a change point, 0 before; between points, the sums of `way` squared are equal."""
    values, weight = covariate.values, way[covariate.rows] ** 2
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weight[order])
    for k in range(1, _N_STEPS + 1):
        at = values[order][min(int(np.searchsorted(share, share[-1] * k / (_N_STEPS + 1))), len(values) - 1)]
        yield _on_all_rows(((values > at) * way[covariate.rows])[:, None], covariate, len(way))


def _window_bases(covariate: Covariate, way: FloatArray, parts: Sequence[int]) -> Iterator[FloatArray]:
    order, n = np.argsort(covariate.values, kind="stable"), len(covariate.values)
    for n_parts in parts:
        width = max(n // n_parts, 2)
        for first in range(0, n - width + 1, max(width // 2, 1)):
            window = np.zeros(n)
            window[order[first : first + width]] = 1.0
            yield _on_all_rows((window * way[covariate.rows])[:, None], covariate, len(way))


def _on_all_rows(columns: FloatArray, covariate: Covariate, n_points: int) -> FloatArray:
    out = np.zeros((n_points, columns.shape[1]))
    out[covariate.rows] = columns
    return out
