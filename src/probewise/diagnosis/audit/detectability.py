"""Detectability of effects under a plan: norms and cosines of their projected templates.

Linear algebra about one expected sensor, before any reading: templates of every effect at many settings, with the
sensor's own parameters projected out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence.laplace import orthonormalise_groups
from probewise.diagnosis.evidence.templates import templates_of_effect
from probewise.diagnosis.fitting.fit import Fit, Model
from probewise.diagnosis.fitting.null import Null
from probewise.effects import Extent, NamedEffect
from probewise.recordings.plan import Plan
from probewise.sensor import Stage

LAMBDA = 8.0  # size of an effect at which a plan is judged
LEAST_NATS = 3.0  # least evidence that separates two effects
ALIAS = math.sqrt(1 - 2 * LEAST_NATS / LAMBDA**2)  # the cosine at which the evidence is LEAST_NATS
LEAST_SHARE = 0.05  # least share of an effect's template that the sensor's parameters must not absorb
_MOST_NUMBERS = 2_000_000  # readings times settings of one effect's bank, beyond which the bank is thinned


def nats_from_cosine(cosine: float) -> float:
    """Return the expected log Bayes factor between two effects of lambda 8 with this cosine of projected templates."""
    return 0.5 * LAMBDA**2 * (1 - cosine**2)


@dataclass(frozen=True, eq=False)
class ExpectedSensor:
    """The expected sensor: `null` with its prior, point `z` (n_params,) of linearisation, low and high level, sd."""

    null: Null
    z: FloatArray
    levels: tuple[float, float]
    sd: float


@dataclass(frozen=True, eq=False)
class PlanTemplates:
    """The templates of all effects under one plan: changes of its readings, in noise sds.

    `columns` (n_points, n_columns) are grouped in entries: one for each setting (parameter values) of an effect's
    bank. `entry` (n_columns,) is the entry of each column, `owner` (n_entries,) the index of its effect in `names`,
    `settings` its parameter values. `slopes` (n_points, n_params) are those of the sensor. `built`: effects by name.
    """

    slopes: FloatArray
    columns: FloatArray
    entry: IntArray
    owner: IntArray
    names: tuple[str, ...]
    built: Mapping[str, NamedEffect[Any]]
    settings: tuple[FloatArray, ...]

    @classmethod
    def of(
        cls,
        expected: ExpectedSensor,
        plan: Plan,
        effects: Mapping[str, type[NamedEffect[Any]]],
        *,
        most: int | None = None,
    ) -> Self:
        """Scale the effects to a plan and build their templates, without effects on the noise or that cannot act there.

        Each has at most `most` settings, evenly spread; by default as many as hold two million numbers, but 64 or more.
        """
        extent = Extent(*expected.levels, plan)
        maybe = {name: kind.for_extent(extent) for name, kind in effects.items()}
        return cls.of_scaled_effects(
            expected, plan, {name: effect for name, effect in maybe.items() if effect is not None}, most=most
        )

    @classmethod
    def of_scaled_effects(
        cls, expected: ExpectedSensor, plan: Plan, built: Mapping[str, NamedEffect[Any]], *, most: int | None = None
    ) -> Self:
        """Build the templates of effects that are already scaled to the plan, as `of` does."""
        most = max(_MOST_NUMBERS // len(plan), 64) if most is None else most
        model = Model(expected.null, (), plan)
        predicted, slopes = model.predict_and_differentiate(expected.z)
        found = Fit(model, expected.z, predicted, np.zeros(len(plan)), slopes, sd=expected.sd, objective=0.0)
        columns = [np.zeros((len(plan), 0))]
        settings: list[FloatArray] = []
        owner: list[int] = []
        for at, effect in enumerate(built.values()):
            if effect.stage is Stage.NOISE:
                continue
            templates = templates_of_effect(found, effect, np.arange(len(plan)), most=most)
            columns += templates.columns
            settings += templates.settings
            owner += [at] * len(templates.columns)
        entry = np.repeat(np.arange(len(settings)), [c.shape[1] for c in columns[1:]])
        return cls(
            slopes / expected.sd,
            np.concatenate(columns, axis=1) / expected.sd,
            entry,
            np.array(owner, dtype=np.int64),
            names=tuple(built),
            built=built,
            settings=tuple(settings),
        )

    def norms_of_entries(self, columns: FloatArray) -> FloatArray:
        """Return the root of the sum of squares of each entry's columns, (n_points, n_columns) -> (n_entries,)."""
        return np.asarray(np.sqrt(np.bincount(self.entry, np.einsum("ij,ij->j", columns, columns), len(self.owner))))


@dataclass(frozen=True, eq=False)
class ProjectedTemplates:
    """Templates on some rows with the sensor's parameters projected out, in noise sds: `left` (n_rows, n_columns).

    Rows are `n_points` readings, then one for each parameter's prior. `basis` holds each entry's columns
    orthonormalised; `raw` and `kept` (n_entries,) are the norms before and after the projection.
    """

    laid: PlanTemplates
    left: FloatArray
    basis: FloatArray
    raw: FloatArray
    kept: FloatArray
    n_points: int

    @classmethod
    def of(cls, laid: PlanTemplates, rows: IntArray) -> Self:
        """Project the sensor's parameters, with their prior, out of the templates on these row numbers."""
        slopes, columns = laid.slopes[rows], laid.columns[rows]
        n_points, n_params = slopes.shape
        own, _ = np.linalg.qr(np.concatenate([slopes, np.eye(n_params)]))
        left = -own @ (own[:n_points].T @ columns)
        left[:n_points] += columns
        return cls(
            laid,
            left,
            _orthonormalise_entries(left, laid.entry),
            laid.norms_of_entries(columns),
            laid.norms_of_entries(left),
            n_points,
        )

    def detectable_shares_and_cosines(
        self, asked: Sequence[str] | None = None
    ) -> dict[str, tuple[float, dict[str, float]]]:
        """Return, by effect, its detectable share (of the norm), and its cosine to every other effect, by name.

        Both are medians over the effect's settings; the cosine is to the best-imitating setting of the other effect.
        Only effects in `asked` have cosines, by default all, and only between shares of 0.05 or more.
        """
        laid = self.laid
        present = {name: self._active_entry_indices(k) for k, name in enumerate(laid.names) if np.any(laid.owner == k)}
        shares = {
            name: float(np.median(self.kept[mine] / self.raw[mine])) if mine.size else 0.0
            for name, mine in present.items()
        }
        visible = [name for name, share in shares.items() if share >= LEAST_SHARE]
        wanted = [name for name in (visible if asked is None else asked) if name in visible]
        out: dict[str, tuple[float, dict[str, float]]] = {name: (share, {}) for name, share in shares.items()}
        if not wanted:
            return out
        mine = np.concatenate([present[name] for name in wanted])
        columns = np.flatnonzero(np.isin(laid.entry, mine))
        onto = (self.basis.T @ self.left[:, columns]) ** 2  # of each column, on every direction of the others
        onto = np.add.reduceat(onto, _run_start_indices(laid.entry), axis=0)
        onto = np.add.reduceat(onto, _run_start_indices(laid.entry[columns]), axis=1)
        mine = np.unique(laid.entry[columns])
        best = np.maximum.reduceat(onto, _run_start_indices(laid.owner), axis=0) / np.maximum(
            self.kept[mine] ** 2, 1e-300
        )
        cosines = np.sqrt(np.minimum(best, 1.0))
        owners = [laid.names[k] for k in laid.owner[_run_start_indices(laid.owner)]]
        for name in wanted:
            typical = np.median(cosines[:, laid.owner[mine] == laid.names.index(name)], axis=1)
            like = dict(zip(owners, typical.tolist(), strict=True))
            out[name] = (shares[name], {other: like[other] for other in visible if other != name})
        return out

    def _active_entry_indices(self, effect: int) -> IntArray:
        """Return the indices of the entries of an effect, given by its index, that act on these rows."""
        mine = np.flatnonzero(self.laid.owner == effect)
        return mine[self.raw[mine] > 1e-6 * max(float(self.raw[mine].max(initial=0.0)), 1e-6)]

    def smallest_detectable_amplitudes(self, effect: NamedEffect[Any]) -> tuple[float | None, ...]:
        """Return each amplitude's value at which an effect has lambda 8, median over settings; None if it has none."""
        at = np.flatnonzero(self.laid.owner == self.laid.names.index(effect.name))
        columns = np.flatnonzero(np.isin(self.laid.entry, at))
        settings = np.concatenate([self.laid.settings[k] for k in at])
        lengths = np.linalg.norm(self.left[:, columns], axis=0)
        out: list[float | None] = []
        for k in effect.amplitudes:
            significant = (settings[:, k] != 0) & (lengths > 1e-3)
            sizes = np.abs(settings[significant, k]) * LAMBDA / lengths[significant]
            out.append(float(np.median(sizes)) if sizes.size else None)
        return tuple(out)


def _run_start_indices(codes: IntArray) -> IntArray:
    return np.flatnonzero(np.diff(codes, prepend=-1))


def _orthonormalise_entries(columns: FloatArray, entry: IntArray) -> FloatArray:
    """Orthonormalise each entry's columns; directions below a thousandth of the longest become zero."""
    out = np.zeros_like(columns)
    widths = np.bincount(entry)
    for width in np.unique(widths):  # all entries of one width at a time
        mine = np.flatnonzero(widths[entry] == width)
        out[:, mine], _ = orthonormalise_groups(columns[:, mine], int(width), least=1e-18, share=1e-6)
    return out
