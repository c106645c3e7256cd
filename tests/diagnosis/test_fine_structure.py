"""Fine structure of an SSF."""

from __future__ import annotations

import numpy as np
import pytest

from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.fit import Fit, Model, fit
from probewise.diagnosis.noise_law import white_noise
from probewise.diagnosis.sensors import cached_known_scene, default_sensor, fine_structure_slopes, with_free_form
from probewise.effects import VOCABULARY, Extent
from probewise.recordings import Recording, paper_plan, two_way_plan
from probewise.sensor import Chain, FixedLevels, FreeMixture
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


def test_the_slopes_are_those_of_a_mixture_with_a_little_of_each():
    """Second route: a true mixture of the fitted Gaussian and one narrow one, by a difference in its share."""
    recording = noise_free(gaussian_spot([Blob(1.0, (0.4, -0.3), (5.0, 3.5), 0.3)], pixel_mm=0.5), paper_plan())
    found = fitted(recording, free=False)
    more = fine_structure_slopes(found.model, found.z, usable(recording))
    assert more.shape[1] > 30
    theta = found.model.sensor.theta(found.z[None, :])[0]
    blob, levels = theta[:6], theta[6:]
    covariance = np.linalg.inv(2 * np.array([[blob[3], blob[5]], [blob[5], blob[4]]]))
    # The one in the middle: that whose slopes depend least on where the Gaussian is.
    aa, cc, bb = np.linalg.inv(2 * 0.35**2 * covariance)[[0, 0, 1], [0, 1, 1]]
    share = 1e-4
    mass = np.sqrt((aa * bb - cc**2) / (blob[3] * blob[4] - blob[5] ** 2))
    two = np.concatenate([blob, [blob[0] * share / (1 - share) * mass, blob[1], blob[2], aa, bb, cc]])
    chain = Chain(FreeMixture(2), FixedLevels(*levels), cached_known_scene(recording.plan), ())
    slope = (chain.predict(two[None, :], recording.plan)[0] - found.predicted) / share
    closest = np.linalg.norm(more / 0.03 - slope[:, None], axis=0).min()
    assert closest < 1e-3 * np.linalg.norm(slope)


@pytest.mark.parametrize("plan", [paper_plan(), two_way_plan()], ids=["paper", "two_way"])
def test_it_takes_up_what_a_free_form_leaves_of_a_ring(plan):
    recording = noise_free(ring_spot(4.0, 1.2, pixel_mm=0.5), plan)
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
        z = np.concatenate([found.z, model.z_of_last_effect(effect.bank()[0][:1])[0]])
        change = (model.predict(z[None, :])[0] - found.model.predict(found.z[None, :])[0])[:, None]
        kept = np.linalg.norm(beside.project(change)) / np.linalg.norm(without.project(change))
        assert kept > 0.9, name
