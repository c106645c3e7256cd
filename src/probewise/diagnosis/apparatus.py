"""The seam between the engine and whatever took the readings.

The engine fits, weighs, tests and repairs; it knows no lamp, arm or pattern. What does know them answers here: a
light sensor on an arm is one apparatus (`light_sensor`), a person's simulator over a plain table may be another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence.held_out import Parts
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.fitting.ssf_forms import SsfForms
from probewise.diagnosis.prior_odds import PriorOdds
from probewise.diagnosis.residuals.covariate import Covariate
from probewise.diagnosis.scheduling import Command
from probewise.effects import NamedEffect
from probewise.recordings.plan import Plan, Recording

__all__ = ["Apparatus", "Words"]


@dataclass(frozen=True)
class Words:
    """How sentences speak of an apparatus: what it is that is calibrated, and how to get a signal where there is none.

    `settles_nothing` says of two aliased effects that no reading tells them apart; `run` is what rows that belong
    together are called; `next_plan` is the file of the readings to take next, `model` that of the repaired model;
    `no_cure` says that no further rows would show an effect.
    """

    null: str
    find_signal: str
    settles_nothing: str
    run: str = "scan"
    next_plan: str = "next_plan.csv"
    model: str = "sensor.json"
    no_cure: str = "no scan of this arm helps"


class Apparatus(Protocol):
    """What the engine asks of whatever took the readings."""

    @property
    def words(self) -> Words:
        """How sentences speak of it."""
        ...

    def effects(self, recording: Recording, null: Null | None) -> Mapping[str, NamedEffect[Any]]:
        """Build the vocabulary, scaled to a recording: by name, without what could not show there."""
        ...

    def proposals(self) -> Mapping[str, NamedEffect[Any]]:
        """Propose formulas for what has no name, by names that begin with `effects.PROPOSAL`."""
        ...

    def own_effects(self, effects: Mapping[str, NamedEffect[Any]]) -> frozenset[str]:
        """Name the effects that a person added: named to be tried, however far they lead from the null."""
        ...

    def refits_are_over(self) -> bool:
        """Tell whether no further combination can be refitted, since predictions are dear and enough were made."""
        ...

    def prior_odds(self, effects: Mapping[str, NamedEffect[Any]]) -> PriorOdds:
        """Give the prior odds of these effects, of something unknown, and of their absence."""
        ...

    def null_forms(self, recording: Recording) -> SsfForms:
        """Give the forms of the null that are calibrated from the recording, where no null is given."""
        ...

    def covariates(self, found: Fit, recording: Recording) -> tuple[Sequence[Covariate], FloatArray]:
        """List what a residual may depend on, and the slope of the prediction along the motion, (n_usable,)."""
        ...

    def covariate_of(
        self,
        effect: NamedEffect[Any],
        change: FloatArray,
        without: FloatArray,
        plan: Plan,
        known: Sequence[Covariate],
    ) -> Covariate | None:
        """Choose the covariate that says where an effect is, from its change of the readings `without` it."""
        ...

    def fine_structure(self, found: Fit, usable: IntArray) -> FloatArray:
        """Differentiate by what no form of the null takes up and is no physics: (n_usable, n_columns)."""
        ...

    def held_out_parts(self, recording: Recording) -> Parts:
        """Divide usable readings into parts that are held out in turn."""
        ...

    def commands(
        self, plan: Plan, *, strides: Sequence[int] = (1,), level: FloatArray | None = None
    ) -> Sequence[Command]:
        """List what could be measured next, where `level` (n_points,) is what is expected of the plan's readings."""
        ...

    def one_after_another(self, commands: Sequence[Any], after: Plan) -> Plan:
        """Set commands behind each other, each as if it came next after a plan: to predict all of them at once."""
        ...

    def in_turn(self, commands: Sequence[Any], after: Plan) -> Plan:
        """Take commands one after the other, as they are to be carried out after a plan."""
        ...
