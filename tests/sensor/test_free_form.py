"""SSFs of any form: one Gaussian, bent."""

import numpy as np
import pytest

from probewise.effects import VOCABULARY, Extent
from probewise.recordings import paper_plan
from probewise.scene import KnownScene
from probewise.sensor import (
    N_BENDS,
    N_FREE_FORM,
    Chain,
    FreeLevels,
    FreeMixture,
    bend_coefficients,
    free_form_theta,
    is_free_form,
)
from probewise.sensor import chain as chain_module

PLAN = paper_plan()
ONE = np.array([[0.02, 0.4, -0.3, 0.05, 0.03, 0.01]])
RNG = np.random.default_rng(11)
BENDS = 0.1 * RNG.standard_normal((6, N_BENDS))


def predicted(theta):
    levels = np.tile([10.0, 60.0], (len(theta), 1))
    chain = Chain(FreeMixture(theta.shape[1] // 6), FreeLevels(), KnownScene(PLAN.patterns))
    return chain.predict(np.concatenate([theta, levels], axis=1), PLAN)


def test_readings_are_linear_in_the_bends():
    plain, *bent = (predicted(free_form_theta(ONE, b[None])) for b in (np.zeros(N_BENDS), BENDS[0], BENDS[1]))
    both = predicted(free_form_theta(ONE, (2.0 * BENDS[0] - 3.0 * BENDS[1])[None]))
    np.testing.assert_allclose(both - plain, 2.0 * (bent[0] - plain) - 3.0 * (bent[1] - plain), atol=1e-9)
    assert np.ptp(bent[0] - plain) > 0.5


def test_bends_are_found_again_and_free_forms_are_known():
    bent = free_form_theta(np.repeat(ONE, 6, axis=0), BENDS)
    bent[:, ::6] *= 7.0  # only ratios of amplitudes matter
    np.testing.assert_allclose(bend_coefficients(bent), BENDS, atol=1e-12)
    assert is_free_form(bent)
    others = bent.copy()
    others[:, 9] *= 1.01
    assert not is_free_form(others)
    assert not is_free_form(ONE)


@pytest.mark.parametrize("name", [None, "position_scale", "albedo_gradient", "halo", "height_gradient", "edge_shadow"])
def test_hypotheses_that_share_a_geometry_are_seen_as_each_alone(name, monkeypatch):
    """Route one: once a geometry and summed; route two: each hypothesis by itself."""
    effects = [] if name is None else [VOCABULARY[name].for_extent(Extent(10.0, 60.0, PLAN))]
    built = Chain(FreeMixture(N_FREE_FORM), FreeLevels(), KnownScene(PLAN.patterns), effects)
    shapes = free_form_theta(np.repeat(ONE, 12, axis=0), 0.1 * RNG.standard_normal((12, N_BENDS)))
    shapes[6:, 1::6] += 0.3
    own = np.concatenate([effect.entries[0][:1] for effect in effects], axis=1) if effects else np.zeros((1, 0))
    own = np.where(np.arange(12)[:, None] % 6 < 3, 1.0, 1.2) * own
    theta = np.concatenate([shapes, np.tile([10.0, 60.0], (12, 1)), own], axis=1)
    together = built.predict(theta, PLAN)
    monkeypatch.setattr(chain_module, "_MANY", N_FREE_FORM + 1)
    alone = built.predict(theta, PLAN)
    np.testing.assert_allclose(together, alone, atol=1e-6)
    assert np.abs(np.diff(together, axis=0)).max(axis=1).min() > 0.01
