"""The LEGO NXT brick over Bluetooth: telegrams, their line, motors and light sensor (paper, "Robotic Arm Test Bed").

Telegrams are pure values and bytes; the link sends and receives them; motor, light sensor and brick are the high-level
interface. Each layer can be used and tested without those above it.
"""

from probewise.arm.nxt.brick import Brick, BrickMachine
from probewise.arm.nxt.light import LightSensor, SensorError, normalized_from_counts, percent_from_counts
from probewise.arm.nxt.link import ByteStream, Link, NoAnswerError, SerialPort, Timing
from probewise.arm.nxt.motor import DriveParameters, Guard, Motor, MotorError
from probewise.arm.nxt.telegram import BrickError, Reply, Request, TelegramError, decode, encode, framed

__all__ = [
    "Brick",
    "BrickError",
    "BrickMachine",
    "ByteStream",
    "DriveParameters",
    "Guard",
    "LightSensor",
    "Link",
    "Motor",
    "MotorError",
    "NoAnswerError",
    "Reply",
    "Request",
    "SensorError",
    "SerialPort",
    "TelegramError",
    "Timing",
    "decode",
    "encode",
    "framed",
    "normalized_from_counts",
    "percent_from_counts",
]
