"""Our telegrams against somebody else's client: it writes what we read, and reads what we write."""

import pytest

from probewise.arm.nxt import Reply, Sent, decode, encode
from probewise.arm.nxt import telegram as t

pytest.importorskip("nxt", reason="nxt-python is not installed: pip install 'probewise[test]'")

from nxt import motor, sensor
from nxt.brick import Brick

STATE = t.OutputState(2, -40, 5, 1, 0, 0x20, 1000, -123, -124, 4567)
VALUES = t.InputValues(1, 1, 0, 5, 0x80, 512, 565, 55, 565)
RUN = motor.Mode.ON | motor.Mode.REGULATED

# What it is asked to do, the command that it should send, our answer to it, what it should understand.
CALLS = [
    (
        lambda b: b.set_output_state(
            motor.Port.C, -40, RUN, motor.RegulationMode.SPEED, 0, motor.RunState.RUNNING, 1000
        ),
        t.SetOutputState(2, -40, 5, 1, 0, 0x20, 1000),
        t.Done(),
        None,
    ),
    (
        lambda b: b.get_output_state(motor.Port.C),
        t.GetOutputState(2),
        STATE,
        (motor.Port.C, -40, RUN, motor.RegulationMode.SPEED, 0, motor.RunState.RUNNING, 1000, -123, -124, 4567),
    ),
    (
        lambda b: b.set_input_mode(sensor.Port.S2, sensor.Type.LIGHT_INACTIVE, sensor.Mode.RAW),
        t.SetInputMode(1, 6, 0),
        t.Done(),
        None,
    ),
    (lambda b: b.get_input_values(sensor.Port.S2)[5:], t.GetInputValues(1), VALUES, (512, 565, 55, 565)),
    (lambda b: b.reset_input_scaled_value(sensor.Port.S1), t.ResetInputScaledValue(0), t.Done(), None),
    (lambda b: b.reset_motor_position(motor.Port.C, False), t.ResetMotorPosition(2, 0), t.Done(), None),
    (lambda b: b.get_battery_level(), t.GetBatteryLevel(), t.BatteryLevel(7412), 7412),
    (lambda b: b.keep_alive(), t.KeepAlive(), t.SleepLimit(600000), 600000),
    (lambda b: b.play_tone(880, 150), t.PlayTone(880, 150), t.Done(), None),
    (lambda b: b.stop_sound_playback(), t.StopSoundPlayback(), t.Done(), None),
    (lambda b: b.ls_get_status(sensor.Port.S4), t.LsGetStatus(3), t.LsStatus(1), 1),
    (lambda b: b.ls_write(sensor.Port.S4, b"\x02\x42", 1), t.LsWrite(3, 1, b"\x02\x42"), t.Done(), None),
    (lambda b: b.ls_read(sensor.Port.S4), t.LsRead(3), t.LsData(b"\x2a"), b"\x2a"),
    (lambda b: b.message_write(5, b"go"), t.MessageWrite(5, b"go\0"), t.Done(), None),
    (lambda b: b.message_read(12, 2, True), t.MessageRead(12, 2, 1), t.Message(2, b"ok\0"), (2, b"ok\0")),
    (lambda b: b.start_program("arm.rxe"), t.StartProgram("arm.rxe"), t.Done(), None),
    (lambda b: b.stop_program(), t.StopProgram(), t.Done(), None),
    (lambda b: b.get_current_program_name(), t.GetCurrentProgramName(), t.ProgramName("arm.rxe"), "arm.rxe"),
    (
        lambda b: b.get_firmware_version(),
        t.GetFirmwareVersion(),
        t.FirmwareVersion(124, 1, 31, 1),
        ((1, 124), (1, 31)),
    ),
    (
        lambda b: (b.get_device_info()[:2], b.get_device_info()[3]),
        t.GetDeviceInfo(),
        t.DeviceInfo("ARM1", bytes.fromhex("0016530A0B0C00"), bytes(4), 61440),
        (("ARM1", "00:16:53:0A:0B:0C"), 61440),
    ),
    (lambda b: b.set_brick_name("ARM1"), t.SetBrickName("ARM1"), t.Done(), None),
]


class Socket:
    """A line on which our codec answers."""

    type, bsize = "bluetooth", 118

    def __init__(self, answer):
        self.answer, self.sent = answer, []

    def send(self, telegram):
        self.sent.append(bytes(telegram))

    def recv(self):
        return Reply(self.sent[-1][1], 0, self.answer.pack()).pack()

    def close(self):
        pass


@pytest.mark.parametrize(("call", "command", "answer", "understood"), CALLS, ids=[c[1].name for c in CALLS])
def test_both_say_and_hear_the_same(call, command, answer, understood):
    socket = Socket(answer)
    heard = call(Brick(socket))
    if understood is not None:
        assert heard == understood
    said = decode(socket.sent[0])
    assert isinstance(said, Sent)
    assert said.request == command
    if not isinstance(command, t.SetBrickName):  # a name has a shorter field there; both work on bricks
        assert encode(command, wants_reply=said.wants_reply) == socket.sent[0]


def test_every_command_was_compared():
    assert {type(command) for _, command, _, _ in CALLS} == set(t.REQUESTS.values())
