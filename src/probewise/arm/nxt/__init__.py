"""The LEGO NXT brick over Bluetooth: telegrams, their line, motors and light sensor (paper, "Robotic Arm Test Bed").

Telegrams are pure values and bytes; the link sends and receives them; motor, light sensor and brick are the high-level
interface. Each layer can be used and tested without those above it.
"""

from probewise.arm.nxt.brick import (
    Brick,
    BrickMachine,
    LightSensor,
    SensorError,
    normalized_from_counts,
    percent_from_counts,
)
from probewise.arm.nxt.link import Link, NoAnswerError, SerialPort
from probewise.arm.nxt.motor import DriveParameters, Motor, MotorError
from probewise.arm.nxt.telegram import BrickError, Reply, TelegramError, decode, encode, framed

__all__ = [
    "Brick",
    "BrickError",
    "BrickMachine",
    "DriveParameters",
    "LightSensor",
    "Link",
    "Motor",
    "MotorError",
    "NoAnswerError",
    "Reply",
    "SensorError",
    "SerialPort",
    "TelegramError",
    "decode",
    "encode",
    "framed",
    "normalized_from_counts",
    "percent_from_counts",
]
