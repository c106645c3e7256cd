"""Check a geometry and a brick: where the arm reaches, and what the brick says."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from probewise.cli._arm import open_brick
from probewise.cli._arm_tasks.opening import UNITS, nxt_port
from probewise.cli._common import print_result
from probewise.cli._output import checked_output_file
from probewise.errors import LinkError, ParameterError

if TYPE_CHECKING:
    from probewise.arm import Geometry


def report_geometry_and_reach(arguments: argparse.Namespace, geometry: Geometry) -> None:
    import numpy as np

    from probewise.arm.geometry import JOINTS
    from probewise.recordings import write_bytes_atomically
    from probewise.report.plots.apparatus import draw_arm_lengths, reach_map
    from probewise.report.plots.canvas import png

    out = None if arguments.out is None else checked_output_file(arguments.out)
    drawing = None if arguments.drawing is None else checked_output_file(arguments.drawing)
    port = None if arguments.arm is None else nxt_port(arguments.arm)
    x_mm, y_mm = (np.linspace(0.0, length, n) for length, n in zip(geometry.field_mm, (131, 65), strict=True))
    places = np.stack(np.meshgrid(x_mm, y_mm), axis=-1).reshape(-1, 2)
    held = geometry.contains(places)
    print_result(f"reach        {geometry.sentence()}", quiet=arguments.quiet)
    print_result(f"field        {held.mean():.1%} of it within reach", quiet=arguments.quiet)
    for name, joint in zip(JOINTS, geometry.joints, strict=True):
        count_mm = geometry.farthest_mm / abs(joint.counts_per_rad)
        low, high = math.degrees(joint.low_rad), math.degrees(joint.high_rad)
        print_result(
            f"{name:<12} motor {'ABC'[joint.port]}, {low:g} to {high:g} degrees; "
            f"at {geometry.farthest_mm:.0f} mm one count is {count_mm:.2f} mm, "
            f"its play {joint.play_rad * geometry.farthest_mm:.1f} mm",
            quiet=arguments.quiet,
        )
    if geometry.accuracy is None:
        known = "not fitted to marks: with home 2 degrees off on both links the sensor hangs up to"
    else:
        known = f"fitted to {geometry.accuracy.marks} marks; by 2 sds the sensor may hang"
    print_result(
        f"height       reads {geometry.read_height_mm:g} mm up; {known} {geometry.max_height_error_mm:.1f} mm lower",
        quiet=arguments.quiet,
    )
    if not held.any():
        raise ParameterError("reach", "nowhere on the field", "links, heights and limits that reach the field")
    if out is not None:
        standing = np.where(held, geometry.orientation_rad(places), np.nan).reshape(y_mm.size, x_mm.size)
        write_bytes_atomically(out, png(reach_map(standing, x_mm, y_mm, axis_mm=geometry.axis_mm)))
        print_result(f"drawn        {out}", quiet=arguments.quiet)
    if drawing is not None:
        write_bytes_atomically(drawing, png(draw_arm_lengths(geometry)))
        print_result(f"drawn        {drawing}", quiet=arguments.quiet)
    if port is not None:
        _report_brick_state(port, geometry, quiet=arguments.quiet)


def _report_brick_state(port: str, geometry: Geometry, *, quiet: bool) -> None:
    """Print the brick's name, firmware, battery and light; raise LinkError if a program runs on it. Nothing moves."""
    from probewise.arm import percent_to_lego_units

    with open_brick(port) as brick:
        version = brick.version()
        firmware = f"{version.firmware_major}.{version.firmware_minor:02d}"
        battery_v = brick.battery_mv() / 1000
        print_result(f"brick        {brick.name()}, firmware {firmware}, battery {battery_v:.2f} V", quiet=quiet)
        light = brick.light_sensor(geometry.sensor_port).read()
        value = percent_to_lego_units(light.fine_percent, geometry)
        print_result(
            f"light        {value:g} {UNITS} at port {geometry.sensor_port + 1}, {light.raw_counts} raw counts",
            quiet=quiet,
        )
        program = brick.running_program()
        if program is not None:
            raise LinkError(f"the program {program} runs on the brick and may move the motors; stop it on the brick")
