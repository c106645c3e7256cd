"""A formula with a bounded domain: without one effect of a fit, the values of the others predict no number."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtri

from probewise.diagnosis import diagnose_system
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import log_probability_effects_detectable
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.noise_law import white_noise
from probewise.systems import Simulator, table_for

N, SD = 50, 0.02
X = np.sort(np.random.default_rng(2).uniform(-0.4, 1.45, N))
Y = 2 * np.sqrt(1 - (X - 0.5) ** 2) + SD * np.random.default_rng(3).normal(size=N)
TABLE = {"x": X, "y": Y}
DOME = Simulator(  # a dome whose position was recorded 0.5 too large: beyond the radius there is no height
    "y",
    "V",
    {"height": (0, 5), "radius": ("log", 0.5, 5)},
    simulate=lambda p, u: p["height"] * np.sqrt(1 - (u["x"] / p["radius"]) ** 2),
    vectorized=True,
)


@pytest.fixture(scope="module")
def diagnosis():
    return diagnose_system(DOME, TABLE, rng=np.random.default_rng(1))


@pytest.mark.slow
def test_every_probability_and_size_is_a_number(diagnosis):
    assert sum(h.probability for h in diagnosis.judged.hypotheses) == pytest.approx(1.0)
    assert diagnosis.effects
    assert all(math.isfinite(effect.size_lambda) for effect in diagnosis.effects)
    assert all(np.isfinite([place.start, place.end]).all() for place in diagnosis.where if place.start is not None)


@pytest.mark.slow
def test_a_size_is_that_of_a_refit_from_values_that_predict_something(diagnosis):
    """Not that of readings a thousand noise sds off, which stands for an impossible one."""
    assert max(effect.size_lambda for effect in diagnosis.effects) < 200


@pytest.fixture(scope="module")
def shifted():
    """The fit with the true shift of x, and its usable rows; without it the outer readings are impossible."""
    prepared = prepare_system(DOME, table_for(DOME, TABLE))
    model = Model(prepared.null, (prepared.effects["input_offset:x"],), prepared.recording.plan)
    height_and_radius = ndtri([0.4, math.log(2.0) / math.log(10.0)])
    start = np.append(height_and_radius, model.z_of_last_effect(np.array([[-0.5]]))[0])
    return fit(model, prepared.recording, start, white_noise(N)), prepared.usable_rows


def test_rows_impossible_without_an_effect_change_most(shifted):
    found, usable = shifted
    assert found.sd < 2 * SD
    change = found.change_by_effect("input_offset:x", usable)
    outside = X > 1.01
    assert np.isfinite(change).all()
    assert (change[outside] == change.max()).all()
    assert change.max() >= max(1000 * found.sd, np.abs(change[~outside]).max())


def test_a_change_that_grows_without_end_stays_within_what_can_be_squared(shifted):
    found, usable = shifted
    beyond = replace(found, predicted=np.where(X > 1, 1.0, 0.0), model=_Diverging(found.model))
    assert np.abs(beyond.change_by_effect("input_offset:x", usable)).max() == 1e6 * (1 + found.sd)


class _Diverging:
    """A model that without the effect predicts readings that grow until they are no numbers."""

    def __init__(self, model):
        self.model = model

    def model_and_mask_without(self, name):
        return self, self.model.model_and_mask_without(name)[1]

    def predict(self, z):
        return np.where(X > 1.3, np.inf, np.where(X > 1, 1e231, 0.0))[None, :]


def test_an_effect_without_which_readings_are_impossible_is_detectable(shifted):
    found, usable = shifted
    assert log_probability_effects_detectable(found, white_noise(N), usable) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("noise", [{}, {"share": 0.1, "times": 5.0}, {"flat": 0.05, "sigma": SD}])
def test_a_fit_whose_steps_leave_the_domain_warns_of_nothing(noise):
    """Of any noise, normal, heavy-tailed or rounded: a step that is not taken is no news to a person."""
    prepared = prepare_system(DOME, table_for(DOME, TABLE))
    model = Model(prepared.null, (prepared.effects["input_offset:x"],), prepared.recording.plan)
    height, offset = ndtri(0.2), model.z_of_last_effect(np.array([[-0.5]]))[0]
    for radius in (0.35, 0.5, 0.9):  # shares of the prior; the first is close to the domain's edge
        start = np.append([height, ndtri(radius)], offset)
        assert np.isfinite(fit(model, prepared.recording, start, replace(white_noise(N), **noise)).objective)


def test_a_late_reading_of_an_impossible_one_is_impossible_without_a_warning():
    """Between two infinite readings there is none: pytest makes an error of numpy's warning."""
    t = np.arange(30.0)
    simulator = Simulator(
        "y",
        "V",
        {"a": (0, 2)},
        simulate=lambda p, u: np.where(p["a"] > 1, np.inf, p["a"] * u["t"]),
        time="t",
        vectorized=True,
    )
    prepared = prepare_system(simulator, table_for(simulator, {"t": t, "y": 0.5 * t + 0.01 * np.sin(9 * t)}))
    model = Model(prepared.null, (prepared.effects["delay"],), prepared.recording.plan)
    at_a_half, beyond = model.predict(np.array([[-0.67, 0.5, 0.0], [1.0, 0.5, 0.0]]))
    assert np.isfinite(at_a_half).all()
    assert not np.isfinite(beyond).all()
