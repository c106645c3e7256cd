"""The interface between the engine and the apparatus that took the readings.

The engine fits, compares, tests and repairs models; it knows nothing of lamps, arms or patterns. Those are the
apparatus' part: a light sensor on an arm (`light_sensor`), or a user's simulator over a table (`simulator_rows`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Self

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence import Parts
from probewise.diagnosis.fit import Fit, Model, Null
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.words import UNKNOWN, Names
from probewise.effects import RARE_EFFECTS, Effect, is_out_of_vocabulary, name_of_first_copy
from probewise.recordings.plan import Plan, Recording
from probewise.sensor import Stage

MOST_ADVISED_READINGS = 102
"""Most readings that one advised measurement may have."""
SETTLED = 0.95
"""Probability from which a hypothesis, or the fewest that hold it, leave no question open."""
ENOUGH_NATS = 3.0
"""Expected log Bayes factor that tells two hypotheses apart, as odds of 20 to 1; readings for less are not advised.

A noise model, SSF order or proposal that is as far behind the best does not say what to refit next. This may miss
hypotheses: a refit sometimes gains 8 nats over its screening.
"""
NOTHING_NATS = 0.5  # expected log Bayes factor below which planned readings do not separate two hypotheses at all


@dataclass(frozen=True, eq=False)
class Candidate:
    """A possible next measurement: kind in a word or two, an instruction, its rows, and minutes with the break before.

    Kinds of a scan: "repeat", "reverse", "respeed", "rotate", "relight", "raise", "across" or, with another sheet,
    "lay".
    """

    kind: str
    description: str
    plan: Plan
    minutes: float


def rows_by_candidate(candidates: Sequence[Candidate]) -> list[IntArray]:
    """Return the row numbers of each candidate in the plan that concatenates all candidates, (n_rows,) each."""
    ends = np.cumsum([len(candidate.plan) for candidate in candidates])
    return [np.arange(end - len(candidate.plan), end) for end, candidate in zip(ends.tolist(), candidates, strict=True)]


@dataclass(frozen=True)
class PriorOdds:
    """Prior probabilities of sets of effects on the mean and, separately, on the noise.

    Mean: `clean_mean` for no effect, `unknown` for one out of vocabulary, and the rest divided among combinations by
    size (`by_size`), then equally; `unknown_beside` is the share of those with an additional unknown effect. The share
    `out_of_vocabulary` of the unknown is divided among the effects of `RARE_EFFECTS`; the rest has no formula.
    Noise: `white`, and the rest divided among noise models by size, then equally.
    `complexity_penalty` (nats) is the penalty of an effect per Gaussian of the SSF that it makes superfluous, since
    physics rarely imitates an SSF's shape; `unknown_complexity_penalty` is that of an unknown effect.
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

    @cached_property
    def _log_prior_per_combination(self) -> Callable[[int], float]:
        n_unlikely = len(self.unlikely) - self._n_unlikely_unnamed

        @cache
        def log_prior(n: int) -> float:
            if not n:
                return math.log(self.clean_mean)
            # The sum over combinations of the product of their effects' weights.
            combinations = sum(
                math.comb(self.n_named - n_unlikely, n - k) * math.comb(n_unlikely, k) * self.unlikely_weight**k
                for k in range(n + 1)
            )
            # A model of chosen effects may have more of them than a diagnosis would combine.
            return math.log(self.by_size[min(n, len(self.by_size)) - 1] / combinations)

        return log_prior

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
        believed: dict[Names, float] = {(): self.clean_mean, UNKNOWN: self.unknown}
        believed |= {(name,): each * (self.unlikely_weight if name in self.unlikely else 1.0) for name in names}
        total = sum(believed.values())
        return {(mean, noise): p / total for mean, p in believed.items()}

    def log_prior_on_noise(self, names: Names) -> float:
        """Return the log prior of a noise model by its uncertain effects `names`."""
        if not names:
            return math.log(self.white)
        size = min(len(names), len(self.noise_by_size))  # beside three, another sd is as probable as they are
        return math.log(self.noise_by_size[size - 1] / math.comb(self.n_noises, len(names)))


@dataclass(frozen=True)
class Words:
    """Words for sentences about an apparatus."""

    null: str  # the calibrated model
    find_signal: str  # how to obtain a signal
    settles_nothing: str  # no reading separates two aliased effects
    run: str = "scan"  # a group of rows
    next_plan: str = "next_plan.csv"  # file of the next readings,
    model: str = "sensor.json"  # and of the repaired model
    no_cure: str = "no scan of this arm helps"  # where no scan to add is proposed
    covariates: Mapping[str, str] | None = None  # time, row, level and previous row of a table; None: not a table
    own_names: frozenset[str] = frozenset()  # what a person has named, such as columns: no sentence capitalises them
    units: Mapping[str, str] = field(default_factory=dict)  # not at the end of a name; "{reading}" for the readings'
    nothing_held_out: str = "No scan could be held out: that takes two scans of eight readings or more."
    facts: tuple[tuple[str, str], ...] = ()  # term and text of what else a report lists
    tells_duration: bool = True  # how long readings take is known

    @property
    def unrepaired(self) -> str:
        """The model before a repair, as an adjective: a light sensor is calibrated, a simulator fitted."""
        return "calibrated" if self.covariates is None else "fitted"

    @property
    def before_in_words(self) -> str:
        """As what the model before a repair predicts, beside `Diagnosis.after_in_words`."""
        return f"as {self.unrepaired}"

    def as_sentence(self, text: str) -> str:
        """Return a text with a capital first letter, unless its first word is a person's own name."""
        first = (text.split() or [""])[0].rstrip(",.;:")
        own = "_" in first or first in self.own_names
        return text if own else f"{text[:1].upper()}{text[1:]}"

    def covariate_in_words(self, name: str) -> str:
        """Return the name of a covariate in words: of a table as `covariates` has it, else without underscores."""
        if self.covariates is None:
            return name.replace("_", " ")
        return self.covariates.get(name, name.replace("state:", "state ").replace("column:", "column "))


class Apparatus(ABC):
    """What the engine asks of an apparatus: its effects, priors, covariates, parts to hold out, next measurements."""

    @property
    @abstractmethod
    def words(self) -> Words:
        """Words for sentences about the apparatus."""

    @property
    def rows_are_in_order(self) -> bool:
        """Whether the order of rows is that of recording, as far as readings tell."""
        return True

    @property
    def controls(self) -> Sequence[str]:
        """Covariates that a person sets and has declared as such."""
        return ()

    @property
    def takes_one_measurement_at_a_time(self) -> bool:
        """Whether a plan holds one of the candidate measurements only, since its file would not keep two apart."""
        return False

    @abstractmethod
    def effects(self, recording: Recording, null: Null | None) -> Mapping[str, Effect]:
        """Return the vocabulary scaled to a recording, by name, without effects that could not be detectable there."""

    def proposed_formulas(self) -> Mapping[str, Effect]:
        """Return formulas for effects out of vocabulary, by name, which begins with `effects.PROPOSAL`."""
        return {}

    @abstractmethod
    def user_effect_names(self, effects: Mapping[str, Effect]) -> frozenset[str]:
        """Return the names of the user's own effects, which are always tried."""

    def refit_budget_share_spent(self) -> float:
        """Return the share of the budget of costly predictions that is spent: 1 or more if it is used up."""
        return 0.0

    def is_refit_budget_spent(self, share: float = 1.0) -> bool:
        """Return whether at least this share of the budget is spent; if so, record that the search was cut short."""
        return False

    def prior_odds(self, effects: Mapping[str, Effect]) -> PriorOdds:
        """Return the prior probabilities of combinations of these effects, of an unknown effect, and of none."""
        return PriorOdds.for_effects(effects)

    @abstractmethod
    def covariates_and_predicted_slope(
        self, found: Fit, recording: Recording
    ) -> tuple[Sequence[Covariate], FloatArray]:
        """Return the covariates of the usable readings that vary, and the slope of the prediction there, (n_usable,).

        The slope is along the motion, per mm, or, of a table, the change since the previous row. A table's covariates
        are time or row, predicted level, its change since the row before, columns, states, and the run.
        """

    def multiplied_covariates(self, covariates: Sequence[Covariate]) -> Sequence[Covariate]:
        """Choose the covariates of which a product of two may be an unknown effect: time and columns of a table.

        None by default: what an arm logs beside the readings is not known to act by products.
        """
        return ()

    def covariate_of_effect(
        self, effect: Effect, change: FloatArray, without: FloatArray, plan: Plan, known: Sequence[Covariate]
    ) -> Covariate | None:
        """Return the first of an effect's covariates that is `known`; None if none is, or `change` is 0 at every row.

        `change` are the effect's changes of the readings, `without` the predictions without it, which are the values of
        `level`, (n_points,) both; `plan` is that of the readings.
        """
        pooled = {c.name: c for c in known}
        name = next((name for name in effect.covariates if name in pooled), None)
        if name is None or not np.any(change):
            return None
        return replace(pooled[name], values=without[pooled[name].rows]) if name == "level" else pooled[name]

    @abstractmethod
    def held_out_parts(self, recording: Recording) -> Parts:
        """Return the part of each usable reading, (n_usable,), and the names of the parts, to hold out in turn."""

    def what_comes_next(self, recording: Recording) -> Parts | None:
        """Return the last fifth of each run as the one part to hold out; None, the default, without a time."""
        return None

    def coordinates_of_new_run(self, model: Model) -> IntArray:
        """Return the indices of a model's coordinates of which each run has a value of its own; none by default."""
        return np.zeros(0, dtype=np.int64)

    @abstractmethod
    def settings_of(self, plan: Plan) -> FloatArray:
        """Return what a person sets, and so may repeat, of each row of a plan, (n_points, n_settings): no readings."""

    @abstractmethod
    def candidate_measurements(
        self, plan: Plan, *, strides: Sequence[int] = (1,), level: FloatArray | None = None
    ) -> Sequence[Candidate]:
        """List the possible next measurements after a plan.

        With stride k, only every k-th reading is taken; `level` (n_points,) are the expected readings of the plan.
        """

    @abstractmethod
    def plan_of_alternatives(self, candidates: Sequence[Candidate], after: Plan) -> Plan:
        """Concatenate alternative candidates, each timed as if directly after a plan, to predict all at once."""

    @abstractmethod
    def plan_of_sequence(self, candidates: Sequence[Candidate], after: Plan) -> Plan:
        """Concatenate candidates into one plan, timed to be carried out in sequence after a plan."""
