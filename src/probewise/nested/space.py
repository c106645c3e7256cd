"""Sampling coordinates: the unit cube, or coordinates supplied by the prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import BoolArray, FloatArray
from probewise.errors import ParameterError
from probewise.priors import Coordinates, Prior, require_prior

_EDGE = 1e-15


class Space(Protocol):
    """The coordinates in which chains move, with the prior's density in the coordinates."""

    @property
    def periodic(self) -> tuple[int, ...]:
        """Columns of the periodic coordinates, which have range 0 to 1."""
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
        """Map parameters to coordinates, both (n, n_params)."""
        ...

    def leave(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map coordinates to parameters, (n, n_params); also return the prior's log density in them, (n,)."""
        ...

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        """Draw coordinates from the prior, (n, n_params)."""
        ...


def within_bounds_mask(space: Space, u: FloatArray) -> BoolArray:
    """Return a mask of the points, (n, n_params) -> (n,), strictly within the bounds of every coordinate."""
    return np.asarray(((u > space.low) & (u < space.high)).all(axis=1))


@dataclass(frozen=True)
class _UnitCubeSpace:
    """The unit cube, in which the prior is uniform; `periodic` columns are wrapped."""

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
class _NormalScoreCoordinates:
    """Normal scores of the unit cube: coordinates with a standard normal prior."""

    prior: Prior

    def enter(self, theta: FloatArray) -> FloatArray:
        return np.asarray(ndtri(np.clip(self.prior.to_unit_cube(theta), _EDGE, 1.0 - _EDGE)))

    def leave(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        cube = np.clip(ndtr(u), _EDGE, 1.0 - _EDGE)
        return self.prior.from_unit_cube(cube), -0.5 * (u * u + np.log(2 * np.pi)).sum(axis=1)

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray:
        return rng.standard_normal((n, len(self.prior.names)))


@dataclass(frozen=True)
class _UnboundedSpace:
    """Coordinates without bounds: the prior's own, or normal scores."""

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
        if isinstance(self.coordinates, _CoordinatesWithDraw):
            return self.coordinates.draw(n, rng=rng)
        return self.enter(self.prior.from_unit_cube(rng.random((n, len(self.prior.names)))))


@runtime_checkable
class _PriorWithCoordinates(Protocol):
    """A prior with sampling coordinates of its own."""

    @property
    def coordinates(self) -> Coordinates: ...


@runtime_checkable
class _CoordinatesWithDraw(Protocol):
    """Coordinates with a draw from the prior of their own, because some coordinates match no possible parameters."""

    def draw(self, n: int, *, rng: np.random.Generator) -> FloatArray: ...


def space_of(prior: Prior, periodic: Sequence[str] = ()) -> Space:
    """Choose the sampling coordinates: the prior's own if it has any, else the unit cube.

    Raises
    ------
    ParameterError
        If `periodic` names parameters that the prior does not have, or the prior has its own coordinates.
    """
    own = isinstance(prior, _PriorWithCoordinates)
    if periodic and (own or not set(periodic) <= set(prior.names)):
        allowed = "none: the prior has coordinates of its own" if own else f"names among {prior.names}"
        raise ParameterError("periodic", tuple(periodic), allowed)
    if isinstance(prior, _PriorWithCoordinates):
        return _UnboundedSpace(prior, prior.coordinates)
    return _UnitCubeSpace(prior, tuple(prior.names.index(name) for name in periodic))


def unbounded_space_of(prior: Prior) -> Space:
    """Choose unbounded coordinates, as fitted densities need them: the prior's own, else normal scores.

    Raises
    ------
    ParameterError
        If the prior has neither coordinates of its own nor `to_unit_cube`.
    """
    if isinstance(prior, _PriorWithCoordinates):
        return _UnboundedSpace(prior, prior.coordinates)
    require_prior("problem.prior", prior, "to_unit_cube")
    return _UnboundedSpace(prior, _NormalScoreCoordinates(prior))
