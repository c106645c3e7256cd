"""Prior odds of hypotheses: combinations of effects on the mean and on the noise."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Self, TypeAlias

from probewise.effects import RARE_EFFECTS, Effect, is_out_of_vocabulary, name_of_first_copy
from probewise.sensor import Stage

Names: TypeAlias = tuple[str, ...]


@dataclass(frozen=True)
class PriorOdds:
    """Prior probabilities of sets of effects on the mean and, separately, on the noise.

    Mean: `clean_mean` for no effect, `unknown` for one out of vocabulary, and the rest divided among combinations by
    size (`by_size`), then equally; `unknown_beside` is the share of those with an additional unknown effect. The share
    `out_of_vocabulary` of the unknown is divided among the effects of `RARE_EFFECTS`; the rest has no formula.
    Noise: `white`, and the rest divided among noise models by size, then equally.
    `complexity_penalty` (nats) is the penalty of an effect per Gaussian of the SSF that it makes superfluous, since
    physics rarely imitates an SSF's shape; `unknown_complexity_penalty` is that of an unknown effect.
    `named_needs_half`: effects on the mean are `named` only with half the probability, whatever noise is beside, or
    if nearly all hypotheses share them, whatever is open beside them. Otherwise the leading combination is named.
    `unlikely` are effects in places where hardly anything can be missing: each has `unlikely_weight` times the prior
    probability of another one.
    `twofold` are the effects that may occur twice; `twice` is the probability that one does, given that it occurs;
    None: that of any second effect.
    """

    n_named: int = 24
    n_unnamed: int = len(RARE_EFFECTS)
    n_noises: int = 6
    clean_mean: float = 0.60
    unknown: float = 0.06
    out_of_vocabulary: float = 0.5
    by_size: tuple[float, ...] = (0.33, 0.0095, 0.0005)
    unknown_beside: float = 0.01
    white: float = 0.94
    noise_by_size: tuple[float, ...] = (0.057, 0.0028, 0.0002)
    complexity_penalty: float = 8.0
    unknown_complexity_penalty: float = 24.0
    named_needs_half: bool = False
    twice: float | None = None
    twofold: frozenset[str] = frozenset()
    unlikely: frozenset[str] = frozenset()
    unlikely_weight: float = 1.0

    @classmethod
    def for_effects(cls, effects: Mapping[str, Effect]) -> Self:
        """Divide the default probabilities among these effects."""
        on_noise = {name for name, effect in effects.items() if effect.stage is Stage.NOISE}
        unnamed = sum(is_out_of_vocabulary(name) for name in effects)
        twofold = frozenset(first for name in effects if (first := name_of_first_copy(name)) is not None)
        n_named = len(effects) - len(on_noise) - unnamed - len(twofold)
        return cls(n_named, unnamed, len(on_noise), twofold=twofold)

    def log_prior_on_mean(self, names: Names) -> float:
        """Return the log prior probability of a combination of effects on the mean."""
        named = [name for name in names if not is_out_of_vocabulary(name)]
        if self.twice is None:
            log_p = self._log_prior_per_combination(len(named))
        else:
            once = self.twofold.intersection(named)
            n_again = sum(name_of_first_copy(name) is not None for name in named)
            log_p = self._log_prior_per_combination(len(named) - n_again)
            log_p += n_again * math.log(self.twice) + (len(once) - n_again) * math.log1p(-self.twice)
        for k in range(len(names) - len(named)):
            share = self.unknown / self.clean_mean if not named and k == 0 else self.unknown_beside
            n_as_likely = self.n_unnamed - (1 - self.unlikely_weight) * self._n_unlikely_unnamed
            log_p += math.log(share * self.out_of_vocabulary / (n_as_likely - k))
        return log_p + len(self.unlikely.intersection(names)) * math.log(self.unlikely_weight)

    def _log_prior_per_combination(self, n: int) -> float:
        if not n:
            return math.log(self.clean_mean)
        # A model of chosen effects may have more of them than a diagnosis would combine.
        n_unlikely = len(self.unlikely) - self._n_unlikely_unnamed
        # The sum over combinations of the product of their effects' weights.
        combinations = sum(
            math.comb(self.n_named - n_unlikely, n - k) * math.comb(n_unlikely, k) * self.unlikely_weight**k
            for k in range(n + 1)
        )
        return math.log(self.by_size[min(n, len(self.by_size)) - 1] / combinations)

    @cached_property
    def _n_unlikely_unnamed(self) -> int:
        return sum(map(is_out_of_vocabulary, self.unlikely))

    def log_prior_with_unknown(self, names: Names) -> float:
        """Return the log prior of an unknown effect without a formula, together with effects on the mean."""
        if names:
            return self.log_prior_on_mean(names) + math.log(self.unknown_beside)
        return math.log(self.unknown * (1 - self.out_of_vocabulary if self.n_unnamed else 1.0))

    def single_effect_priors(self, names: Iterable[str], noise: Names) -> dict[tuple[Names, Names], float]:
        """Return the probabilities of clean, of unknown and of each effect of `names` alone, beside certain noise."""
        each = math.exp(self._log_prior_per_combination(1)) if self.n_named else self.by_size[0]
        believed: dict[Names, float] = {(): self.clean_mean, ("unknown",): self.unknown}
        believed |= {(name,): each * (self.unlikely_weight if name in self.unlikely else 1.0) for name in names}
        total = sum(believed.values())
        return {(mean, noise): p / total for mean, p in believed.items()}

    def log_prior_on_noise(self, names: Names) -> float:
        """Return the log prior of a noise model by its uncertain effects `names`."""
        if not names:
            return math.log(self.white)
        size = min(len(names), len(self.noise_by_size))  # beside three, another sd is as probable as they are
        return math.log(self.noise_by_size[size - 1] / math.comb(self.n_noises, len(names)))
