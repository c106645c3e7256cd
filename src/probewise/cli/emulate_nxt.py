"""`probewise emulate-nxt`: emulate a LEGO brick with the arm, behind a serial device."""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from probewise import emulator
from probewise._signals import reporting_what_is_kept
from probewise._writing import checked_output_file
from probewise.arm import read_geometry, shipped_geometry_path
from probewise.cli._bench import world_and_scale
from probewise.cli._common import print_result, say
from probewise.errors import LinkError, ParameterError


def run(arguments: argparse.Namespace) -> int:
    """Emulate the LEGO brick until Ctrl-C, or until it goes to sleep; return the exit status."""
    if not hasattr(os, "openpty"):
        raise LinkError("emulate-nxt needs pseudo-terminals, which Linux, macOS and WSL have and this system lacks")
    from probewise.emulator.radio import Terminal, serve

    taken = (arguments.sensor, arguments.geometry, arguments.link)
    log = arguments.log and checked_output_file(arguments.log, *taken, option="--log")
    file = arguments.geometry or shipped_geometry_path()
    read_geometry(file)  # the emulator takes numbers from a file without a fault
    geometry = emulator.read_geometry(file)
    surface = emulator.parse_scene(arguments.scene)
    faults = emulator.Faults.parse(arguments.fault)
    world, _ = world_and_scale(arguments.sensor)
    with Terminal(arguments.link) as terminal, _telegram_log(log) as trace:  # nothing is emptied before a refusal
        bench = emulator.set_up_bench(
            geometry,
            world,
            surface,
            time.monotonic,
            seed=arguments.seed,
            faults=faults,
            sleep_min=arguments.sleep,
            trace=trace,
        )
        print_result(terminal.path)
        scene = f"seed {arguments.seed}, scene {arguments.scene}"
        say(arguments, f"{scene}; type another, `turn DEGREES` or `where`; end with Ctrl-C")
        with reporting_what_is_kept(lambda: "the device is gone"):
            serve(terminal, bench.radio, time.monotonic, on_move=print_result, meanwhile=_TypedCommands(bench).poll)
    say(arguments, f"the brick went to sleep after {arguments.sleep} minutes without KEEPALIVE")
    return 0


class _TypedCommands:
    """The typed commands of the bench (a scene, `turn DEGREES`, `where`), and a watch on the sensor's height."""

    def __init__(self, bench: emulator.EmulatedBench) -> None:
        self._bench, self._typed, self._is_heard = bench, b"", sys.stdin is not None
        self._is_in_table = False

    def poll(self) -> None:
        """Execute the lines typed so far, if it is in the foreground; report if the sensor went through the table."""
        stand = self._bench.arm.sensor_pose()
        if (stand.height_mm < 0) is not self._is_in_table:
            self._is_in_table = stand.height_mm < 0
            event = "the sensor went through" if self._is_in_table else "it came out of"
            print_result(f"{event} the table: {_position_in_words(stand)}")
        while self._is_heard and select.select([0], [], [], 0)[0] and _is_foreground():
            typed = os.read(0, 4096)
            self._is_heard = bool(typed)
            *lines, self._typed = (self._typed + typed).split(b"\n")
            for line in (line.decode(errors="replace") for line in lines):
                try:
                    if line.strip() != "where":
                        self._bench.table.carry_out_line(line)
                    print_result(_position_in_words(stand) if line.strip() == "where" else f"done: {line}")
                except ParameterError as error:
                    print_result(str(error))


def _position_in_words(stand: emulator.SensorPose) -> str:
    return f"sensor at ({stand.x_mm:.1f}, {stand.y_mm:.1f}) mm, {stand.height_mm:.1f} mm above the table"


def _is_foreground() -> bool:
    try:
        return not os.isatty(0) or os.tcgetpgrp(0) == os.getpgrp()
    except OSError:
        return True  # not a controlling terminal


@contextlib.contextmanager
def _telegram_log(path: Path | None) -> Iterator[emulator.Trace]:
    """Yield a function that writes a line per telegram or fault to the file, or nowhere without one."""
    began_s = time.monotonic()
    with open(path or os.devnull, "w", encoding="utf-8", buffering=1) as file:

        def write_line(now_s: float, event: str, text: str) -> None:
            file.write(f"{now_s - began_s:10.3f} {event} {text}\n")

        yield write_line
