"""Check by the light over white whether the sensor hangs as high as its counters say."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from probewise.cli._arm import parse_arm, parse_place
from probewise.cli._arm_tasks.opening import confirm_lowering, open_instrument, prompter_unless_dry_run
from probewise.cli._common import print_result, print_warning
from probewise.errors import ParameterError

if TYPE_CHECKING:
    from probewise.arm import Geometry

WHITE = "uniform:1"
_HEIGHTS, _APART_MM = 9, 1.0  # at which the light is learnt, from that of reading upwards
_STEP_OF_LIGHT = 0.1  # of a reading in all its steps, 0 to 100


def compare_heights_by_light(arguments: argparse.Namespace, geometry: Geometry) -> None:
    """Compare by the light over white the sensor's height at each place with that at the first; print differences."""
    import numpy as np

    from probewise.arm import LegoArm, require_within_reach
    from probewise.arm.height_check import HeightReading, check_heights
    from probewise.arm.marks import spread_mark_places

    if arguments.arm is not None and not parse_arm(arguments.arm).is_lego:
        raise ParameterError("--arm", arguments.arm, "nxt:PORT, or emulator:TRUE.toml")
    width, height = geometry.field_mm
    places = [parse_place("X,Y", text) for text in arguments.places]
    places = places or [(width / 2, height / 2), *((x, y) for x, y in spread_mark_places(geometry).tolist())]
    if len(places) < 2:
        raise ParameterError("X,Y", " ".join(arguments.places), "two places or more: heights are compared")
    require_within_reach(geometry, np.array(places), "place")
    arguments.sensor = arguments.seed = arguments.scene = None
    instrument, bench = open_instrument(arguments, geometry, scene=WHITE)
    assert isinstance(instrument, LegoArm)
    confirm_lowering(arguments, instrument, geometry)
    with instrument as arm:
        if bench is None:
            prompter_unless_dry_run(arguments, arm)(
                "lay white matt paper, the same everywhere, over the field, or under each place"
            )

        def height_reading_at(place: tuple[float, float], height_mm: float) -> HeightReading:
            arm.go_down(*place, height_mm)
            values = np.array([arm.brightness() for _ in range(arguments.readings)])
            error = max(float(values.std()), _STEP_OF_LIGHT) / math.sqrt(arguments.readings)
            return HeightReading(float(arm.position_mm[2]), float(values.mean()), error)

        arm.go_over(*places[0])
        lowest_mm = geometry.read_height_mm
        curve = [height_reading_at(places[0], lowest_mm + _APART_MM * k) for k in range(_HEIGHTS)]
        lights = []
        for place in places[1:]:
            lights.append(height_reading_at(place, lowest_mm))
            if not arguments.dry_run:
                found = check_heights(curve, lights)
                print_result(_height_error_in_words(place, found.off_mm[-1], found.sd_mm[-1]), quiet=arguments.quiet)
    if arguments.dry_run:
        return
    print_result(
        f"light        falls by {found.per_mm:.1%} with each mm at {lowest_mm:g} mm (in [sensor] of the geometry: "
        f"light_per_mm = {found.per_mm:.3f}); heights are relative to the first place, "
        f"({places[0][0]:g}, {places[0][1]:g}) mm",
        quiet=arguments.quiet,
    )
    if found.agrees:
        print_result(f"heights      agree with the counters (p = {found.p_value:.2g})", quiet=arguments.quiet)
    else:
        worst = int(np.argmax(np.abs(found.off_mm / found.sd_mm)))
        print_warning(
            f"the light contradicts the heights (p = {found.p_value:.1g}), most at "
            f"{_height_error_in_words(places[1 + worst], found.off_mm[worst], found.sd_mm[worst])}; is the paper the "
            "same everywhere? Then bring the sensor to marks there and fit the geometry again "
            "(probewise arm fit-geometry)"
        )


def _height_error_in_words(place_mm: tuple[float, float], off_mm: float, sd_mm: float) -> str:
    side = "higher" if off_mm > 0 else "lower"
    x_mm, y_mm = place_mm
    return f"({x_mm:g}, {y_mm:g}) mm: it hangs {abs(off_mm):.1f} ± {sd_mm:.1f} mm {side} than its counters say"
