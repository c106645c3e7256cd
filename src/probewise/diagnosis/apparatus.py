"""The interface between the engine and the apparatus that took the readings.

The engine fits, compares, tests and repairs models; it knows nothing of lamps, arms or patterns. Those are the
apparatus' part: a light sensor on an arm (`light_sensor`), or a user's simulator over a table (`simulator_rows`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence import Parts
from probewise.diagnosis.fit import Fit, Model, Null
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.prior_odds import PriorOdds
from probewise.effects import Effect
from probewise.recordings.plan import Plan, Recording

MOST_ADVISED_READINGS = 102
"""Most readings that one advised measurement may have."""
SETTLED = 0.95
"""Probability from which a hypothesis, or the fewest that hold it, leave no question open."""
ENOUGH_NATS = 3.0
"""Expected log Bayes factor that tells two hypotheses apart, as odds of 20 to 1; readings for less are not advised."""
NOTHING_NATS = 0.5
"""Expected log Bayes factor below which planned readings do not separate two hypotheses at all."""


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
