"""The model with effects that somebody has chosen."""

import numpy as np
import pytest

from probewise.diagnosis import model_with
from probewise.errors import ParameterError
from probewise.recordings import paper_plan
from probewise.world import Blob, World, gaussian_spot
from probewise.world.concealed import offset_drift

PLAN = paper_plan()
SPOT = gaussian_spot([Blob(1.0, (1.5, 2.5), (6.0, 8.0), 0.2)])
RECORDING = World(SPOT, concealed=(offset_drift(6.0),)).simulate(PLAN, rng=np.random.default_rng(0))


@pytest.mark.slow
def test_the_effect_chosen_is_fitted():
    found = model_with(RECORDING, ["offset_drift"], rng=np.random.default_rng(1))
    assert found.effects == ("offset_drift",)
    drift = found.effect_samples("offset_drift")[:, 0]
    assert abs(drift.mean() - 6.0) < 4 * drift.std()
    plain = model_with(RECORDING, [], rng=np.random.default_rng(1))
    assert plain.effects == ()
    assert found.noise_sd.mean() < plain.noise_sd.mean()


@pytest.mark.parametrize("name", ["hum", "dropouts"])
def test_a_name_that_cannot_be_and_lost_readings_of_which_there_is_none_are_refused(name):
    with pytest.raises(ParameterError, match=name):
        model_with(RECORDING, [name], rng=np.random.default_rng(1))
