"""What could be said at best, by a second route: points in a plane, drawn with noise."""

import math

import numpy as np
import pytest

from probewise.challenge.ideal import ideal_set_size, most_often_located, most_often_right


def hidden(size, **cosines):
    return {"name": "lag", "size_lambda": size, "in_vocabulary": True, "cosines": {"lag": 1.0, **cosines}}


def test_one_rival_is_told_as_often_as_the_nearer_of_two_points():
    size, rho = 6.0, 0.8
    rng = np.random.default_rng(1)
    own = np.array([size, 0.0])
    rival = size * np.array([rho, math.sqrt(1 - rho**2)])
    # The rival as far away as it is for him: its part along the true one is what a fit of its size would take up.
    nearest = rho * rival
    read = own + rng.standard_normal((200_000, 2))
    right = np.linalg.norm(read - own, axis=1) < np.linalg.norm(read - nearest, axis=1)
    assert most_often_right(hidden(size, halo=rho)) == pytest.approx(right.mean(), abs=0.003)


def test_the_hardest_rival_that_is_wrong_bounds_it():
    # At lambda 8 a cosine of .99 leaves less than three nats: that name is right too.
    assert most_often_right(hidden(8.0, backlash=0.99)) == 1.0
    hard = most_often_right(hidden(8.0, halo=0.9))
    assert most_often_right(hidden(8.0, backlash=0.99, halo=0.9, glint=0.6)) == hard < 1


def test_a_rival_that_shows_in_the_same_is_no_other_place():
    shown = {"shows_in": ["slope", "direction"]}
    assert most_often_located({**hidden(8.0, backlash=1.0), **shown}) == 1.0
    # A rival in another covariate that leaves the same trace is taken for it every other time.
    assert most_often_located({**hidden(8.0, nonlinearity=1.0), **shown}) == 0.5
    assert 0.9 < most_often_located({**hidden(8.0, nonlinearity=0.9), **shown}) < 1.0


def test_the_set_holds_one_where_nothing_is_alike_and_aliases_count_once():
    assert ideal_set_size(hidden(8.0)) == 1.0
    assert ideal_set_size(hidden(8.0, backlash=1.0)) == 1.0
    assert 1.0 < ideal_set_size(hidden(8.0, halo=0.92)) < 2.0
    assert ideal_set_size(hidden(8.0, halo=0.5)) == pytest.approx(1.0, abs=0.01)
