"""Scenes: what lies under the sensor, known from a recording's description or a hypothesis."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

from probewise._arrays import FloatArray
from probewise._kinds import require_kind
from probewise.errors import ParameterError
from probewise.priors import Empty, Prior
from probewise.recordings.columns import require_patterns
from probewise.recordings.patterns import Pattern
from probewise.scene.albedo import Region, Shape, require_shape
from probewise.scene.patterns import region_of


@dataclass(frozen=True)
class KnownScene:
    """Known patterns by name: no free parameters."""

    patterns: Mapping[str, Pattern]

    def __post_init__(self) -> None:
        require_kind("patterns", self.patterns, Mapping, "patterns by name: {'edge': HalfPlane(...)}")
        require_patterns(self.patterns)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its free parameters: none."""
        return ()

    @property
    def prior(self) -> Prior:
        """The prior of no parameters."""
        return Empty()

    def regions(self, theta: FloatArray) -> Mapping[str, Region]:
        """Return the region by pattern name; theta (n_samples, 0) is ignored."""
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
        """Names of the shape's parameters."""
        return self.shape.prior.names

    @property
    def prior(self) -> Prior:
        """The shape's prior."""
        return self.shape.prior

    def regions(self, theta: FloatArray) -> Mapping[str, Region]:
        """Return, for any pattern name, the regions of the hypotheses, one per row of theta (n_samples, n_params)."""
        return OneRegionForAllNames(self.shape.region(theta))


@dataclass(frozen=True, eq=False)
class OneRegionForAllNames(Mapping[str, Region]):
    """A mapping from every name to one `region`; as its only key it lists "hypothesis"."""

    region: Region

    def __getitem__(self, name: str) -> Region:
        if not isinstance(name, str):
            raise ParameterError("pattern name", name, "a text")
        return self.region

    def __iter__(self) -> Iterator[str]:
        return iter(("hypothesis",))

    def __len__(self) -> int:
        return 1
