"""Numbers and units as every sentence writes them."""

import pytest

from probewise._words import unit_after_number, unit_of_name, value_with_sd


@pytest.mark.parametrize(
    ("mean", "sd", "unit", "written"),
    [
        (0.0132, 0.0004, "1/d", "0.01320 ± 0.00040 per d"),
        (-3.161e-9, 5.2e-11, "1 per load_lb", "(-3.161 ± 0.052)e-09 per load_lb"),
        (2.68, 0.1, "1", "2.68 ± 0.10"),
        (50.0, 0.5, "LEGO", "50.00 ± 0.50 LEGO units"),
        (-247.0, 28.0, unit_of_name("tau_s"), "-247 ± 28 s"),
        (3.0, 0.0, "V", "3 V"),
    ],
)
def test_a_number_is_written_with_its_sd_and_unit(mean, sd, unit, written):
    assert value_with_sd(mean, sd, unit) == written


@pytest.mark.parametrize(
    ("name", "unit"), [("battery_mv", "mV"), ("turn_deg", "°"), ("I_min", ""), ("s", ""), ("mm_per_hour", "")]
)
def test_a_unit_is_read_from_the_end_of_a_name(name, unit):
    assert unit_of_name(name) == unit
    assert unit_after_number(unit) == unit
