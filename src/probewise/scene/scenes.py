"""Scenes: what lies under the sensor, known from a recording's description or a hypothesis; and cards on it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from probewise._arrays import FloatArray
from probewise._kinds import checked_number, require_kind
from probewise.errors import require
from probewise.recordings.columns import require_patterns
from probewise.recordings.patterns import Pattern
from probewise.scene.regions import PolygonRegion, Region, edge_distance, outlines, region_of
from probewise.scene.shapes import Shape, require_shape


class Scene(Protocol):
    """What lies under the sensor in one plan: a region for each pattern name."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its free parameters; () where everything is known."""
        ...

    def regions(self, theta: FloatArray) -> Mapping[str, Region]:
        """Return by pattern name the regions of the hypotheses, one per row of theta (n_samples, n_params)."""
        ...


@dataclass(frozen=True)
class KnownScene:
    """Known patterns by name: no free parameters."""

    patterns: Mapping[str, Pattern]

    def __post_init__(self) -> None:
        require_kind("patterns", self.patterns, Mapping, "patterns by name: {'edge': HalfPlane(...)}")
        require_patterns(self.patterns)

    @property
    def names(self) -> tuple[str, ...]:
        return ()

    def regions(self, theta: FloatArray) -> Mapping[str, Region]:
        return self._region_by_name

    @cached_property
    def _region_by_name(self) -> Mapping[str, Region]:
        return {name: region_of(pattern) for name, pattern in self.patterns.items()}


@dataclass(frozen=True)
class HypothesisScene:
    """One shape with unknown parameters under every reading, whatever the pattern's name."""

    shape: Shape

    def __post_init__(self) -> None:
        require_shape(self.shape)

    @property
    def names(self) -> tuple[str, ...]:
        return self.shape.prior.names

    def regions(self, theta: FloatArray) -> Mapping[str, Region]:
        """Return, for any pattern name, the regions of the hypotheses, one per row of theta (n_samples, n_params)."""
        return OneRegionForAllNames(self.shape.region(theta))


@dataclass(frozen=True, eq=False)
class OneRegionForAllNames(Mapping[str, Region]):
    """A mapping from every name to one `region`; as its only key it lists "hypothesis"."""

    region: Region

    def __getitem__(self, name: str) -> Region:
        require(isinstance(name, str), "pattern name", name, "a text")
        return self.region

    def __iter__(self) -> Iterator[str]:
        return iter(("hypothesis",))

    def __len__(self) -> int:
        return 1


@dataclass(frozen=True)
class Card:
    """A rectangle about (x_mm, y_mm), sides along X and Y; albedo 0 is as dark as the field, 1 as the shape."""

    x_mm: float
    y_mm: float
    width_mm: float
    height_mm: float
    albedo: float

    def __post_init__(self) -> None:
        for name in ("x_mm", "y_mm", "width_mm", "height_mm", "albedo"):
            checked_number(name, getattr(self, name))
        place = self.x_mm, self.y_mm
        require(all(map(math.isfinite, place)), "(x_mm, y_mm) of a card", place, "finite: its centre")
        for name in ("width_mm", "height_mm"):
            side = getattr(self, name)
            require(0 < side < math.inf, f"{name} of a card", side, "finite, greater than 0")
        allowed = "0 to 1: 0 is as dark as the field, 1 as white as the shape"
        require(0 <= self.albedo <= 1, "albedo of a card", self.albedo, allowed)

    @property
    def corners_mm(self) -> FloatArray:
        """Its corners, anticlockwise from the lower left, (4, 2)."""
        half = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) / 2
        return np.asarray(np.array([self.x_mm, self.y_mm]) + half * (self.width_mm, self.height_mm))

    @cached_property
    def region(self) -> PolygonRegion:
        """The area of the card as a region with albedo 1 inside and 0 outside."""
        return PolygonRegion.from_vertices(self.corners_mm[None])

    @property
    def informative_places_mm(self) -> FloatArray:
        """Places where readings of the card are most informative: its middle and the middles of its sides, (5, 2)."""
        half_x, half_y = self.width_mm / 2, self.height_mm / 2
        away = np.array([[0.0, 0.0], [-half_x, 0.0], [half_x, 0.0], [0.0, -half_y], [0.0, half_y]])
        return np.asarray(np.array([self.x_mm, self.y_mm]) + away)


@dataclass(frozen=True, eq=False)
class CardedRegion:
    """A region with cards on it, later ones on top; `outlines` and `edge_distance` are those of the region alone."""

    region: Region
    cards: tuple[Card, ...]

    @property
    def n_regions(self) -> int:
        return self.region.n_regions

    def albedo(self, points_mm: FloatArray) -> FloatArray:
        covered = [card.region.albedo(points_mm) for card in self.cards]
        return mean_albedo_with_cards(self.region.albedo(points_mm), self.cards, covered)


def mean_albedo_with_cards(seen: FloatArray, cards: Sequence[Card], covered: Sequence[FloatArray]) -> FloatArray:
    """Return the white fraction seen with cards: `seen` is that without, `covered` each card's share of the view.

    Exact unless a view contains both an edge of a card and an edge of what lies below the cards. There, the albedo
    under the card is taken to be the mean albedo of the view.
    """
    for card, share in zip(cards, covered, strict=True):
        seen = np.asarray(seen * (1.0 - share) + card.albedo * share)
    return seen


@outlines.register
def _outlines_of_carded_region(region: CardedRegion, *, n_vertices: int = 96) -> list[FloatArray]:
    return outlines(region.region, n_vertices=n_vertices)


@edge_distance.register
def _edge_distance_of_carded_region(region: CardedRegion, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
    return edge_distance(region.region, x_mm, y_mm)


@dataclass(frozen=True)
class CardedScene(HypothesisScene):
    """One shape of unknown parameters, and known cards on it, under every reading."""

    cards: tuple[Card, ...] = field(default=())

    def regions(self, theta: FloatArray) -> OneRegionForAllNames:
        """Return, for any pattern name, the shape's regions with the cards on them, theta (n_samples, n_params)."""
        return OneRegionForAllNames(CardedRegion(self.shape.region(theta), self.cards))
