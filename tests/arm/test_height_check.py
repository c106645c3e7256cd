"""Heights by the light: how much lower a sensor hangs shows over white, whatever the law of the light."""

import math

import numpy as np
import pytest

from probewise.arm.fitting import check_heights
from probewise.errors import ParameterError

HEIGHTS = np.arange(14.0, 23.0).tolist()
LAWS = {
    "square": lambda h: 60.0 * (14.0 / h) ** 2,
    "beside a room's light": lambda h: 25.0 + 35.0 * (14.0 / h) ** 2,
    "behind its peak": lambda h: 95.0 * h / 8 * math.exp(1 - h / 8),
}


def looks(law, heights, *, off_mm=0.0, noise=0.0, rng=None):
    return np.array(
        [(h, law(h + off_mm) + (noise * rng.standard_normal() if rng else 0.0), noise or 0.02) for h in heights]
    )


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize("off_mm", [-1.0, 0.4])
def test_a_sensor_that_hangs_elsewhere_is_told_by_how_much(law, off_mm):
    curve = looks(law, HEIGHTS)
    found = check_heights(curve, looks(law, [14.0, 14.3], off_mm=off_mm))
    np.testing.assert_allclose(found.off_mm, off_mm, atol=0.2 * abs(off_mm))
    assert np.sign(found.off_mm).tolist() == [math.copysign(1, off_mm)] * 2


def test_light_that_does_not_fall_with_the_height_tells_nothing():
    flat = looks(lambda h: 30.0, [14.0, 17.0, 20.0])
    with pytest.raises(ParameterError, match="is the LED lit"):
        check_heights(flat, looks(lambda h: 30.0, [14.0]))
    rising = looks(lambda h: 10.0 * h, [14.0, 17.0, 20.0])
    with pytest.raises(ParameterError, match="fall with the height"):
        check_heights(rising, looks(lambda h: 30.0, [14.0]))
