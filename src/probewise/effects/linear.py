"""Bases of effects that are linear in all their parameters; a subclass adds the formula."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.effects.heavy_tailed_prior import HeavyTailedPrior
from probewise.effects.vocabulary import NamedEffect, V
from probewise.priors import Product


class LinearEffect(NamedEffect[V]):
    """Base of effects whose readings change in proportion to each parameter, to first order.

    A subclass is a frozen dataclass with one field that begins with `typical`: the typical size of every parameter.
    """

    parameters: ClassVar[tuple[str, ...]]
    """Names of the parameters."""
    positive = False
    """Whether the parameters are never negative."""

    @cached_property
    def _typical_size(self) -> float:
        (name,) = (each.name for each in fields(self) if each.name.startswith("typical"))  # type: ignore[arg-type]
        return float(getattr(self, name))

    @property
    def amplitudes(self) -> tuple[int, ...]:
        """Indices of all parameters."""
        return tuple(range(len(self.parameters)))

    @cached_property
    def prior(self) -> Product:
        """The same heavy-tailed prior for each parameter."""
        size = HeavyTailedPrior(self._typical_size, positive=self.positive)
        return Product(dict.fromkeys(self.parameters, size))

    def bank(self) -> FloatArray:
        """Return one entry with a column for each parameter, (1, n_params, n_params)."""
        return self._typical_size * np.eye(len(self.parameters))[None, :, :]


@dataclass(frozen=True)
class ScanGroupEffect(LinearEffect[V]):
    """Base of linear effects on one scan, or on all scans of one mounting (orientation).

    `scans` are the affected scans, chosen among the groups of scans in `choices`.
    """

    scans: tuple[str, ...] = ()
    choices: tuple[tuple[str, ...], ...] = ()

    def variants(self) -> tuple[Self, ...]:
        return tuple(replace(self, scans=choice) for choice in self.choices)


def scans_in_words(scans: tuple[str, ...]) -> str:
    """Return the names of scans as a phrase: "scan a", or "scans a, b"."""
    return f"scan{'s' if len(scans) > 1 else ''} {', '.join(scans)}"
