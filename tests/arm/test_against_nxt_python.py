"""Our telegrams against somebody else's client: it sends what we send, and both read the same bytes alike."""

import pytest

from probewise.arm.nxt import decode, encode
from probewise.arm.nxt import telegram as t

pytest.importorskip("nxt", reason="nxt-python is not installed: pip install nxt-python")

from nxt import motor, sensor
from nxt.brick import Brick

RUN = motor.Mode.ON | motor.Mode.REGULATED
DONE = ""

# What it is asked to do, the command that it should send, the body of the brick's answer, what it should understand.
CALLS = [
    (
        lambda b: b.set_output_state(
            motor.Port.C, -40, RUN, motor.RegulationMode.SPEED, 0, motor.RunState.RUNNING, 1000
        ),
        t.SetOutputState(2, -40, 5, 1, 0, 0x20, 1000),
        DONE,
        lambda said: None,
    ),
    (
        lambda b: b.get_output_state(motor.Port.C),
        t.GetOutputState(2),
        "02 D8 05 01 00 20 E8 03 00 00 85 FF FF FF 84 FF FF FF D7 11 00 00",
        lambda said: (
            motor.Port(said.port),
            said.power,
            motor.Mode(said.mode),
            motor.RegulationMode(said.regulation),
            said.turn_ratio,
            motor.RunState(said.run_state),
            said.limit_counts,
            said.tacho_counts,
            said.block_counts,
            said.rotation_counts,
        ),
    ),
    (
        lambda b: b.set_input_mode(sensor.Port.S2, sensor.Type.LIGHT_INACTIVE, sensor.Mode.RAW),
        t.SetInputMode(1, 6, 0),
        DONE,
        lambda said: None,
    ),
    (
        lambda b: b.get_input_values(sensor.Port.S2)[5:],
        t.GetInputValues(1),
        "01 01 00 05 80 00 02 35 02 37 00 35 02",
        lambda said: (said.raw, said.normalized, said.scaled, said.calibrated_value),
    ),
    (
        lambda b: b.reset_motor_position(motor.Port.C, False),
        t.ResetMotorPosition(2, 0),
        DONE,
        lambda said: None,
    ),
    (lambda b: b.get_battery_level(), t.GetBatteryLevel(), "F4 1C", lambda said: said.millivolt),
    (lambda b: b.keep_alive(), t.KeepAlive(), "C0 27 09 00", lambda said: said.limit_ms),
    (
        lambda b: b.get_current_program_name(),
        t.GetCurrentProgramName(),
        "61 72 6D 2E 72 78 65" + 13 * " 00",
        lambda said: said.file,
    ),
    (
        lambda b: b.get_firmware_version(),
        t.GetFirmwareVersion(),
        "7C 01 1F 01",
        lambda said: ((said.protocol_major, said.protocol_minor), (said.firmware_major, said.firmware_minor)),
    ),
    (
        lambda b: b.get_device_info()[0],
        t.GetDeviceInfo(),
        "41 52 4D 31" + 11 * " 00" + " 00 16 53 0A 0B 0C 00" + 4 * " 00" + " 00 F0 00 00",
        lambda said: said.brick_name,
    ),
]


class Socket:
    """A line on which every telegram is answered with the same body."""

    type, bsize = "bluetooth", 118

    def __init__(self, body):
        self.body, self.sent = body, []

    def send(self, telegram):
        self.sent.append(bytes(telegram))

    def recv(self):
        return bytes([2, self.sent[-1][1], 0]) + self.body

    def close(self):
        pass


@pytest.mark.parametrize(("call", "command", "body", "ours"), CALLS, ids=[c[1].name for c in CALLS])
def test_both_say_and_hear_the_same(call, command, body, ours):
    socket = Socket(bytes.fromhex(body))
    heard = call(Brick(socket))
    (sent,) = socket.sent
    assert encode(command, wants_reply=not sent[0] & 0x80) == sent
    assert ours(command.decode_answer(decode(bytes([2, command.OPCODE, 0]) + socket.body))) == heard


def test_every_command_was_compared():
    assert {type(command) for _, command, _, _ in CALLS} == set(t.Request.__subclasses__())
