"""The calibrated and the repaired model: posterior samples, predictions and residuals, and the gain."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from probewise._arrays import FloatArray, read_only_floats
from probewise.diagnosis.effect_words import effects_in_words, hypothesis_in_words, join_lists, join_names
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.noise.memory import walk_given_readings
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.repair.best_repair import BestRepair
from probewise.diagnosis.repair.ensemble import NullBestAndRepairedSamples
from probewise.diagnosis.repair.improvement import Improvement
from probewise.diagnosis.repair.samples import ModelSamples
from probewise.effects import NamedEffect, is_out_of_vocabulary
from probewise.effects.effect import sentence_from_samples


@dataclass(frozen=True, eq=False)
class PredictionAndResiduals:
    """A model's predicted readings of every row, and residuals, NaN without a usable reading: (n_points,) each.

    `walk`, (n_points,), is the random walk of the offset that all readings show about the prediction, by default 0.
    Residuals are what neither explains.
    """

    readings: FloatArray
    residuals: FloatArray
    walk: FloatArray = field(default_factory=lambda: np.zeros(1))

    def __post_init__(self) -> None:
        object.__setattr__(self, "readings", read_only_floats(self.readings))
        object.__setattr__(self, "residuals", read_only_floats(self.residuals))
        object.__setattr__(self, "walk", read_only_floats(np.broadcast_to(self.walk, self.readings.shape)))

    @property
    def has_walk(self) -> bool:
        """Whether the noise contains a random walk."""
        return bool(np.any(self.walk))

    @property
    def readings_with_walk(self) -> FloatArray:
        """Predicted readings with the walk, (n_points,): what residuals count from."""
        return np.asarray(self.readings + self.walk)


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
        Predictions and residuals of the calibrated and of the repaired model, for all rows, under the same noise.
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
    def after_in_words(self) -> str:
        """What the later one of the two predictions is: "repaired", or, row by row, "corrected in these readings"."""
        return "corrected in these readings" if self.by_rows else "repaired"

    def not_in_model(self, model: str) -> str:
        """Say that the file `model` lacks the correction by rows, or what share of its samples has a formula."""
        named = [name for name in self.model.effects if is_out_of_vocabulary(name)]
        marks = [self.model.absent.get(name, np.zeros(1, dtype=np.bool_)) for name in named]
        share = 1.0 - float(np.mean(np.logical_and.reduce(np.broadcast_arrays(*marks)))) if marks else 0.0
        if share:
            return f"of the samples in {model}, {100 * share:.0f} % contain a formula for it instead"
        return f"{model} does not contain it"

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

    @property
    def effects_in_all_samples(self) -> tuple[str, ...]:
        """Effects that all samples of the repaired model contain."""
        return tuple(name for name in self.model.effects if name not in self.model.absent)

    @property
    def shares_in_words(self) -> str:
        """Which effects all samples of the repaired model contain, and which only a share of them, in words."""
        everywhere, nothing = self.effects_in_all_samples, "no effect"
        opening = ""
        if everywhere:
            opening, nothing = f"{join_names(effects_in_words(everywhere))}; beside that ", "nothing more"
        held = (
            f"{hypothesis_in_words(names, nothing=nothing)} ({100 * share:.0f} %)"
            for names, share in self.combination_shares.items()
        )
        return opening + join_lists([*held])

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


def repair_of(prepared: Prepared, best: BestRepair, drawn: NullBestAndRepairedSamples, change: FloatArray) -> Repair:
    """Build the repair: samples, gain, and predictions of every row, including rows not used in the diagnosis.

    Parameters
    ----------
    prepared, best, drawn
        Input of the search; the best fit; samples of the models.
    change
        Correction of the predictions of the readings that are used, (n_usable,), 0 if there is none.
    """
    everything, law = prepared.everything, best.problem.law
    used = prepared.usable_rows_of_everything
    by_rows = np.zeros(len(everything))
    by_rows[used] = change
    readings = np.where(everything.usable, everything.readings, np.nan)

    def shown(found: Fit, added: FloatArray) -> PredictionAndResiduals:
        model = replace(found.model, plan=everything.plan) if prepared.is_thinned else found.model
        predicted = np.asarray(model.predict(found.z[None, :])[0] + added)
        left = found.residuals - added[used]
        # Between readings, the expected walk is straight; it begins at 0 before the first row.
        known = walk_given_readings(law, left)
        walk = np.interp(np.arange(len(everything)), np.append(-1, used), np.append(0.0, known))
        if prepared.is_thinned:
            return PredictionAndResiduals(predicted, readings - predicted - walk, walk)
        return PredictionAndResiduals(predicted, prepared.expand_usable_to_all_rows(left - walk[used]), walk)

    before, after = shown(best.calibrated, np.zeros(len(everything))), shown(best.repaired, by_rows)
    return Repair(drawn.null, drawn.repaired, best.improvement, before, after, by_rows=bool(np.any(change)))
