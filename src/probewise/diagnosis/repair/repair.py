"""The calibrated and the repaired model: posterior samples, predictions and residuals, and the gain."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from probewise._arrays import FloatArray, read_only_floats
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.judgement.global_test import GlobalTest
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.repair.best_repair import BestRepair
from probewise.diagnosis.repair.ensemble import NullBestAndRepairedSamples
from probewise.diagnosis.repair.improvement import Improvement
from probewise.diagnosis.repair.samples import ModelSamples
from probewise.effects import NamedEffect
from probewise.effects.vocabulary import sentence_from_samples


@dataclass(frozen=True, eq=False)
class PredictionAndResiduals:
    """A model's predicted readings of every row, and residuals, NaN without a usable reading: (n_points,) each."""

    readings: FloatArray
    residuals: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "readings", read_only_floats(self.readings))
        object.__setattr__(self, "residuals", read_only_floats(self.residuals))


@dataclass(frozen=True, eq=False)
class Repair:
    """The calibrated and the repaired model, as posterior samples.

    Parameters
    ----------
    null, model
        Posterior samples of the calibrated and of the repaired model.
    improvement
        Gain of the repaired model.
    before, after
        Predictions and residuals of the calibrated and of the repaired model, for all rows.
    by_rows
        Whether an unknown effect is corrected row by row; `improvement` and `after` include that, `model` does not.
    """

    null: ModelSamples
    model: ModelSamples
    improvement: Improvement
    before: PredictionAndResiduals
    after: PredictionAndResiduals
    by_rows: bool = False

    @property
    def changes_predictions(self) -> bool:
        """Whether the residuals of the repaired and of the calibrated model differ."""
        return not np.array_equal(self.before.residuals, self.after.residuals, equal_nan=True)

    @property
    def combination_shares(self) -> dict[tuple[str, ...], float]:
        """Share of the repaired model's samples with each combination of the effects that not all samples contain.

        Largest share first; {} if all samples contain the same effects.
        """
        absent = self.model.absent
        if not absent:
            return {}
        held = Counter(zip(*(np.where(marks, "", name).tolist() for name, marks in absent.items()), strict=True))
        return {tuple(filter(None, names)): n / held.total() for names, n in held.most_common()}

    left_open = combination_shares
    """The old name of `combination_shares`."""

    def unstated_effects(self, stated: set[str]) -> tuple[tuple[str, float, str], ...]:
        """List the repaired model's effects that are not `stated`: name, share of the samples with it, sentence."""
        out = []
        for effect in cast(Sequence[NamedEffect[Any]], self.model.chain.effects):
            values = self.model.effect_samples(effect.name)
            marks = self.model.absent.get(effect.name)
            held = values if marks is None else values[~marks]
            if effect.name not in stated and len(held):
                out.append((effect.name, len(held) / len(values), sentence_from_samples(effect, held)))
        return tuple(out)

    carried_beside = unstated_effects
    """The old name of `unstated_effects`."""


def repair_of(
    prepared: Prepared, test: GlobalTest, best: BestRepair, drawn: NullBestAndRepairedSamples, change: FloatArray
) -> Repair:
    """Build the repair: samples, gain, and predictions of every row, including rows not used in the diagnosis.

    Parameters
    ----------
    prepared, test, best, drawn
        Input of the search; global test of the null; the best fit; samples of the models.
    change
        Correction of the predictions of the readings that are used, (n_usable,), 0 if there is none.
    """
    null, fit = test.null.found, best.fit.found
    everything = prepared.everything
    by_rows = np.zeros(len(everything))
    by_rows[prepared.usable_rows_of_everything] = change
    if prepared.is_thinned:
        readings = np.where(everything.usable, everything.readings, np.nan)
        plain, repaired = (
            replace(found.model, plan=everything.plan).predict(found.z[None, :])[0] for found in (null, fit)
        )
        before = PredictionAndResiduals(plain, readings - plain)
        after = PredictionAndResiduals(repaired + by_rows, readings - repaired - by_rows)
    else:
        before = PredictionAndResiduals(
            _predictions_of_all_rows(null), prepared.expand_usable_to_all_rows(null.residuals)
        )
        after = PredictionAndResiduals(
            _predictions_of_all_rows(fit) + by_rows, prepared.expand_usable_to_all_rows(fit.residuals - change)
        )
    return Repair(drawn.null, drawn.repaired, best.improvement, before, after, by_rows=bool(np.any(change)))


def _predictions_of_all_rows(found: Fit) -> FloatArray:
    return np.asarray(found.model.predict(found.z[None, :])[0])
