"""What has no name gives way to a name, and when it does not."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

from probewise.diagnosis.noise.law import white
from probewise.diagnosis.search.search import _Searcher

N = 50
NAME, PUSH = ("sensor_tilt",), ("arm_knock",)


@dataclass(frozen=True)
class Held:
    """As much of a candidate as is asked here: its names, its log evidence, what it leaves of every reading."""

    names: tuple[str, ...]
    log_z: float
    left: float = 0.0
    log_share: float = 0.0
    n_gaussians: int = 1
    weights: dict = field(default_factory=dict)
    law = white(N)

    @property
    def evidence(self):
        return {(): SimpleNamespace(log_z=self.log_z)}

    @property
    def found(self):
        return SimpleNamespace(residuals=np.full(N, self.left), sd=1.0)

    def as_share(self, log_share, _):
        return replace(self, log_z=self.log_z + log_share - self.log_share, log_share=log_share)


def searcher(*candidates, unknown=None):
    made = object.__new__(_Searcher)
    made.candidates = {(c.n_gaussians, c.names): c for c in candidates}
    made.unknown = {(1, names, ()): value for names, value in (unknown or {}).items()}
    made.noises = SimpleNamespace(log_prior=lambda names: 0.0)
    made.spoken_for = set()
    return made


@pytest.mark.parametrize(("ahead", "believed"), [(-1.0, -1.0), (2.0, 0.0), (4.0, 4.0)])
def test_what_is_ahead_of_a_name_by_less_than_the_readings_tell_is_believed_no_more(ahead, believed):
    made = searcher(Held((), -50.0), Held(NAME, 0.0), Held(PUSH, ahead, left=1.0))
    made._speak_for_the_unnamed()
    assert made.candidates[1, PUSH].log_z == pytest.approx(believed)
    assert made.candidates[1, NAME].log_z == 0.0
    assert made.spoken_for == set()


def test_what_predicts_the_same_as_a_name_is_left_out():
    """Half of the squared distance is 50 * 0.3^2 / 2, less than three nats."""
    made = searcher(Held((), -50.0), Held(NAME, -9.0), Held(PUSH, 0.0, left=0.3))
    made._speak_for_the_unnamed()
    assert made.spoken_for == {PUSH}
    assert (1, PUSH) not in made.candidates


def test_two_names_do_not_speak_for_one_effect_without():
    made = searcher(Held((), -50.0), Held(("lag", "sensor_tilt"), 0.0), Held(PUSH, 2.0, left=0.1))
    made._speak_for_the_unnamed()
    assert made.candidates[1, PUSH].log_z == 2.0


@pytest.mark.parametrize(
    ("name", "beside", "speaks"),
    [(-1.0, 0.0, True), (-1.0, 2.5, False), (-4.0, -4.0, False)],
    ids=["as much, and nothing left", "something left", "far behind"],
)
def test_a_name_speaks_for_bases_that_explain_no_more_and_find_nothing_beside_it(name, beside, speaks):
    made = searcher(Held((), -50.0), Held(NAME, name), unknown={(): 0.0, NAME: beside})
    made._speak_for_the_unknown()
    assert ((1, (), ()) not in made.unknown) == speaks
    assert (1, NAME, ()) in made.unknown
