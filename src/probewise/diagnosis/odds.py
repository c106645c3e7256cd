"""What is believed of hypotheses before any reading."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["PriorOdds"]

Names = tuple[str, ...]


@dataclass(frozen=True)
class PriorOdds:
    """Prior odds of what may be missing from the mean, and of what may be wrong with the noise.

    Of the mean: `clean_mean`, `unknown`, and the rest shared out over combinations, by size, then evenly;
    `unknown_beside` is the share of those in which something unknown is at work besides. Of the noise:
    `white`, the rest over noise models, by size, then evenly. `coincidence` (nats) is what speaks against
    an effect that makes a Gaussian of the SSF superfluous, for each one: that physics looks like an SSF's
    shape takes more than an even chance to believe.
    """

    clean_mean: float = 0.60
    unknown: float = 0.06
    by_size: tuple[float, ...] = (0.33, 0.0095, 0.0005)
    unknown_beside: float = 0.01
    white: float = 0.94
    noise_by_size: tuple[float, ...] = (0.057, 0.003)
    coincidence: float = 8.0

    def log_mean(self, names: Names, n_effects: int) -> float:
        """Log prior of a combination of effects on the mean."""
        if not names:
            return math.log(self.clean_mean)
        return math.log(self.by_size[len(names) - 1] / math.comb(n_effects, len(names)))

    def log_unknown(self, names: Names, n_effects: int) -> float:
        """Log prior of something unknown, beside a combination of effects on the mean."""
        return self.log_mean(names, n_effects) + math.log(self.unknown_beside) if names else math.log(self.unknown)

    def log_noise(self, names: Names, n_effects: int) -> float:
        """Log prior of a noise model, made of some of `n_effects` effects; `names` are those that may be absent."""
        if not names:
            return math.log(self.white)
        return math.log(self.noise_by_size[len(names) - 1] / math.comb(n_effects, len(names)))
