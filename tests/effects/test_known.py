"""An effect with known parameters is the effect, with nothing left to infer."""

import numpy as np
import pytest

from probewise.effects import EFFECTS, Known
from probewise.errors import ParameterError
from probewise.recordings import paper_plan
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels, FixedMixture


def test_a_chain_with_a_known_effect_predicts_what_the_free_one_predicts_there():
    """Two routes: parameters in theta, parameters in the effect."""
    plan = paper_plan()
    chain = Chain(
        FixedMixture([1.0], [[0.0, 1.5]], [[[16.0, 1.0], [1.0, 6.0]]]), FixedLevels(10, 60), KnownScene(plan.patterns)
    )
    gradient, bend = EFFECTS["ambient_gradient"](), EFFECTS["nonlinearity"]()
    free = chain.with_effects(gradient, bend)
    fixed = chain.with_effects(Known(gradient, (0.02, -0.01)), Known(bend, (1.2,)))
    values = {"ambient_gradient.per_mm_x": 0.02, "ambient_gradient.per_mm_y": -0.01, "nonlinearity.gamma": 1.2}
    theta = np.array([[values[name] for name in free.names]])
    assert fixed.names == ()
    np.testing.assert_allclose(fixed.predict(np.empty((1, 0)), plan), free.predict(theta, plan), atol=1e-12)


def test_the_wrong_number_of_values_is_refused():
    with pytest.raises(ParameterError, match="one number for each"):
        Known(EFFECTS["nonlinearity"](), (1.0, 2.0))
