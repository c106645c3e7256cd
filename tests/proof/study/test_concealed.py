"""What a study conceals, and under which conditions: the robot knows all but the effect."""

import numpy as np
import pytest

from probewise.arm import Pose
from probewise.experiment import CLEAN
from probewise.experiment.rivals import rivals_of
from probewise.proof.concealed_study import CONCEALED, ConcealedTrial, _arm_in_concealed_world
from probewise.proof.study import BRIGHT, DARK, FIELD, REFERENCE, experiment_of, footprint_pixels
from probewise.recordings import Disc, Plan
from probewise.world import World


def _readings(trial):
    """Readings inside the circle, across its edge and beside it, and back."""
    x, y, r = trial.circle_mm
    with _arm_in_concealed_world(trial) as arm:
        return np.array([arm.measure(Pose(x + d, y, 0.0)).value for d in 3 * (0, r + 2, 0, r - 1, r + 30, 1 - r, 0)])


@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=pytest.mark.slow) if k == "edge_blur" else k for k in CONCEALED]
)
def test_every_form_changes_readings_over_some_circle(name):
    plain, hidden = (
        np.array([_readings(ConcealedTrial(effect, 2, circle, 1.0, varied=True)) for circle in range(2)])
        for effect in ("", name)
    )
    assert np.isfinite(hidden).all()
    assert np.abs(hidden - plain).max() > 0.05


def test_every_right_answer_is_a_rival_of_the_robot():
    known = experiment_of(REFERENCE)
    rivals = {r.name for r in rivals_of(known.model, known.likelihood, (FIELD.width_mm, FIELD.height_mm))}
    assert {name for k in CONCEALED for name in ConcealedTrial(k, 0, 0, 1.0).right_answers} <= rivals | {CLEAN}


def test_under_varied_conditions_the_robot_knows_noise_rounding_and_sensor():
    """Two routes: the robot's model, and pixels; over a hundred circles every kind of conditions comes up."""
    trials = [ConcealedTrial("", 0, k, 1.0, varied=True) for k in range(100)]
    now = [trial.conditions for trial in trials]
    assert {len(c.blobs) for c in now} == {1, 2}
    assert {c.step for c in now} == {None, 1.0}
    assert 0.3 < min(c.noise_sd for c in now) < 0.4 < 1.7 < max(c.noise_sd for c in now) < 2.0
    assert 2 < min(c.each_s for c in now) < 3 < 17 < max(c.each_s for c in now) < 20
    trial = next(t for t in trials if len(t.conditions.blobs) > 1)
    x, y, r = trial.circle_mm
    steps = np.linspace(r - 20, r + 20, 9)
    zero = np.zeros(9, dtype=np.int64)
    plan = Plan(x + steps, np.full(9, y), np.zeros(9), 8.0 * np.arange(9), zero, ("s",), zero, ("field",))
    world = World(footprint_pixels(trial.conditions.blobs), black=DARK, white=BRIGHT, noise_sd=0.0)
    seen = world.expected_readings(plan, {"field": Disc((x, y), r)})
    predicted = trial.conditions.experiment().model.predict(trial.circle_mm[None, :], plan)[0]
    np.testing.assert_allclose(predicted, seen, atol=0.1)


def test_a_scale_of_x_that_is_named_is_compared_as_it_was_put_right():
    """Along X to the true lengths, or along Y to the arm's along X; unnamed, a circle lies between."""
    trial = ConcealedTrial("scale_of_x", 2, 0, 0.9)
    true = trial.circle_mm
    for mean, name, right in (
        (true + 1, "position_scale", true),
        (true / 1.05 + 1, "position_scale", true / 1.05),
        (true, CLEAN, true / [1.05, 1, 1]),
    ):
        np.testing.assert_allclose(trial.circle_found_as(name, mean), right)
