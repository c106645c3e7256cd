"""One robot's search, with the true shape that only the simulated world knows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from probewise._arrays import FloatArray
from probewise.experiment import Exploration


@dataclass(frozen=True, eq=False)
class RobotSearch:
    """One robot's search: its sensor model's name, its run, the true shape, and the readings over black and white.

    `truth` holds the shape's parameters by name, `truth_mm` its outline, (n_vertices, 2); `levels` is (black, white).
    """

    model: str
    run: Exploration
    truth: Mapping[str, float]
    truth_mm: FloatArray
    levels: tuple[float, float]

    @property
    def largest_error_mm(self) -> float:
        """Largest absolute error, estimate against truth, of the parameters in mm (places, lengths) at the end."""
        last = self.run.last
        return max(
            abs(float(mean) - self.truth[name])
            for name, mean in zip(last.names, last.mean, strict=True)
            if name in self.truth and name.endswith("_mm")
        )

    @property
    def readings_until_first_white(self) -> int:
        """Number, from 1, of the first reading closer to white than to black; that of the last one if none is."""
        middle = sum(self.levels) / 2
        seen = [r.value > middle for r in self.run.readings]
        return seen.index(True) + 1 if any(seen) else len(seen)

    def step_number_after(self, n: int) -> int:
        """Return the number of the step after `n` readings, or of the last step if the run ended earlier."""
        return min(n, len(self.run.steps))
