"""The oracle baseline by a second route: readings drawn with noise, and the nearer of two fits."""

import math

import numpy as np
import pytest

from probewise.proof.tables import oracle_credible_set_size, oracle_name_rate, readings_to_separate_alias

from ..conftest import case, hidden


def lag(size, **cosines):
    return {"name": "lag", "size_lambda": size, "in_vocabulary": True, "cosines": {"lag": 1.0, **cosines}}


def test_one_rival_is_told_as_often_as_the_nearer_of_two_points():
    """What the rival of fitted size predicts is the projection of the truth on its direction, by least squares."""
    size, rho = 6.0, 0.8
    rng = np.random.default_rng(1)
    own = np.array([size, 0.0])
    way = np.array([rho, math.sqrt(1 - rho**2)])
    rival = np.linalg.lstsq(way[:, None], own, rcond=None)[0] * way
    read = own + rng.standard_normal((200_000, 2))
    right = np.linalg.norm(read - own, axis=1) < np.linalg.norm(read - rival, axis=1)
    assert oracle_name_rate(lag(size, halo=rho)) == pytest.approx(right.mean(), abs=0.003)


def test_the_hardest_rival_that_is_wrong_counts():
    # At lambda 8 a cosine of .99 leaves less than three nats: that name is right too.
    assert oracle_name_rate(lag(8.0, backlash=0.99)) == 1.0
    hard = oracle_name_rate(lag(8.0, halo=0.9))
    assert oracle_name_rate(lag(8.0, backlash=0.99, halo=0.9, glint=0.6)) == hard < 1


def test_the_set_holds_one_where_nothing_is_alike_and_aliases_count_once():
    assert oracle_credible_set_size(lag(8.0)) == 1.0
    assert oracle_credible_set_size(lag(8.0, backlash=1.0)) == 1.0
    assert 1.0 < oracle_credible_set_size(lag(8.0, halo=0.92)) < 2.0
    assert oracle_credible_set_size(lag(8.0, halo=0.5)) == pytest.approx(1.0, abs=0.01)


def test_no_number_of_repeated_plans_parts_two_that_agree():
    alias = case("alias", 12.0, truth=["lag"], hides=[hidden("lag", 12.0)], cosine=-1.0)
    assert readings_to_separate_alias(alias) == math.inf
    assert readings_to_separate_alias(alias | {"cosine": 0.5}) == pytest.approx(408 * 3 / 54)
