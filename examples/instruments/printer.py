"""A 3-D printer as an arm: its gantry by G-code on one serial port, a light sensor that answers "?" on another.

probewise arm scan 20,110 200,110 --arm printer.py
probewise explore --sensor my_sensor/sensor.json --arm printer.py --field 220,220 --out found
"""

import functools
import operator
import time

import numpy as np
import serial  # pip install pyserial

PRINTER, SENSOR = "/dev/ttyUSB0", "/dev/ttyACM0"
BED_MM, HEIGHT_MM = (220.0, 220.0), 12.0  # where the head may go, and how high it reads
SPEED_MM_S, READ_S = 100.0, 0.3
RESTART_S, PATIENCE_S, TRIES = 3.0, 10.0, 4  # a board restarts when its port is opened; busy ones say so in time


def connect():
    return Printer(serial.Serial(PRINTER, 115200, timeout=PATIENCE_S), serial.Serial(SENSOR, 9600, timeout=2.0))


class Printer:
    def __init__(self, line, light):
        self.line, self.light, self.number = line, light, -1
        time.sleep(RESTART_S)
        line.reset_input_buffer()  # what a board says when it starts
        for command in ("M110 N0", "G28", "G90", "M120", f"G1 Z{HEIGHT_MM} F600", "M400"):
            self.send(command)  # count lines from 0, home, heed endstops from now on, go up

    def send(self, command):
        """Send a numbered line with its checksum until the printer has taken it."""
        self.number += 1
        text = f"N{self.number} {command}"
        checksum = functools.reduce(operator.xor, text.encode())
        for _ in range(TRIES):
            self.line.write(f"{text}*{checksum}\n".encode())
            if self.is_taken(command):
                return
        raise ConnectionError(f"the printer does not understand {command!r}; a cable?")

    def is_taken(self, command):
        again = False
        while not (answer := self.line.readline().decode(errors="replace").strip()).startswith("ok"):
            if not answer:
                raise TimeoutError(f"the printer does not answer {command!r} within {PATIENCE_S:g} s")
            if answer.startswith("Resend:"):
                again = True
            elif "endstops hit" in answer or (answer.startswith("Error") and "Last Line" not in answer):
                raise RuntimeError(f"the printer says {answer!r} to {command!r}")
        return not again

    def measure(self, pose):
        self.send(f"G1 X{pose.x_mm:.2f} Y{pose.y_mm:.2f} F{60 * SPEED_MM_S:g}")
        self.send("M400")  # it says ok when it is there
        self.light.reset_input_buffer()
        self.light.write(b"?")
        return float(self.light.readline())

    def reachable(self, places_mm):
        return ((places_mm >= 0) & (places_mm <= BED_MM)).all(axis=1)

    def travel_s(self, start, places_mm):
        return np.hypot(*(places_mm - (start.x_mm, start.y_mm)).T) / SPEED_MM_S + READ_S

    def close(self):
        self.line.write(b"M84\n")  # motors off; whatever is said to it
        self.line.close()
        self.light.close()
