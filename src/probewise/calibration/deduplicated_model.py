"""Predict repeated rows of a plan only once, as in scans out and back."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.errors import ParameterError
from probewise.recordings import Plan
from probewise.sensor import COMMANDED, SensorModel


class DeduplicatedModel:
    """Wrapper of a model that predicts repeated rows of one plan only once.

    The model's predictions may depend only on a row's position, orientation, pattern, and commanded height and LED, as
    those of a chain without effects do. The wrapper predicts only the plan that it was made for.
    """

    def __init__(self, model: SensorModel, plan: Plan) -> None:
        commanded = [plan.covariates[name] for name in COMMANDED if name in plan.covariates]
        pattern = plan.pattern.astype(np.float64)
        keys = np.stack([plan.x_mm, plan.y_mm, plan.orientation_rad, pattern, *commanded], axis=-1)
        _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        self._model = model
        self._plan = plan
        repeats = len(first) < len(plan)
        self._rows = inverse.reshape(-1) if repeats else None
        self._distinct = plan.take(first) if repeats else plan

    @property
    def names(self) -> tuple[str, ...]:
        """The model's parameter names."""
        return self._model.names

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings, theta (n_samples, n_params) -> (n_samples, n_points).

        Raises
        ------
        ParameterError
            If `plan` is another plan.
        """
        if plan is not self._plan:
            raise ParameterError("plan", plan, "the plan that this model was made for; make another for this one")
        distinct = self._model.predict(theta, self._distinct)
        return distinct if self._rows is None else np.take(distinct, self._rows, axis=1)
