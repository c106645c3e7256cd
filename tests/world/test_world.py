"""Readings, noise, and each concealed effect against its formula in the vocabulary."""

import pickle

import numpy as np
import pytest

from probewise.errors import ParameterError
from probewise.recordings import HalfPlane, Uniform, paper_plan, two_way_plan
from probewise.world import Blob, Reader, World, gaussian_spot
from probewise.world import concealed as known
from probewise.world.stages import acts_at

SPOT = gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5), 0.15)], pixel_mm=0.5)
PLAN = two_way_plan()


def world(*concealed, **more):
    return World(SPOT, concealed=concealed, **more)


@pytest.fixture(scope="module")
def clean():
    return world().expected_readings(PLAN)


def test_one_reading_by_one_gives_the_same_as_the_whole_plan(clean):
    effects = world(
        known.backlash(1.0),
        known.albedo_patch(-0.2, 3.0, 1.0, 6.0),
        known.height_gradient(0.01),
        known.sensor_tilt(0.5, 0.2),
        known.halo(0.1, 15.0),
        known.edge_shadow(0.05, 4.0),
        known.gain_drift(0.1, 300.0),
        known.ambient_gradient(0.01, 0.02),
        known.saturation(50.0),
    )
    together = effects.expected_readings(PLAN)
    for k in range(0, len(PLAN), 53):
        alone = effects.read(
            PLAN.patterns[PLAN.pattern_names[PLAN.pattern[k]]],
            PLAN.x_mm[k],
            PLAN.y_mm[k],
            PLAN.orientation_rad[k],
            time_s=PLAN.time_s[k],
            rng=None,
            direction=tuple(PLAN.direction_of_motion[k]),
        )
        assert alone == pytest.approx(together[k], abs=1e-9)


def test_a_reader_remembers_its_way_and_its_readings():
    plan = PLAN.take(np.arange(40))
    effects = world(known.backlash(1.0), known.hysteresis(2.0), known.lag(1.0), noise_sd=0.0)
    surface, reader = plan.patterns[plan.pattern_names[plan.pattern[0]]], Reader(effects, seed=(1,))
    rows = zip(plan.x_mm, plan.y_mm, plan.orientation_rad, plan.time_s, strict=True)
    alone = [reader.read(surface, x, y, turn, time_s=time_s) for x, y, turn, time_s in rows]
    together = effects.expected_readings(plan)
    np.testing.assert_allclose(alone[20:], together[20:], atol=1e-6)  # of its first reading it knows no direction


def test_readings_are_rounded_to_the_step():
    readings = world(step=0.5).simulate(paper_plan(), rng=np.random.default_rng(7)).readings
    np.testing.assert_array_equal(readings * 2, np.round(readings * 2))


def test_an_effect_of_ones_own_is_one_short_function(clean):
    @acts_at("offset")
    def step(at_s):
        return lambda values, rows: values + (rows.time_s > at_s)

    assert step(100).name == "step"
    assert {step(100), step(at_s=100)} == {step(100)} != {step(99)}
    assert pickle.loads(pickle.dumps(known.saturation(45.0))) == known.saturation(45.0, softness=0.0)
    np.testing.assert_allclose(world(step(100)).expected_readings(PLAN) - clean, PLAN.time_s > 100, atol=1e-12)


def test_an_effect_at_no_known_stage_is_refused():
    with pytest.raises(ParameterError, match=r"stage"):
        acts_at("somewhere")


def test_what_lies_there_can_differ_from_what_the_plan_says():
    """A pattern that the description misplaces, or that only the world knows."""
    plan = paper_plan()
    moved = world().expected_readings(plan, surfaces={"boundary": HalfPlane(0.0, 1.0)})
    np.testing.assert_allclose(moved[1:101], world().expected_readings(plan)[0:100], atol=0.02)
    unknown = PLAN.take(np.arange(3))
    hidden = type(unknown)(**{**vars(unknown), "patterns": {}})
    with pytest.raises(ParameterError, match="boundary"):
        world().expected_readings(hidden)
    np.testing.assert_allclose(world().expected_readings(hidden, {"boundary": Uniform(1.0)}), 60)


@pytest.mark.parametrize("changes", [{"noise_sd": -1.0}, {"noise_sd": np.nan}, {"step": 0.0}])
def test_a_world_without_sense_is_refused(changes):
    with pytest.raises(ParameterError):
        world(**changes)
