"""Say in which coordinates chains step: the unit cube, or those that the prior says are better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.priors import Coordinates, Prior, require_prior

__all__ = ["Space", "space_of", "unbounded"]

_EDGE = 1e-15


class Space(Protocol):
    """Where chains step; the prior has a density there."""

    @property
    def periodic(self) -> tuple[int, ...]:
        """Columns of the coordinates that go round, with period one from 0 on."""
        ...

    @property
    def low(self) -> FloatArray:
        """Least value of each coordinate, (n_params,); -inf where there is none."""
        ...

    @property
    def high(self) -> FloatArray:
        """Greatest value of each coordinate, (n_params,); inf where there is none."""
        ...

    def enter(self, theta: FloatArray) -> FloatArray:
        """Map parameters to coordinates, (n, n_params) both ways."""
        ...

    def leave(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n, n_params); also the prior's log density over them, (n,)."""
        ...

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw coordinates from the prior, (n, n_params)."""
        ...


@dataclass(frozen=True)
class _Cube:
    """The unit cube, where every prior is even; `periodic` columns go round, so that any number is a place there."""

    prior: Prior
    periodic: tuple[int, ...] = ()

    @property
    def low(self) -> FloatArray:
        return np.zeros(len(self.prior.names))

    @property
    def high(self) -> FloatArray:
        return np.ones(len(self.prior.names))

    def enter(self, theta: FloatArray) -> FloatArray:
        return self.prior.to_unit_cube(theta)

    def leave(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        if self.periodic:
            u = u.copy()
            u[:, self.periodic] %= 1.0
        return self.prior.from_unit_cube(u), np.zeros(len(u))

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        return rng.random((n, len(self.prior.names)))


@dataclass(frozen=True)
class _Normal:
    """The unit cube drawn out: every coordinate has a standard normal prior, and no walls."""

    prior: Prior

    @property
    def periodic(self) -> tuple[int, ...]:
        return ()

    @property
    def low(self) -> FloatArray:
        return np.full(len(self.prior.names), -np.inf)

    @property
    def high(self) -> FloatArray:
        return np.full(len(self.prior.names), np.inf)

    def enter(self, theta: FloatArray) -> FloatArray:
        return np.asarray(ndtri(np.clip(self.prior.to_unit_cube(theta), _EDGE, 1.0 - _EDGE)))

    def leave(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        cube = np.clip(ndtr(u), _EDGE, 1.0 - _EDGE)
        return self.prior.from_unit_cube(cube), -0.5 * (u * u + np.log(2 * np.pi)).sum(axis=1)

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        return rng.standard_normal((n, len(self.prior.names)))


@dataclass(frozen=True)
class _Own:
    """The prior's own coordinates."""

    prior: Prior
    coordinates: Coordinates

    @property
    def periodic(self) -> tuple[int, ...]:
        return ()

    @property
    def low(self) -> FloatArray:
        return np.full(len(self.prior.names), -np.inf)

    @property
    def high(self) -> FloatArray:
        return np.full(len(self.prior.names), np.inf)

    def enter(self, theta: FloatArray) -> FloatArray:
        return self.coordinates.enter(theta)

    def leave(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.coordinates.leave(u)

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        if isinstance(self.coordinates, _Draws):
            return self.coordinates.draw(n, rng=rng)
        return self.enter(self.prior.from_unit_cube(rng.random((n, len(self.prior.names)))))


@runtime_checkable
class _HasCoordinates(Protocol):
    @property
    def coordinates(self) -> Coordinates: ...


@runtime_checkable
class _Draws(Protocol):
    """Coordinates of which some lead nowhere: no parameters stand for those, and they have to be drawn themselves."""

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray: ...


def space_of(prior: Prior, periodic: Sequence[str] = ()) -> Space:
    """Choose where chains step: the prior's own coordinates if it has any, else the unit cube.

    Raises
    ------
    ParameterError
        If parameters are `periodic` that the prior does not have, or that it has in coordinates of its own.
    """
    own = isinstance(prior, _HasCoordinates)
    if periodic and (own or not set(periodic) <= set(prior.names)):
        allowed = "none: the prior has coordinates of its own" if own else f"names among {prior.names}"
        raise ParameterError("periodic", tuple(periodic), allowed)
    if isinstance(prior, _HasCoordinates):
        return _Own(prior, prior.coordinates)
    return _Cube(prior, tuple(prior.names.index(name) for name in periodic))


def unbounded(prior: Prior) -> Space:
    """Choose coordinates without walls, for densities that know none: the prior's own, else normal scores.

    Raises
    ------
    ParameterError
        If the prior has neither coordinates of its own nor `to_unit_cube`.
    """
    if isinstance(prior, _HasCoordinates):
        return _Own(prior, prior.coordinates)
    require_prior("problem.prior", prior, "to_unit_cube")
    return _Normal(prior)
