"""What a residual may depend on."""

from __future__ import annotations

from dataclasses import dataclass

from probewise._arrays import FloatArray, IntArray

__all__ = ["Covariate"]


@dataclass(frozen=True, eq=False)
class Covariate:
    """One covariate of the usable rows.

    `values` (n_usable,) in its unit; `rows` those usable rows it is defined for; `groups` says that
    only whole groups of equal values make sense (an orientation, a scan). `scan` is the scan's name
    where it is meant within one scan.
    """

    name: str
    values: FloatArray
    rows: IntArray
    groups: bool = False
    scan: str | None = None
