"""The brick's bytes against vectors worked out by hand from LEGO's protocol, lengths in front included."""

import pytest

from probewise.emulator import Brick, empty_port
from probewise.emulator.motors import OutputSetting
from probewise.emulator.protocol import FrameAssembler, framed


class Fixed:
    """A sensor that gives a known number of counts."""

    def __init__(self, counts):
        self.value = counts

    def __call__(self, lit):
        return self.value


def exchanged(brick, sent):
    """Send a frame and return the frame that comes back."""
    (telegram,) = FrameAssembler().feed(bytes.fromhex(sent), 0.0)
    reply = brick.answer(telegram)
    return "" if reply is None else framed(reply).hex(" ").upper()


def zeros(n):
    return " 00" * n


PLAIN = {
    "SETINPUTMODE without reply": ("05 00 80 05 01 05 80", ""),
    "SETINPUTMODE with reply": ("05 00 00 05 01 05 80", "03 00 02 05 00"),
    "GETINPUTVALUES of no port": ("03 00 00 07 04", "10 00 02 07 C0" + zeros(13)),
    "SETOUTPUTSTATE without reply": ("0C 00 80 04 02 4B 07 01 00 20 5A 00 00 00", ""),
    "SETOUTPUTSTATE with reply": ("0C 00 00 04 02 D8 05 01 00 20 E8 03 00 00", "03 00 02 04 00"),
    "all motors coast": ("0C 00 80 04 FF 00 00 00 00 00 00 00 00 00", ""),
    "hold": ("0C 00 80 04 01 00 07 01 00 20 00 00 00 00", ""),
    "SETOUTPUTSTATE of no port": ("0C 00 00 04 03 0A 01 00 00 20 00 00 00 00", "03 00 02 04 C0"),
    "GETOUTPUTSTATE of no port": ("03 00 00 06 07", "19 00 02 06 C0" + zeros(22)),
    "RESETMOTORPOSITION": ("04 00 00 0A 02 00", "03 00 02 0A 00"),
    "GETBATTERYLEVEL": ("02 00 00 0B", "05 00 02 0B 00 F4 1C"),
    "PLAYTONE": ("06 00 80 03 70 03 96 00", ""),
    "a command for files": ("16 00 01 80 61 2E 62" + zeros(17), "03 00 02 80 BE"),
    "KEEPALIVE": ("02 00 00 0D", "07 00 02 0D 00 C0 27 09 00"),
    "GETCURRENTPROGRAMNAME without one": ("02 00 00 11", "17 00 02 11 EC" + zeros(20)),
    "GETFIRMWAREVERSION": ("02 00 01 88", "07 00 02 88 00 7C 01 1F 01"),
    "GETDEVICEINFO": (
        "02 00 01 9B",
        "21 00 02 9B 00 4E 58 54" + zeros(12) + " 00 16 53 0A 0B 0C 00" + zeros(4) + " 00 F0 00 00",
    ),
    "an unknown opcode": ("02 00 00 55", "03 00 02 55 BE"),
    "a direct opcode asked for as a system one": ("02 00 01 0B", "03 00 02 0B BE"),
    "a telegram cut short": ("03 00 00 04 02", "03 00 02 04 BF"),
    "a reply, which nobody asked the brick for": ("03 00 02 0B 00", ""),
    "a stump": ("01 00 00", ""),
}


@pytest.mark.parametrize("name", PLAIN)
def test_bytes_are_answered_with_bytes(brick, name):
    sent, expected = PLAIN[name]
    assert exchanged(brick, sent) == expected


@pytest.mark.parametrize(
    ("wait_s", "kind", "mode", "counts", "expected"),
    [
        (0.1, "05", "80", 512, "10 00 02 07 00 01 01 00 05 80 00 02 35 02 37 00 35 02"),
        (0.0, "06", "00", 640, "10 00 02 07 00 01 00 00 06 00 80 02 78 01 78 01 78 01"),
    ],
)
def test_input_values_are_laid_out_as_in_the_vectors(clock, wait_s, kind, mode, counts, expected):
    """512 counts: t = (512-200)*100//68 = 458, 1023 - 458 = 565, 55 %; 640 counts: 376, shown while invalid."""
    brick = Brick(clock, sensors=[empty_port, Fixed(counts), empty_port, empty_port])
    brick.answer(bytes.fromhex("80 05 01 05 00"))
    clock.sleep(0.1)
    exchanged(brick, f"05 00 80 05 01 {kind} {mode}")
    clock.sleep(wait_s)
    assert exchanged(brick, "03 00 00 07 01") == expected


def test_output_state_is_laid_out_as_in_the_vectors(brick):
    port = brick.outputs.ports[2]
    port.apply_setting(OutputSetting(-40, 5, 1, 0, 0x20, 1000))
    port.tacho_count = port.block_count = -123
    port.rotation_count = 4567
    assert exchanged(brick, "03 00 00 06 02") == (
        "19 00 02 06 00 02 D8 05 01 00 20 E8 03 00 00 85 FF FF FF 85 FF FF FF D7 11 00 00"
    )


def test_frames_come_in_any_pieces():
    stream = framed(b"\x00\x0b") + framed(b"\x01\x88") + framed(b"")
    for size in range(1, len(stream) + 1):
        frames = FrameAssembler()
        pieces = [stream[at : at + size] for at in range(0, len(stream), size)]
        assert [t for piece in pieces for t in frames.feed(piece, 0.0)] == [b"\x00\x0b", b"\x01\x88", b""]


def test_half_a_frame_is_forgotten_after_a_silence_however_often_somebody_looks_for_the_rest():
    """A terminal is read every 50 ms, mostly in vain."""
    for looks in ((), range(1, 20)):
        frames = FrameAssembler()
        assert not list(frames.feed(b"\x0c\x00\x00\x04", 0.0))
        for k in looks:
            assert not list(frames.feed(b"", 0.05 * k))
        assert list(frames.feed(framed(b"\x00\x0b"), 1.0)) == [b"\x00\x0b"]
