"""The repaired model beside the calibrated one: posterior samples, predictions, and what is gained."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from probewise._arrays import FloatArray, frozen
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.judgement.global_test import GlobalTest
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.repair.best import Best
from probewise.diagnosis.repair.ensemble import Drawn
from probewise.diagnosis.repair.improvement import Improvement
from probewise.diagnosis.repair.samples import ModelSamples
from probewise.effects import NamedEffect

__all__ = ["Predicted", "Repair", "repair_of"]


@dataclass(frozen=True, eq=False)
class Predicted:
    """What a model predicts of every row, (n_points,), and what is left; NaN where there is no usable reading."""

    readings: FloatArray
    residuals: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "readings", frozen(self.readings))
        object.__setattr__(self, "residuals", frozen(self.residuals))


@dataclass(frozen=True, eq=False)
class Repair:
    """The calibrated and the repaired model, as posterior samples.

    Parameters
    ----------
    null, model
        The two models.
    improvement
        What the second gains.
    before, after
        What each predicts, of all rows.
    by_rows
        Whether what has no name is repaired by rows: `improvement` counts that, `model` does not carry it.
    """

    null: ModelSamples
    model: ModelSamples
    improvement: Improvement
    before: Predicted
    after: Predicted
    by_rows: bool = False

    @property
    def changes_predictions(self) -> bool:
        """Whether the repaired model predicts otherwise than the calibrated one."""
        return not np.array_equal(self.before.residuals, self.after.residuals, equal_nan=True)

    @property
    def left_open(self) -> dict[tuple[str, ...], float]:
        """Share of the model's samples by which of the effects they hold that not all hold, largest first."""
        absent = self.model.absent
        if not absent:
            return {}
        held = Counter(zip(*(np.where(marks, "", name).tolist() for name, marks in absent.items()), strict=True))
        return {tuple(filter(None, names)): n / held.total() for names, n in held.most_common()}

    def carried_beside(self, stated: set[str]) -> tuple[tuple[str, float, str], ...]:
        """List what the model carries and is not stated: name, share of the samples, sentence."""
        out = []
        for effect in cast(Sequence[NamedEffect[Any]], self.model.chain.effects):
            values = self.model.columns(effect.name)
            marks = self.model.absent.get(effect.name)
            held = values if marks is None else values[~marks]
            if effect.name not in stated and len(held):
                sentence = effect.sentence(held.mean(axis=0), held.std(axis=0))
                out.append((effect.name, len(held) / len(values), sentence))
        return tuple(out)


def repair_of(prepared: Prepared, test: GlobalTest, best: Best, drawn: Drawn, change: FloatArray) -> Repair:
    """Predict every row by both models, those that were not compared too.

    Parameters
    ----------
    prepared, test, best, drawn
        What was found.
    change
        The correction of the usable readings by rows, (n_usable,); readings that were not compared have none.
    """
    null, fit = test.null.found, best.fit.found
    everything = prepared.everything
    if prepared.thinned:
        readings = np.where(everything.usable, everything.readings, np.nan)
        plans = (replace(found.model, plan=everything.plan).predict(found.z[None, :])[0] for found in (null, fit))
        before, after = (Predicted(predicted, readings - predicted) for predicted in plans)
    else:
        by_rows = np.zeros(len(prepared.recording))
        by_rows[prepared.usable] = change
        before = Predicted(_predicted(null), prepared.spread(null.residuals))
        after = Predicted(_predicted(fit) + by_rows, prepared.spread(fit.residuals - change))
    return Repair(drawn.null, drawn.model, best.improvement, before, after, by_rows=bool(np.any(change)))


def _predicted(found: Fit) -> FloatArray:
    return np.asarray(found.model.predict(found.z[None, :])[0])
