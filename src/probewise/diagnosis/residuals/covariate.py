"""A covariate of residuals: a quantity of each reading on which a mismatch could depend."""

from __future__ import annotations

from dataclasses import dataclass

from probewise._arrays import FloatArray, IntArray
from probewise.systems.table import published_covariate


@dataclass(frozen=True, eq=False)
class Covariate:
    """One covariate (time, place, level, ...) of the usable readings.

    `rows` (n_rows,): indices of the usable readings for which it is defined; `values` (n_rows,): its values there, in
    its unit; `groups`: whether it is categorical (an orientation, a scan); `scan`: name of the scan to which it is
    restricted, or None.
    """

    name: str
    values: FloatArray
    rows: IntArray
    groups: bool = False
    scan: str | None = None

    @property
    def published_name(self) -> str:
        """Its name in results: without the prefix "column:" where no covariate of a table has that name."""
        return published_covariate(self.name)
