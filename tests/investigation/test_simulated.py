"""The simulated arm of an investigation: what it conceals, and that it can be cut anywhere."""

import pytest

from probewise.errors import ParameterError
from probewise.investigation import SimulatedRecorder, parse_concealed
from probewise.recordings import paper_plan
from probewise.world.concealed import Backlash, Lag, Saturation
from probewise.world.shipped import true_world


def few_rows():
    plan = paper_plan()
    return plan.take(plan.scan < 1)


def test_a_round_that_was_cut_goes_on_to_the_same_readings():
    take = SimulatedRecorder(true_world("paper"), seed=3)
    whole = list(take(2, few_rows(), "", ()))
    assert list(take(2, few_rows(), "", whole[:7])) == whole[7:]


def test_each_round_has_noise_of_its_own():
    take = SimulatedRecorder(true_world("paper"), seed=3)
    one, other = ([r.value for r in take(number, few_rows(), "", ())] for number in (1, 2))
    assert one != other


def test_what_a_world_conceals_is_read_from_its_name_and_numbers():
    assert parse_concealed("nothing") == ()
    assert parse_concealed("backlash:0.5+lag:2") == (Backlash(0.5), Lag(2.0))
    assert parse_concealed("saturation:55,1.5") == (Saturation(55.0, 1.5),)


@pytest.mark.parametrize(
    ("text", "way_out"),
    [
        ("backlash", "backlash:width_mm"),
        ("backlash:x", "backlash:width_mm"),
        ("backlash:1,2", "backlash:width_mm"),
        ("backlash:nan", "magnitude up to 1e"),
        ("backlash:0.5+lag:1e300", "magnitude up to 1e"),
        ("bcklash:1", "did you mean backlash"),
        ("", "nothing"),
    ],
)
def test_what_is_no_effect_is_refused_with_the_way_out(text, way_out):
    with pytest.raises(ParameterError, match=way_out):
        parse_concealed(text)
