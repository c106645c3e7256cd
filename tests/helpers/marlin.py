"""A 3-D printer that answers as Marlin does, and a light sensor on its head, each behind a pseudo-terminal.

Marlin 2 as its source has it (`queue.cpp`, `planner.cpp`, `endstops.cpp`): a line is taken if its number is the last
one's plus one and its checksum is right; else it says Error, Resend and ok. A move is put into a queue and answered by
ok at once; M400 is answered when the queue is empty, and until then busy is said now and then.
"""

import functools
import math
import operator
import os
import re
import select
import threading
import tty
from contextlib import ExitStack
from dataclasses import dataclass, field

BED_MM = (220.0, 220.0)
_NUMBERED = re.compile(r"N(-?\d+) (.*)\*(\d+)")
_WORD = re.compile(r"([A-Z])(-?\d+\.?\d*)")


class Terminal:
    """One end of a pseudo-terminal, served by a thread that hands every line, or byte, over."""

    def __init__(self, heard, until=b"\n"):
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._heard, self._until, self._ended = heard, until, threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def say(self, *lines):
        os.write(self._master, "".join(f"{line}\n" for line in lines).encode())

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    def _serve(self):
        held = b""
        while True:
            if not select.select([self._master], [], [], 0.01)[0]:
                if self._ended.is_set():  # and everything has been heard
                    return
                continue
            held += os.read(self._master, 4096)
            *whole, held = held.split(self._until)
            for each in whole:
                self._heard(each.decode(errors="replace").strip())


@dataclass
class Marlin:
    """The printer; faults come at the n-th line that it receives (from 1).

    `garble`: lines that arrive with a wrong checksum; `halt`: at which it kills itself; `deaf`: from which on it says
    nothing; `bumps_mm`: x beyond which a switch is hit, where endstops are heeded.
    """

    light: object
    garble: tuple = ()
    halt: int = 0
    deaf: int = 0
    bumps_mm: float = math.inf
    at_mm: tuple = (0.0, 0.0, 0.0)
    received: list = field(default_factory=list)
    obeyed: list = field(default_factory=list)
    read: list = field(default_factory=list)
    _queue: list = field(default_factory=list)
    _last: int = 0
    _heeds: bool = False

    def __enter__(self):
        self._open = ExitStack()
        self.line = self._open.enter_context(Terminal(self._take))
        self.sensor = self._open.enter_context(Terminal(self._measure, until=b"?"))
        self.line.say("start", "echo:Marlin 2.1.2", "echo:SD init fail")
        return self

    def __exit__(self, *_):
        self._open.close()

    def _measure(self, _):
        """Read where the head is now, not where queued moves will bring it."""
        x_mm, y_mm, height_mm = self.at_mm
        self.read.append((x_mm, y_mm))
        self.sensor.say(f"{self.light(x_mm, y_mm, height_mm):g}")

    def _take(self, text):
        self.received.append(text)
        n = len(self.received)
        if self.deaf and n >= self.deaf:
            return
        if n == self.halt:
            self.line.say("Error:Printer halted. kill() called!")
            return
        numbered = _NUMBERED.fullmatch(text)
        command = text
        if numbered:
            number, command, checksum = int(numbered[1]), numbered[2], int(numbered[3])
            right = functools.reduce(operator.xor, text.rpartition("*")[0].encode())
            if checksum != right or n in self.garble:
                return self._refuse("checksum mismatch")
            if number != self._last + 1 and not command.startswith("M110"):
                return self._refuse("Line Number is not Last Line Number+1")
            self._last = number
        self._obey(command)
        return None

    def _refuse(self, why):
        self.line.say(f"Error:{why}, Last Line: {self._last}", f"Resend: {self._last + 1}", "ok")

    def _obey(self, command):
        self.obeyed.append(command)
        name, words = command.split()[0], dict(_WORD.findall(command))
        if name == "G1":
            self._queue.append([float(words[axis]) if axis in words else None for axis in "XYZ"])
        elif name == "G28":
            self.at_mm = (0.0, 0.0, 0.0)
            self.line.say("echo:busy: processing", "X:0.00 Y:0.00 Z:0.00 E:0.00 Count X:0 Y:0 Z:0")
        elif name in ("M120", "M121"):
            self._heeds = name == "M120"
        elif name == "M110":
            self._last = int(words["N"])
        elif name == "M400":
            self.line.say("echo:busy: processing")
            for goal in self._queue:
                self.at_mm = tuple(here if to is None else to for here, to in zip(self.at_mm, goal, strict=True))
                if self._heeds and self.at_mm[0] > self.bumps_mm:
                    self.line.say(f"echo:endstops hit:  X:{self.at_mm[0]:.2f}")
            self._queue.clear()
        self.line.say("ok")
