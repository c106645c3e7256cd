"""A covariate of residuals."""

from __future__ import annotations

from dataclasses import dataclass

from probewise._arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Covariate:
    """One covariate of the usable rows.

    `values` (n_usable,) in its unit; `rows` the usable rows for which it is defined; `groups`: it is categorical (an
    orientation, a scan); `scan`: the name of the scan to which it is restricted, or None.
    """

    name: str
    values: FloatArray
    rows: IntArray
    groups: bool = False
    scan: str | None = None
