"""What a null model leaves of an effect, by full refit and by projection."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.effects import VOCABULARY
from probewise.proof.refits import NullRefit, cosines_with_vocabulary
from probewise.proof.tables import score
from probewise.recordings.plan import Recording
from probewise.recordings.plans import paper_plan
from probewise.world.concealed import ambient_step, halo
from probewise.world.spots import Blob, gaussian_spot
from probewise.world.world import World

from ..conftest import hidden, single


@pytest.fixture(scope="module")
def world():
    return World(gaussian_spot([Blob(1.0, (0.5, 1.5), (4.0, 2.5), 0.2)], pixel_mm=0.5))


@pytest.fixture(scope="module")
def plan():
    return paper_plan()


@pytest.fixture(scope="module")
def clean(world, plan):
    return world.simulate(plan, rng=None)


@pytest.fixture(scope="module")
def refit(clean):
    refit = NullRefit()
    refit.null_fit(clean)
    return refit


def changed(clean, change):
    return Recording(clean.plan, clean.readings + change)


def test_what_is_left_of_a_small_effect_is_its_projection(refit, clean):
    """Two routes: the refit, and least squares on slopes by differences."""
    null = refit.null_fit(clean)
    wave = 0.2 * np.sin(np.arange(len(clean)) / 7.0)
    _, slopes = null.model.predict_and_differentiate(null.z)
    left = wave - slopes @ np.linalg.lstsq(slopes, wave)[0]
    assert refit(clean, changed(clean, wave)) == pytest.approx(np.linalg.norm(left), rel=0.01)


def test_an_effect_is_like_itself_and_like_no_other(refit, world, plan, clean):
    at_s = float(np.quantile(plan.time_s, 0.4))
    step = replace(world, concealed=(ambient_step(1.0, at_s),)).simulate(plan, rng=None)
    few = {name: VOCABULARY[name] for name in ("ambient_step", "offset_drift", "backlash", "correlated_noise")}
    found = cosines_with_vocabulary(refit, clean, step, vocabulary=few)
    assert found["ambient_step"] == pytest.approx(1.0, abs=1e-3)
    assert 0.3 < found["offset_drift"] < 0.95
    assert found["backlash"] < 0.3
    assert "correlated_noise" not in found


@pytest.mark.slow
def test_a_skirt_about_a_gaussian_spot_is_one_gaussian_more(refit, world, plan, clean):
    """And a change of the light is not: it is not even asked."""
    skirt = replace(world, concealed=(halo(0.08, 12.0),)).simulate(plan, rng=None)
    assert cosines_with_vocabulary(refit, clean, skirt)["ssf_order"] > 0.99
    step = replace(world, concealed=(ambient_step(0.4, 300.0),)).simulate(plan, rng=None)
    assert "ssf_order" not in cosines_with_vocabulary(refit, clean, step)


def test_an_alarm_is_due_on_physics_alone():
    like = hidden("halo", cosines={"halo": 1.0, "ssf_order": 0.999})
    results = [single("halo", hide=like, p_value=0.7), single("lag", p_value=1e-5)]
    (found,) = (row for row in score(results) if row.name == "detection, alpha .01, lambda 8")
    assert (found.found.value, found.found.n) == (1.0, 1)
