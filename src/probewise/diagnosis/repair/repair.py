"""The calibrated and the repaired model: posterior samples, predictions, and the gain."""

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


@dataclass(frozen=True, eq=False)
class Predicted:
    """Predictions of every row and residuals, (n_points,); residuals are NaN without a usable reading."""

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
        Gain of the second.
    before, after
        Predictions of each, for all rows.
    by_rows
        Whether an unknown effect is corrected by rows; `improvement` includes that, `model` does not.
    """

    null: ModelSamples
    model: ModelSamples
    improvement: Improvement
    before: Predicted
    after: Predicted
    by_rows: bool = False

    @property
    def changes_predictions(self) -> bool:
        """Whether the predictions of the repaired and the calibrated model differ."""
        return not np.array_equal(self.before.residuals, self.after.residuals, equal_nan=True)

    @property
    def left_open(self) -> dict[tuple[str, ...], float]:
        """Shares of the model's samples by the effects that they contain and not all do, largest first."""
        absent = self.model.absent
        if not absent:
            return {}
        held = Counter(zip(*(np.where(marks, "", name).tolist() for name, marks in absent.items()), strict=True))
        return {tuple(filter(None, names)): n / held.total() for names, n in held.most_common()}

    def carried_beside(self, stated: set[str]) -> tuple[tuple[str, float, str], ...]:
        """List effects that the model contains but the verdict does not state: name, share of the samples, sentence."""
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
    """Predict every row with both models, including rows not used in the diagnosis.

    Parameters
    ----------
    prepared, test, best, drawn
        What was found.
    change
        The correction of the usable readings by rows, (n_usable,); unused readings have none.
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
        before = Predicted(_best_prediction(null), prepared.spread(null.residuals))
        after = Predicted(_best_prediction(fit) + by_rows, prepared.spread(fit.residuals - change))
    return Repair(drawn.null, drawn.model, best.improvement, before, after, by_rows=bool(np.any(change)))


def _best_prediction(found: Fit) -> FloatArray:
    return np.asarray(found.model.predict(found.z[None, :])[0])
