"""How many further readings separate two aliased effects, with all other parameters refitted to old and new ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from probewise._arrays import BoolArray, FloatArray, IntArray
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.scheduling import MOST_READINGS
from probewise.effects import NamedEffect
from probewise.recordings.plan import Plan

COUNTS = np.array([0, 1, 2, 3, 4, 6, 8, 12, 18, 26, 36, 51, 72, MOST_READINGS])
"""Numbers of further readings that are tried."""

_FREE = 1e-6  # prior precision of a rival's amounts, in changes of one noise sd: they are free


@dataclass(frozen=True, eq=False)
class EffectEntry:
    """An effect at the settings of its parameters, (n_columns, n_effect_params), that make one template."""

    effect: NamedEffect[Any]
    settings: FloatArray

    def changes(self, found: Fit, plan: Plan, without: FloatArray) -> FloatArray:
        """Return the change of a plan's readings by each setting, about a fit, (n_points, n_columns).

        `without` are the predictions of the fit, (n_points,). Changes are not finite where the model diverges.
        """
        model = replace(found.model, plan=plan).with_effect(self.effect)
        own = model.z_of_last_effect(self.settings)
        points = np.concatenate([np.repeat(found.z[None, :], len(own), axis=0), own], axis=1)
        with np.errstate(all="ignore"):
            return np.asarray((model.predict(points) - without).T)


@dataclass(frozen=True, eq=False)
class Amounts:
    """A change by an effect, as amounts of its columns: `values` (n_columns,)."""

    name: str
    values: FloatArray

    @property
    def variance(self) -> float:
        """Variance of the amounts, and so of one more."""
        return max(float(np.var(self.values)), 1e-12)


@dataclass(frozen=True, eq=False)
class LinearReadings:
    """Readings linearised about a fit, in noise sds: `slopes` (n_points, n_params) and `columns` (n_points, n_columns).

    Slopes are by the fit's coordinates, which have a standard normal prior; columns are changes by effects.
    """

    slopes: FloatArray
    columns: FloatArray


@dataclass(frozen=True, eq=False)
class ReadingsWithEffects:
    """Old readings and possible further ones, linearised about a fit, with the columns of several effects.

    Parameters
    ----------
    old, further
        The readings.
    of_effect
        Numbers of each effect's columns, by name.
    of_run, columns_of_run
        Masks of the coordinates, and of the columns, of which each run has a value of its own.
    """

    old: LinearReadings
    further: LinearReadings
    of_effect: Mapping[str, IntArray]
    of_run: BoolArray
    columns_of_run: BoolArray

    @classmethod
    def of(
        cls,
        problem: Linearised,
        found: Fit,
        entries: Mapping[str, EffectEntry],
        *,
        usable: IntArray,
        plan: Plan,
        apparatus: Apparatus,
    ) -> Self:
        """Linearise about a fit the readings of its `usable` rows, and those of a `plan` of further ones.

        An effect's columns are scaled to a length of one noise sd in all, on the old readings.
        """
        model, predicted = found.model, found.model.predict(found.z[None, :])[0]
        expected, slopes = replace(model, plan=plan).predict_and_differentiate(found.z)
        n_known = len(apparatus.coordinates_of_new_run(model))
        old, further, of_run = [], [], []
        for entry in entries.values():
            columns = problem.whiten(entry.changes(found, model.plan, predicted)[usable])
            length = max(float(np.linalg.norm(columns)), 1e-300)
            old.append(columns / length)
            further.append(entry.changes(found, plan, expected) / problem.sd / length)
            varies = len(apparatus.coordinates_of_new_run(model.with_effect(entry.effect))) > n_known
            of_run.append(np.full(columns.shape[1], varies))
        ends = np.cumsum([columns.shape[1] for columns in old])
        return cls(
            LinearReadings(problem.whiten(found.slopes), np.concatenate(old, axis=1)),
            LinearReadings(slopes / problem.sd, np.concatenate(further, axis=1)),
            dict(zip(entries, np.split(np.arange(ends[-1]), ends[:-1]), strict=True)),
            np.isin(np.arange(model.n_params), apparatus.coordinates_of_new_run(model)),
            np.concatenate(of_run),
        )

    def in_one_run(self, rows: IntArray) -> NatsInOneRun:
        """Return the readings with those further ones alone whose row numbers are these: rows of one run."""
        further = LinearReadings(self.further.slopes[rows], self.further.columns[rows])
        return NatsInOneRun(self.old, further, self.of_effect, self.of_run, self.columns_of_run)


@dataclass(frozen=True, eq=False)
class NatsInOneRun(ReadingsWithEffects):
    """Nats that separate effects after any number of readings, evenly spread, of one further run."""

    def nats_against(self, truth: Amounts, rival: Amounts) -> FloatArray:
        """Return the expected log Bayes factor of an effect that acts over another, which is refitted, (n_counts,).

        It is a Kullback-Leibler divergence of normal distributions: of an effect with a value per run, that of the
        further run is normal with the mean and the variance of the others. NaN if an effect has no finite change.
        """
        columns, others = self.of_effect[truth.name], self.of_effect[rival.name]
        own, others_own = self._numbers_of_own_values(columns), self._numbers_of_own_values(others)
        every, fitted = np.concatenate([columns, own]), np.concatenate([others, others_own])
        products = self._projected_products
        among = products[:, fitted[:, None], fitted]
        along = products[:, fitted[:, None], every]
        left = products[:, every[:, None], every]
        if not (np.isfinite(among).all() and np.isfinite(left).all()):
            return np.full(len(COUNTS), np.nan)
        prior = np.concatenate([np.full(len(others), _FREE), np.full(len(others_own), 1 / rival.variance)])
        left = left - along.transpose(0, 2, 1) @ np.linalg.solve(among + np.diag(prior), along)
        n = len(columns)
        twice = np.einsum("i,mij,j->m", truth.values, left[:, :n, :n], truth.values)
        if own.size:
            spread = np.eye(len(own)) + truth.variance * products[:, own[:, None], own]
            twice += truth.variance * np.einsum("mii->m", left[:, n:, n:]) - np.linalg.slogdet(spread)[1]
        if others_own.size:
            spread = np.eye(len(others_own)) + rival.variance * products[:, others_own[:, None], others_own]
            absorbed = len(others_own) - np.einsum("mii->m", np.linalg.inv(spread))
            twice += np.linalg.slogdet(spread)[1] - absorbed
        return np.asarray(0.5 * twice)

    def _numbers_of_own_values(self, columns: IntArray) -> IntArray:
        """Return the numbers, behind all columns, of the columns by the further run's own values of an effect."""
        number = self.old.columns.shape[1] + np.cumsum(self.columns_of_run) - 1
        return np.asarray(number[columns[self.columns_of_run[columns]]])

    @cached_property
    def _projected_products(self) -> FloatArray:
        """Products of all columns with the parameters, and their prior, projected out, (n_counts, k, k)."""
        n_old, n_params = self.old.slopes.shape
        own, own_columns = self.further.slopes[:, self.of_run], self.further.columns[:, self.columns_of_run]
        shared, shared_columns = self.further.slopes.copy(), self.further.columns.copy()
        shared[:, self.of_run] = 0.0
        for numbers in self.of_effect.values():  # the new run's value is about the mean of the others
            if self.columns_of_run[numbers].all():
                shared_columns[:, numbers] = shared_columns[:, numbers].mean(axis=1, keepdims=True)
        absent, absent_columns = np.zeros((n_old, own.shape[1])), np.zeros((n_old, own_columns.shape[1]))
        before = np.concatenate([self.old.slopes, absent, self.old.columns, absent_columns], axis=1)
        after = np.concatenate([shared, own, shared_columns, own_columns], axis=1)
        p = n_params + own.shape[1]
        products = before.T @ before + COUNTS[:, None, None] * (after.T @ after / len(after))
        products[:, :p, :p] += np.eye(p)
        scale = np.sqrt(np.einsum("mii->mi", products[:, :p, :p]))[:, :, None]  # against rounding
        among, with_columns = products[:, :p, :p] / (scale * scale.transpose(0, 2, 1)), products[:, :p, p:] / scale
        if not np.isfinite(among).all():
            return np.full_like(products[:, p:, p:], np.nan)
        absorbed = with_columns.transpose(0, 2, 1) @ np.linalg.solve(among, with_columns)
        return np.asarray(products[:, p:, p:] - absorbed)
