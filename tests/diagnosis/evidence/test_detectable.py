"""How large what a fit holds is, and whether that can be seen."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import log_ndtr

from probewise.diagnosis.evidence import LEAST_VISIBLE, log_probability_effects_detectable
from probewise.diagnosis.fit import Fit, Model, fit
from probewise.diagnosis.noise_law import white_noise
from probewise.diagnosis.sensors import default_sensor
from probewise.effects import VOCABULARY, Extent
from probewise.recordings import Recording, paper_plan

PLAN = paper_plan()
EXTENT = Extent(10.0, 60.0, PLAN)
SD = 0.5


@pytest.mark.parametrize("amount", [0.001, 0.004, 0.012])
def test_a_size_is_what_a_refit_without_the_effect_leaves(amount):
    """Route one: the effect's change, the slopes of all else taken out; route two: the null refitted in full."""
    sensor = default_sensor(EXTENT, 1)
    effect = VOCABULARY["ambient_gradient"].for_extent(EXTENT)
    model = Model(sensor, (effect,), PLAN)
    z = np.concatenate([np.full(sensor.n_params, 0.2), model.z_of_last_effect(np.array([[amount, 0.0]]))[0]])
    predicted, slopes = model.predict_and_differentiate(z)
    found = Fit(model, z, predicted, np.zeros(len(PLAN)), slopes, SD, 0.0)
    law = white_noise(len(PLAN))
    null = Model(sensor, (), PLAN)
    left = fit(
        null, Recording(PLAN, predicted), z[: sensor.n_params], law.with_least_sigma(SD), tolerance=1e-6
    ).residuals
    expected = float(log_ndtr(np.linalg.norm(left) / SD - LEAST_VISIBLE))
    assert log_probability_effects_detectable(found, law, np.arange(len(PLAN))) == pytest.approx(
        expected, abs=0.1 + 0.02 * abs(expected)
    )


def test_a_fit_without_effects_is_as_it_is():
    model = Model(default_sensor(EXTENT, 1), (), PLAN)
    predicted, slopes = model.predict_and_differentiate(np.zeros(7))
    found = Fit(model, np.zeros(7), predicted, np.zeros(len(PLAN)), slopes, SD, 0.0)
    assert log_probability_effects_detectable(found, white_noise(len(PLAN)), np.arange(len(PLAN))) == 0.0
