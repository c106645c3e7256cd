"""The brick and the arm wired to it: motors, light sensor, battery; at the end all motors stop and LEDs go off.

The light sensor is LEGO's 9844, whose A/D counts are converted as in the brick's firmware.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Sequence
from functools import partial
from types import TracebackType
from typing import Self

from probewise._signals import defer_signals
from probewise.arm.geometry import ROOM_COUNTS, Geometry, SoftLimits
from probewise.arm.instrument import Clock, Side
from probewise.arm.nxt import telegram as nxt
from probewise.arm.nxt.link import Link, SerialPort
from probewise.arm.nxt.motor import Guard, Motor
from probewise.errors import LinkError, LowBatteryWarning, require, warn

AD_MAX = 1023
N_INVALID = 3  # least number of attempts, since one may use up the allowed time on a slow connection
_VALID_S = 1.0
_BRIGHT_COUNTS = 200  # 800 mV of 5000 mV in the firmware's integer arithmetic: 5 V is 1023 counts
_SPAN_PERCENT = 68  # share of the converter's range between bright and dark, in percent


class SensorError(LinkError):
    """Raised for a sensor that gives no usable reading."""


def normalized_from_counts(raw_counts: int) -> int:
    """Convert A/D counts, 0 to 1023 (else ParameterError), which fall with brightness, to 0 (dark) to 1023 (bright).

    The firmware's integer arithmetic for types 05 and 06: only 697 of the 1024 values occur.
    """
    require(0 <= raw_counts <= AD_MAX, "raw_counts", raw_counts, f"0 to {AD_MAX}")
    dark = max(raw_counts - _BRIGHT_COUNTS, 0) * 100 // _SPAN_PERCENT
    return AD_MAX - min(dark, AD_MAX)


def percent_from_counts(raw_counts: int) -> float:
    """Convert A/D counts to percent, 0 (dark) to 100 (bright), about seven steps per percent."""
    return normalized_from_counts(raw_counts) * 100 / AD_MAX


class LightSensor:
    """A light sensor at one of the brick's inputs, 0 to 3 for 1 to 4, read in RAW mode: A/D counts.

    While the brick marks a reading as invalid, the read is repeated for a second, three times at least.
    """

    def __init__(self, link: Link, port: int, *, clock: Clock = time) -> None:
        self._link, self.port, self._clock = link, port, clock
        self._type: int | None = None

    def set_led(self, lit: bool = True) -> None:
        """Switch the LED on (`lit`) or off, and set the input to raw readings."""
        self._type = nxt.LED_ON if lit else nxt.LED_OFF
        self._link.ask(nxt.set_input_type(self.port, self._type))

    def flash(self) -> int:
        """Light the LED for one reading, as in the paper: it is at the same temperature in all of them.

        The reading is the first that the brick marks as valid, 20 ms or more after the LED came on. A lost connection
        afterwards does not lose it. Raises as `read` does.
        """
        self.set_led()
        try:
            return self.read()
        finally:
            self._type = None
            with contextlib.suppress(LinkError):
                self._link.tell(self.off_command)

    def read(self) -> int:
        """Read once, with the LED as last set (by default on).

        Raises SensorError if the brick marks every reading as invalid, TelegramError if its answers remain
        inconsistent.
        """
        if self._type is None:
            self.set_led()
        deadline = self._clock.monotonic() + _VALID_S
        number = 0
        while True:
            number += 1
            values = self._link.ask(nxt.get_input_values(self.port), check=_require_consistent)
            as_set = (values.type, values.mode) == (self._type, nxt.RAW)
            # An invalid reading still holds the old values.
            if as_set and values.valid:
                return values.raw
            if number >= N_INVALID and self._clock.monotonic() > deadline:
                raise SensorError(
                    f"input {self.port + 1} gave no valid reading for {_VALID_S:g} s; is the light sensor plugged in?"
                )
            if not as_set:  # a program that starts or stops resets all settings
                self.set_led(self._type == nxt.LED_ON)

    @property
    def off_command(self) -> nxt.Request[None]:
        """The command that switches the LED off and unconfigures the input."""
        return nxt.set_input_type(self.port, nxt.NO_SENSOR)


def _require_consistent(values: nxt.InputValues) -> None:
    """Raise TelegramError if counts and converted values contradict each other: a byte was corrupted on the way.

    The protocol has no checksum, but the firmware sends each reading four times, as counts and converted.
    """
    possible = values.valid in (0, 1) and not values.calibrated and values.raw <= AD_MAX
    if possible and values.valid and values.type in (nxt.LED_ON, nxt.LED_OFF) and values.mode == nxt.RAW:
        converted = {values.normalized, values.scaled, values.calibrated_value}
        possible = converted == {normalized_from_counts(values.raw)}
    if not possible:
        raise nxt.TelegramError(
            f"input {values.port + 1} says {values}: counts and converted values contradict each other"
        )


LOW_MV = 6000
"""Voltage below which six cells are nearly empty: motors slow down, and the brick soon switches itself off."""

STEP_MV = 50  # largest plausible change of the battery's voltage between two questions
N_ASKED = 6
NO_PROGRAM = 0xEC


class Brick:
    """A LEGO NXT; a `with` block, at its end, releases the motors, switches the LEDs off and disconnects."""

    def __init__(self, link: Link, *, clock: Clock = time) -> None:
        self.link, self._clock = link, clock
        self._lights: dict[int, LightSensor] = {}
        self._last_mv: int | None = None
        self._told_low = False

    @classmethod
    def open(cls, path: str) -> Self:
        """Return the brick at a serial port, opened here: /dev/rfcomm0, COM5, a pseudo-terminal."""
        return cls(Link(SerialPort.open(path)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop and release the motors, switch the LEDs off and close the connection; signals are deferred until then.

        Raises LinkError if this could not be confirmed, and no other exception is pending.
        """
        with defer_signals():
            try:
                self._switch_off_motors_and_leds()
            except LinkError:
                if error is None:
                    raise
            finally:
                self.link.close()

    def motor(self, port: int, *, guard: Guard | None = None) -> Motor:
        """Make the motor at port 0 to 2; see `Motor`."""
        return Motor(self.link, port, guard=guard, clock=self._clock)

    def light_sensor(self, port: int) -> LightSensor:
        """Return the light sensor at input 0 to 3, the same object at every call; see `LightSensor`."""
        return self._lights.setdefault(port, LightSensor(self.link, port, clock=self._clock))

    def battery_mv(self) -> int:
        """Read the battery's voltage, in mV; warn once (LowBatteryWarning) if it is below 6 V.

        Since the protocol has no checksum, the voltage is read until two successive values agree within 50 mV. Raises
        LinkError if the brick does not answer, or no two of six successive voltages agree.
        """
        for _ in range(N_ASKED):
            before, self._last_mv = self._last_mv, self.link.ask(nxt.GET_BATTERY_LEVEL)
            if before is not None and abs(self._last_mv - before) <= STEP_MV:
                break
        else:
            raise LinkError(
                f"the NXT on {self.link.name} reports another battery voltage each of {N_ASKED} times; is it near?"
            )
        if self._last_mv < LOW_MV and not self._told_low:
            self._told_low = True
            warn(
                f"the NXT's battery is at {self._last_mv / 1000:.2f} V, below {LOW_MV / 1000:g} V: motors slow down, "
                "and the brick may switch itself off; change or charge it",
                LowBatteryWarning,
            )
        return self._last_mv

    def name(self) -> str:
        """Return the brick's name."""
        return self.link.ask(nxt.GET_DEVICE_INFO)

    def version(self) -> nxt.FirmwareVersion:
        """Return the versions of the brick's firmware and protocol."""
        return self.link.ask(nxt.GET_FIRMWARE_VERSION)

    def running_program(self) -> str | None:
        """Return the file name of the program running on the brick, which could drive motors and sensors, or None."""
        try:
            return self.link.ask(nxt.GET_CURRENT_PROGRAM_NAME)
        except nxt.BrickError as error:
            if error.status == NO_PROGRAM:
                return None
            raise

    def _switch_off_motors_and_leds(self) -> None:
        """Release the motors and switch the LEDs off, each even if another fails; then raise the last LinkError.

        First send all commands without asking for answers, which may be missing or late; then send them with answers.
        """
        commands: list[nxt.Request[None]] = [
            nxt.set_output_state(nxt.ALL_OUTPUTS),
            *(light.off_command for light in self._lights.values()),
        ]
        failures = []
        for send in (self.link.tell, self.link.ask):
            for command in commands:
                try:
                    send(command)
                except LinkError as error:
                    failures.append(error)
        if failures:
            raise failures[-1]


class BrickMachine:
    """A brick wired as in the arm's geometry: three motors and a light sensor, the machine of a `LegoArm`.

    Joints 0 to 2 are base, shoulder and elbow. `move_to` approaches a count with the count rising (side 1) or falling
    (-1), `move_near` reaches it approximately; both then hold the motor. `find_stop` turns a joint gently to its stop,
    with the angle rising or falling; its count becomes `stop_counts`. The light is read with the LED on, 0 to 100.
    """

    def __init__(self, brick: Brick, geometry: Geometry) -> None:
        self.brick = brick
        self.limits = SoftLimits(geometry)
        self._joints = geometry.joints
        self._zeros = [0] * 3  # counts at home; not 0 between finding a stop and the next reset
        self._motors = [
            brick.motor(joint.port, guard=partial(self._require_allowed_move, k))
            for k, joint in enumerate(self._joints)
        ]
        self._light = brick.light_sensor(geometry.sensor_port)

    def __enter__(self) -> Self:
        self.brick.__enter__()
        try:
            for joint, motor in enumerate(self._motors):
                # An earlier session that lost its connection may have left a motor turning.
                self.limits.record_present_count(joint, motor.stop_and_settle())
        except BaseException as error:
            self.brick.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop and release the motors."""
        self.brick.__exit__(kind, error, trace)

    def move_to(self, joint: int, goal: int, side: Side) -> None:
        with self._recording_counts(joint) as motor:
            motor.move_to(goal + self._zeros[joint], side)

    def move_near(self, joint: int, goal: int) -> None:
        with self._recording_counts(joint) as motor:
            motor.move_near(goal + self._zeros[joint])

    def release(self) -> None:
        for motor in self._motors:
            motor.release()

    def find_stop(self, joint: int, side: Side) -> None:
        mechanics = self._joints[joint]
        motor = self._motors[joint]
        with_gears: Side = side if mechanics.gear_ratio > 0 else -side
        at_stop = mechanics.stop_counts
        far_limit_rad = mechanics.low_rad if side > 0 else mechanics.high_rad
        range_counts = (mechanics.high_rad - mechanics.low_rad) * abs(mechanics.counts_per_rad)
        way_counts = abs(at_stop - mechanics.counts_at(far_limit_rad))  # more, if the stop is well beyond its limit
        found = motor.find_stop(with_gears, max(round(range_counts) + 2 * ROOM_COUNTS, way_counts + ROOM_COUNTS))
        self._zeros[joint] = found - at_stop
        self.limits.record_present_count(joint, at_stop)

    def reset(self, joints: Sequence[int]) -> None:
        for joint in joints:
            self._motors[joint].reset_counter()
            self._zeros[joint] = 0
            self.limits.record_present_count(joint, 0)

    def read_percent(self) -> float:
        return percent_from_counts(self._light.flash())

    def battery_mv(self) -> float:
        return self.brick.battery_mv()

    def keep_awake(self) -> None:
        self.brick.link.keep_awake()

    @contextlib.contextmanager
    def _recording_counts(self, joint: int) -> Iterator[Motor]:
        """Yield a joint's motor, then record its last count in `limits`, also after a failed move."""
        motor = self._motors[joint]
        try:
            yield motor
        finally:
            self.limits.record_present_count(joint, motor.last_counts - self._zeros[joint])

    def _require_allowed_move(self, joint: int, here: int, to: int) -> None:
        self.limits.require_allowed_move(joint, here - self._zeros[joint], to - self._zeros[joint])
