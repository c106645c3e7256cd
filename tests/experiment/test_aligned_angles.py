"""Angles count within the symmetry of their shape: in moments, in the chance of being off, and to the end of a run."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from probewise.experiment.judgement import (
    probability_of_length_off,
    shape_moments_and_probabilities,
    with_aligned_angles,
)
from probewise.nested import Weighted
from probewise.scene import AnyOf, Circle, Field, Rectangle

FIELD = Field(400.0, 300.0)
UPRIGHT = np.array([[200.0, 150.0, 80.0, 120.0, 0.02], [200.0, 150.0, 120.0, 80.0, math.pi / 2 - 0.02]])


@dataclass(frozen=True)
class Anything:
    """A sensor with these parameters that reads 0 everywhere."""

    names: tuple[str, ...]

    def predict(self, theta, plan):
        return np.zeros((len(theta), len(plan)))


def of_samples(small, shape, theta):
    """An experiment for the shape, and its posterior of equally weighted samples."""
    names = shape.prior.names
    experiment = small.experiment(shape=shape, model=Anything(names))
    even = np.full(len(theta), -math.log(len(theta)))
    return experiment, Weighted(names, theta, np.zeros(len(theta)), even, 0.0, 0.0, float(len(theta)), 0, -math.inf)


def test_an_upright_rectangle_has_two_sides_whatever_end_of_the_range_its_angles_lie_at(small):
    experiment, posterior = of_samples(small, Rectangle(FIELD), np.repeat(UPRIGHT, 50, axis=0))
    raw_sd = shape_moments_and_probabilities(experiment, posterior)[1]
    assert raw_sd[2] == pytest.approx(20.0)
    aligned = with_aligned_angles(experiment, posterior)
    mean, sd, _ = shape_moments_and_probabilities(experiment, aligned)
    assert sorted(mean[2:4]) == pytest.approx([80.0, 120.0])
    assert sd == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.02], abs=1e-9)
    assert probability_of_length_off(experiment, posterior, 12.0) == pytest.approx(1.0)
    assert probability_of_length_off(experiment, aligned, 12.0) == 0.0


def test_of_a_set_of_shapes_each_is_aligned_by_its_own_samples(small):
    shape = AnyOf({"circle": Circle(FIELD), "rectangle": Rectangle(FIELD)})
    circles = np.column_stack([np.full(10, 0.5), np.tile([200.0, 150.0, 50.0, 70.0, 70.0, 1.5], (10, 1))])
    rectangles = np.column_stack([np.full(20, 1.5), np.repeat(UPRIGHT, 10, axis=0)[:, :2], np.full(20, 50.0)])
    rectangles = np.column_stack([rectangles, np.repeat(UPRIGHT, 10, axis=0)[:, 2:]])
    experiment, posterior = of_samples(small, shape, np.concatenate([circles, rectangles]))
    _, sd, shapes = shape_moments_and_probabilities(experiment, with_aligned_angles(experiment, posterior))
    assert shapes["rectangle"] == pytest.approx(2 / 3)
    assert sd[[4, 5]] == pytest.approx([0.0, 0.0], abs=1e-9)
