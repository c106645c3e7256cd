"""The paper's apparatus: vocabulary, covariates, held-out parts, next scans, and words."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.apparatus import Words
from probewise.diagnosis.fitting.fit import Fit, Model
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.fitting.ssf_forms import SsfForms
from probewise.diagnosis.light_sensor.candidate_scans import candidate_scans, rows_repeatable_without_hands
from probewise.diagnosis.light_sensor.covariates import covariate_of_effect, slope_along_motion, varying_covariates
from probewise.diagnosis.light_sensor.fine_structure import fine_structure_slopes
from probewise.diagnosis.light_sensor.held_out_parts import held_out_parts
from probewise.diagnosis.light_sensor.scheduling import Scan, plan_of_alternatives, plan_of_sequence
from probewise.diagnosis.light_sensor.target_swaps import target_swaps
from probewise.diagnosis.prior_odds import PriorOdds
from probewise.diagnosis.residuals.covariate import Covariate
from probewise.effects import EFFECTS, NUISANCES, RARE_EFFECTS, VOCABULARY, Extent, NamedEffect, orientation_deg
from probewise.recordings.plan import Plan, Recording


@dataclass(frozen=True)
class LightSensorApparatus:
    """A light sensor that an arm moves over patterns; `vocabulary` holds its possible effects, by name.

    `hands`: a person can exchange or turn sheets; otherwise the next scans are over the pattern of the last reading.
    """

    vocabulary: Mapping[str, type[NamedEffect[Any]]] = field(default_factory=lambda: dict(VOCABULARY))
    hands: bool = True
    words: ClassVar[Words] = Words(
        null="the sensor",
        find_signal="scan across an edge",
        settles_nothing="no reading that this apparatus can take tells them apart",
    )

    @property
    def rows_are_in_order(self) -> bool:
        """True: an arm takes readings in order."""
        return True

    def effects(self, recording: Recording, null: Null | None) -> dict[str, NamedEffect[Any]]:
        """Scale effects to a recording, by name: the vocabulary, effects out of it with a formula, and drifting noise.

        Left out are effects that cannot act there or on the given null. Without a given null the SSF is free and
        absorbs effects on the SSF, so these are left out.
        """
        extent, plan = Extent.of(recording), recording.plan
        kinds = {**self.vocabulary, **RARE_EFFECTS, **NUISANCES}
        able = {name: effect for name, kind in kinds.items() if (effect := kind.for_extent(extent)) is not None}
        return {
            name: effect
            for name, effect in able.items()
            if (null.admits(effect) if null is not None else not effect.is_absorbed_by_ssf(plan))
        }

    def proposed_formulas(self) -> dict[str, NamedEffect[Any]]:
        """Return an empty mapping: no formulas are proposed for a light sensor."""
        return {}

    def user_effect_names(self, effects: Mapping[str, NamedEffect[Any]]) -> frozenset[str]:
        """Return the names of effects defined outside this library."""
        return frozenset(effects.keys() - EFFECTS)

    def refit_budget_share_spent(self) -> float:
        """Return the spent share of the budget of refits: 0, since predictions are cheap here."""
        return 0.0

    def is_refit_budget_spent(self, share: float = 1.0) -> bool:
        """Return False: predictions are cheap here."""
        return False

    def null_forms(self, recording: Recording) -> SsfForms:
        """Return the forms that the SSF may take when it is calibrated from the recording."""
        return SsfForms(Extent.of(recording))

    def covariates_and_predicted_slope(self, found: Fit, recording: Recording) -> tuple[list[Covariate], FloatArray]:
        """Return the covariates that vary, and the predicted slope along the motion, per mm, (n_usable,)."""
        usable, model, z = np.flatnonzero(recording.usable), found.model, found.z[None, :]
        slope = slope_along_motion(lambda moved: model.predict(z, moved)[0], model.plan)[usable]
        return varying_covariates(recording.plan, usable, found.predicted, slope), slope

    def multiplied_covariates(self, covariates: Sequence[Covariate]) -> tuple[Covariate, ...]:
        """Return no covariates: what an arm logs beside the readings is not known to act by products."""
        return ()

    controls: ClassVar[Sequence[str]] = ()  # an arm's places are its covariates
    takes_one_measurement_at_a_time = False  # a plan names its scans
    prior_odds = staticmethod(PriorOdds.for_effects)
    covariate_of_effect = staticmethod(covariate_of_effect)
    held_out_parts = staticmethod(held_out_parts)
    plan_of_alternatives = staticmethod(plan_of_alternatives)
    plan_of_sequence = staticmethod(plan_of_sequence)

    def fine_structure_slopes(self, found: Fit, usable: IntArray) -> FloatArray:
        """Return the slopes of the readings by fine structure of the SSF, (n_usable, n_columns)."""
        return fine_structure_slopes(found.model, found.z, usable)

    def coordinates_of_new_run(self, model: Model) -> IntArray:
        """Return no indices: the sensor is the same in every scan."""
        return np.zeros(0, dtype=np.int64)

    def settings_of(self, plan: Plan) -> FloatArray:
        """Return place, orientation and a number for the pattern of each row, (n_points, 4)."""
        number = np.array([zlib.crc32(name.encode()) for name in plan.pattern_names])[plan.pattern]
        return np.stack([plan.x_mm, plan.y_mm, orientation_deg(plan), number], axis=1)

    def candidate_measurements(
        self, plan: Plan, *, strides: Sequence[int] = (1,), level: FloatArray | None = None
    ) -> list[Scan]:
        """List the scans that the arm can take, and with `hands` those over an exchanged or turned target."""
        if self.hands:
            return [*candidate_scans(plan, strides=strides, level=level), *target_swaps(plan)]
        rows = rows_repeatable_without_hands(plan)
        return candidate_scans(plan.take(rows), strides=strides, level=None if level is None else level[rows])
