"""`probewise emulate-nxt` as a person meets it: a process with a serial device."""

import contextlib
import os
import select
import signal
import time

import pytest

pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="this system has no pseudo-terminals")

LIMIT_S = 60.0

BATTERY, ANSWER = bytes.fromhex("02 00 00 0B"), bytes.fromhex("05 00 02 0B 00 F4 1C")


def exchanged(device, sent, expected, *, limit_s=10.0):
    """Open the device, write, and read so many bytes."""
    file = os.open(device, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(file, sent)
        got, deadline_s = b"", time.monotonic() + limit_s
        while len(got) < expected and (left_s := deadline_s - time.monotonic()) > 0:
            ready, _, _ = select.select([file], [], [], left_s)
            if ready:
                got += os.read(file, expected - len(got))
        return got
    finally:
        os.close(file)


def _made_ns(device):
    """Return when a pseudo-terminal was made, None if there is none; numbers are used again."""
    with contextlib.suppress(FileNotFoundError):
        return os.stat(device).st_ctime_ns
    return None


def test_clients_come_and_go_and_ctrl_c_ends_it(emulator, tmp_path):
    log = tmp_path / "log"
    with emulator("--log", str(log)) as running:
        for _ in range(3):
            assert exchanged(running.device, BATTERY, len(ANSWER)) == ANSWER
        info = exchanged(running.device, bytes.fromhex("02 00 01 9B"), 35)
        assert info[5:10] == b"NXT\0\0"
        made_ns = _made_ns(running.device)
        running.process.send_signal(signal.SIGINT)
        _, complaint = running.process.communicate(timeout=LIMIT_S)
        assert running.process.returncode == 130
        assert complaint.decode() == "probewise emulate-nxt: stopped; the device is gone\n"
        assert _made_ns(running.device) != made_ns
    lines = log.read_text(encoding="utf-8").splitlines()
    assert [line[11:] for line in lines[:2]] == ["> 00 0b  GETBATTERYLEVEL", "< 02 0b 00 f4 1c  GETBATTERYLEVEL"]
    assert len(lines) == 8


@pytest.mark.slow
def test_a_person_changes_the_scene_by_typing(emulator):
    with emulator() as running:
        running.process.stdin.write(b"uniform:0.5\ngremlins\n")
        assert running.line() == "done: uniform:0.5"
        assert "turn DEGREES" in running.line()
        running.process.stdin.close()
        assert exchanged(running.device, BATTERY, len(ANSWER)) == ANSWER


@pytest.mark.slow
def test_a_disconnection_takes_the_device_away_and_a_link_leads_to_the_new_one(emulator, tmp_path):
    link = tmp_path / "rfcomm0"
    with emulator("--link", str(link), "--fault", "disconnect=1") as running:
        assert running.device == str(link)
        before = os.path.realpath(link)
        file = os.open(link, os.O_RDWR | os.O_NOCTTY)
        os.write(file, BATTERY)
        deadline_s = time.monotonic() + 10
        while _is_there(file) and time.monotonic() < deadline_s:
            time.sleep(0.02)
        assert not _is_there(file)
        os.close(file)
        again = os.open(link, os.O_RDWR | os.O_NOCTTY)
        assert os.path.realpath(link) != before or _is_there(again)
        os.close(again)
        running.process.send_signal(signal.SIGINT)
        running.process.communicate(timeout=LIMIT_S)
    assert not link.is_symlink()


def _is_there(file):
    ready, _, _ = select.select([file], [], [], 0)
    try:
        return not ready or bool(os.read(file, 1))
    except OSError:
        return False
