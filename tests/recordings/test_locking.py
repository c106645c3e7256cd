"""A lock keeps other processes away, and ends with the process."""

import os
import signal
import subprocess
import sys

import pytest

from probewise.errors import FileError
from probewise.recordings import hold_lock, write_bytes_atomically

HOLD = """
import sys, time
from probewise._writing import hold_lock
with hold_lock(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_process_is_refused_and_a_killed_holder_holds_it_no_more(tmp_path):
    path = tmp_path / "journal.jsonl"
    with subprocess.Popen([sys.executable, "-c", HOLD, path], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(FileError, match=r"journal.jsonl: another process is writing to it"), hold_lock(path):
            pass
        other.send_signal(signal.SIGKILL if os.name != "nt" else signal.SIGTERM)
        other.wait()
    with hold_lock(path, patience_s=10):
        pass
    assert [p.name for p in tmp_path.iterdir()] == [".journal.jsonl.lock"]


def test_a_folder_that_is_missing_is_named(tmp_path):
    with pytest.raises(FileError, match=r"nowhere.*cannot be written"), hold_lock(tmp_path / "nowhere" / "a"):
        pass


def test_what_a_killed_writer_left_is_removed_by_the_next_and_what_a_living_one_holds_is_not(tmp_path):
    (tmp_path / ".a.01234567.part").write_text("half")
    (tmp_path / ".b.other.part").write_text("of another name")
    with (tmp_path / ".a.89abcdef.part").open("w") as living:
        if os.name != "nt":
            import fcntl

            fcntl.flock(living, fcntl.LOCK_EX)
        write_bytes_atomically(tmp_path / "a", b"whole")
        assert {p.name for p in tmp_path.iterdir()} == {"a", ".a.89abcdef.part", ".b.other.part"}
    write_bytes_atomically(tmp_path / "a", b"again")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"a": b"again", ".b.other.part": b"of another name"}


@pytest.mark.skipif(os.name == "nt", reason="Windows has links for administrators only")
def test_a_lock_file_that_is_a_symbolic_link_is_refused_and_where_it_leads_stays_as_it_is(tmp_path):
    (tmp_path / "victim").write_text("precious")
    for target in ("victim", "to be made"):
        (tmp_path / ".a.lock").unlink(missing_ok=True)
        (tmp_path / ".a.lock").symlink_to(tmp_path / target)
        with pytest.raises(FileError, match=r"\.a\.lock: cannot be locked \(is a sym"), hold_lock(tmp_path / "a"):
            pass
    assert {p.name for p in tmp_path.iterdir()} == {".a.lock", "victim"}
    assert (tmp_path / "victim").read_text() == "precious"
