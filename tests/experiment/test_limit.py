"""How few readings could do, by hand."""

from math import e, log2, pi

import numpy as np
import pytest

from probewise.experiment import Experiment, least_readings
from probewise.inference import GaussianKnown
from probewise.inquiry import Readout
from probewise.inquiry.readout import capacity_bits
from probewise.scene import Circle, Field, HypothesisScene
from probewise.sensor import FAST_NODES, Chain, FixedLevels, FixedMixture


def test_the_bound_is_that_of_the_prior_the_disc_and_the_sensor_by_hand():
    """A sensor so narrow that a place is met as often as the disc covers it: mean of pi r^2 over the field."""
    field = Field(1000.0, 500.0)
    shape = Circle(field, (50.0, 150.0))
    mixture = FixedMixture([1.0], [[0.0, 0.0]], [[[0.5, 0.0], [0.0, 0.5]]])
    model = Chain(mixture, FixedLevels(10.0, 60.0), HypothesisScene(shape), n_nodes=FAST_NODES)
    bound = least_readings(Experiment(shape, model, GaussianKnown(1.0), 1.0), rng=np.random.default_rng(0))
    covered = np.pi * (150.0**3 - 50.0**3) / (3 * 100.0) / (1000.0 * 500.0)
    prior_bits = log2(1000.0 * 500.0 * 100.0)
    assert bound.search_bits == pytest.approx(-log2(covered), abs=0.25)  # of 20,000 draws the best of all places
    target_bits = 1.5 * log2(2 * pi * e * 4.0**2)
    assert bound.refinement_bits == pytest.approx(prior_bits + log2(covered) - target_bits, abs=0.25)
    assert bound.capacity_bits == pytest.approx(capacity_bits(10.0, 60.0, Readout(1.0)))
    assert bound.search_capacity_bits == pytest.approx(
        -covered * log2(covered) - (1 - covered) * log2(1 - covered), abs=0.05
    )
    readings = bound.search_bits / bound.search_capacity_bits + bound.refinement_bits / bound.capacity_bits
    assert 5.0 < readings < 20.0
