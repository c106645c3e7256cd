"""What another sensor model makes of the readings that a run has taken."""

import numpy as np
import pytest

from probewise.experiment import explore, shadow_run
from probewise.inquiry import Grid

COARSE = Grid(400.0, 300.0, 17, 13)


def steps_of(small, **options):
    return explore(small.arm(), small.experiment(grid=COARSE, **options), rng=np.random.default_rng(1), max_readings=6)


def watched(small, other):
    return list(shadow_run(steps_of(small), other, small.arm(), rng=np.random.default_rng(2)))


@pytest.mark.slow
def test_the_run_goes_its_way_whoever_looks_on(small):
    alone = list(steps_of(small))
    pairs = watched(small, small.experiment(grid=COARSE, blur_mm=0.0, doubt_p=0.0))
    assert [own.reading for own, _ in pairs] == [step.reading for step in alone]
    assert [own.mean.tolist() for own, _ in pairs] == [step.mean.tolist() for step in alone]
    assert [other.reading for _, other in pairs] == [own.reading for own, _ in pairs]
    assert [other.number for _, other in pairs] == list(range(1, len(alone) + 1))
    assert pairs[-1][1].mean.tolist() != pairs[-1][0].mean.tolist()
