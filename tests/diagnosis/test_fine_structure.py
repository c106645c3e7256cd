"""Fine structure of an SSF."""

import numpy as np
import pytest

from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.fit import Fit, Model, fit
from probewise.diagnosis.noise import white_noise
from probewise.diagnosis.sensors import default_sensor, fine_structure_slopes, with_free_form
from probewise.effects import VOCABULARY, Extent
from probewise.recordings import Recording, paper_plan, two_way_plan
from probewise.world.spots import Blob, gaussian_spot, ring_spot
from probewise.world.world import World

NOISE_SD = 0.4


def fitted(recording: Recording, *, free: bool = True) -> Fit:
    sensor = default_sensor(Extent.of(recording), 1)
    law = white_noise(len(recording))
    one = fit(Model(sensor, (), recording.plan), recording, np.zeros(7), law.with_least_sigma(NOISE_SD))
    if not free:
        return one
    form = with_free_form(sensor)
    start = np.pad(one.z, (0, form.n_params - sensor.n_params))
    return fit(Model(form, (), recording.plan), recording, start, law.with_least_sigma(NOISE_SD))


def usable(recording: Recording) -> np.ndarray:
    return np.flatnonzero(recording.usable)


def noise_free(spot, plan) -> Recording:
    return Recording(plan, World(spot).expected_readings(plan))


@pytest.mark.parametrize("plan", [paper_plan(), two_way_plan()], ids=["paper", "two_way"])
def test_it_takes_up_what_a_free_form_leaves_of_a_ring(plan):
    recording = noise_free(ring_spot(4.0, 1.2, center_mm=(0.0, 1.5), off_axis=0.4, pixel_mm=0.5), plan)
    found = fitted(recording)
    slopes = np.concatenate([found.slopes, fine_structure_slopes(found.model, found.z, usable(recording))], axis=1)
    z = np.pad(found.z, (0, slopes.shape[1] - len(found.z)))
    design = np.concatenate([slopes / NOISE_SD, np.eye(len(z))])
    target = np.concatenate([found.residuals / NOISE_SD, -z])
    left = np.linalg.norm(target - design @ np.linalg.lstsq(design, target, rcond=None)[0])
    rest = float(np.linalg.norm(found.residuals) / NOISE_SD)
    assert rest > 1.0  # something is left of a ring, in noise sds
    assert np.sqrt(max(left**2 - np.sum(z**2), 0.0)) < 0.5 * rest


def test_effects_outlast_it():
    plan = two_way_plan()
    world = World(gaussian_spot([Blob(1.0, (0.4, -0.3), (5.0, 3.5), 0.3)], pixel_mm=0.5))
    rng = np.random.default_rng(7)
    recording = Recording(plan, world.expected_readings(plan) + NOISE_SD * rng.standard_normal(len(plan)))
    found = fitted(recording)
    law = white_noise(len(recording))
    extent = Extent.of(recording)
    more = fine_structure_slopes(found.model, found.z, usable(recording))
    without, beside = Linearised.of(found, law), Linearised.of(found, law, more)
    for name in ("backlash", "lag", "sensor_tilt", "ambient_gradient", "glint", "battery_sag", "flicker"):
        effect = VOCABULARY[name].for_extent(extent)
        model = found.model.with_effect(effect)
        z = np.concatenate([found.z, model.z_of_last_effect(effect.entries[0][:1])[0]])
        change = (model.predict(z[None, :])[0] - found.model.predict(found.z[None, :])[0])[:, None]
        kept = np.linalg.norm(beside.project(change)) / np.linalg.norm(without.project(change))
        assert kept > 0.9, name
