"""Carry out a plan and write the recording."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from probewise.cli._arm import parse_arm, parse_place
from probewise.cli._arm_tasks.opening import (
    confirm_lowering,
    is_own_instrument,
    nxt_port,
    open_instrument,
    prompter_unless_dry_run,
    refuse_options,
)
from probewise.cli._common import message_to_resume, print_result, print_warning
from probewise.cli._output import checked_output_file
from probewise.cli._plans import (
    SHIPPED,
    plan_for_lego_arm,
    plan_for_own_instrument,
    read_or_shipped_plan,
    without_measured_covariates,
)
from probewise.cli._stopping import reporting_what_is_kept

if TYPE_CHECKING:
    from probewise.arm import Geometry, RequestToPerson
    from probewise.recordings import Plan


def record_plan(arguments: argparse.Namespace, geometry: Geometry) -> None:
    from probewise._progress import progress_shown
    from probewise.arm import carry_out, recording_of_readings
    from probewise.arm.carry_out import BY_HAND_S, duration_s
    from probewise.cli._earlier_readings import earlier_readings, read_unfinished_recording
    from probewise.cli._person import PersonAtBench, is_pty
    from probewise.cli._sheet_check import SheetCheck
    from probewise.recordings import write_recording
    from probewise.recordings.atomic import is_device_or_pipe

    named = arguments.plan in SHIPPED
    out = checked_output_file(arguments.out, *([] if named else [Path(arguments.plan)]))
    own = is_own_instrument(arguments)
    asked = read_or_shipped_plan(arguments.plan)
    if own:
        plan = plan_for_own_instrument(asked, unit=arguments.unit, range_=arguments.range, step=arguments.step)
    elif arguments.sensor is not None:
        plan = _plan_for_simulated_sensor(asked, arguments.sensor)
    else:
        refuse_options(arguments, "the LEGO arm: it is known", "unit", "range", "step")
        plan = plan_for_lego_arm(asked, geometry)
    width, height = (0.0, 0.0) if own else geometry.field_mm
    origin = (width / 2, height / 2) if arguments.origin_mm is None else parse_place("--origin-mm", arguments.origin_mm)
    is_lego = arguments.arm is None or parse_arm(arguments.arm).is_lego
    at_end = is_device_or_pipe(out)  # which takes the recording once
    taken = [] if arguments.dry_run or at_end else earlier_readings(out, plan, resume=arguments.resume, is_lego=is_lego)
    start_s = taken[-1].time_s if taken else 0.0

    def kept_message() -> str:
        if not out.exists():
            return "nothing was read"
        if at_end:
            return f"nothing was kept: {out} takes whole recordings"
        return message_to_resume(
            out, len(read_unfinished_recording(out)), "reading", arguments, "--resume", of=len(plan)
        )

    instrument, bench = open_instrument(arguments, geometry, start_s=start_s, n_taken=len(taken))
    confirm_lowering(arguments, instrument, geometry)
    with reporting_what_is_kept(kept_message), instrument as arm:
        check = SheetCheck(plan, white_is_bright=not own)
        by_person = bench is None and not arguments.dry_run
        ask: Callable[[RequestToPerson], None] = (
            prompter_unless_dry_run(arguments, arm)
            if bench is None
            else partial(bench.carry_out_request, plan.patterns, origin)
        )
        if by_person:
            arm.mounted_rad = math.nan  # an earlier process may have left the sensor turned
            ask = PersonAtBench(
                arm, plan, origin, check, check_sheets=not own, emulated=not own and is_pty(nxt_port(arguments.arm))
            )
            seconds = duration_s(arm, plan, origin_mm=origin, first=len(taken))
            print_result(
                f"{len(plan) - len(taken)} readings, about {seconds / 60:.0f} minutes; including {BY_HAND_S:g} s for "
                f"each step by hand",
                quiet=arguments.quiet,
            )
        readings = carry_out(arm, plan, origin_mm=origin, ask=ask, first=len(taken))
        with progress_shown(quiet=arguments.quiet, beat=False) as progress:
            progress("readings", len(taken), len(plan))
            for reading in readings:
                wrong = check.complaint_about_reading(len(taken), reading.value)
                if wrong is not None and not arguments.dry_run:
                    print_warning(f"{wrong}; is the right sheet there, the right way round?")
                taken.append(reading)
                progress("readings", len(taken), len(plan))
                if not arguments.dry_run and not at_end:
                    write_recording(recording_of_readings(plan, taken), out)
    if not arguments.dry_run:
        if at_end:
            write_recording(recording_of_readings(plan, taken), out)
        print_result(f"{len(taken)} readings: {out}", quiet=arguments.quiet)


def _plan_for_simulated_sensor(plan: Plan, sensor: Path) -> Plan:
    """Return the plan with the instrumentation of a sensor.json, and without measured covariates."""
    import dataclasses

    from probewise.calibration import read_sensor

    return without_measured_covariates(dataclasses.replace(plan, instrumentation=read_sensor(sensor).instrumentation))
