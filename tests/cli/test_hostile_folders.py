"""What lies outside the folder of its results is none of a command's business, whatever that folder holds."""

import os
import stat
import subprocess
import sys
import threading

import pytest
from command import content_of, refused, run
from heater import fitted

from probewise._writing import checked_output_file, staged_output
from probewise.errors import FileError
from probewise.recordings import read_recording, write_bytes_atomically, write_recording

pytestmark = pytest.mark.skipif(os.name == "nt", reason="Windows has no named pipes, and links for administrators only")


def nested(out):
    """Folders in folders, 1,100 deep: too deep for a program that descends by calling itself."""
    at = out / ".probewise-complete"
    at.mkdir()
    handle = os.open(at, os.O_RDONLY)
    for _ in range(1100):
        os.mkdir("d", dir_fd=handle)
        inner = os.open("d", os.O_RDONLY, dir_fd=handle)
        os.close(handle)
        handle = inner
    os.close(handle)


def linked(name, target="../outside"):
    def build(out):
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).symlink_to(out / target)

    return build


def complete(*names):
    def build(out):
        for name in names:
            (out / ".probewise-complete" / name).parent.mkdir(parents=True, exist_ok=True)
            (out / ".probewise-complete" / name).write_text("x")

    return build


def through_link(out):
    complete("sub/victim.txt")(out)
    linked("sub")(out)


FOLDERS = {
    "staged in a link": linked(".probewise-writing"),
    "complete in a link": linked(".probewise-complete"),
    "a link among the complete": linked(".probewise-complete/d"),
    "a link to a file among the complete": linked(".probewise-complete/report.html", "../outside/victim.txt"),
    "a folder that is a link": through_link,
    "a folder that is a file": lambda out: [complete("sub/a")(out), (out / "sub").touch()],
    "a list that is a folder": lambda out: (out / ".probewise-written").mkdir(),
    "complete in itself": complete(".probewise-complete/a", ".probewise-writing/b", ".results.lock"),
    "a result that is a link": linked("report.html", "../outside/victim.txt"),
    "a lock that is a link": linked(".results.lock", "../outside/victim.txt"),
    "a pipe": lambda out: os.mkfifo(out / ".probewise-complete"),
    "a pipe as a result": lambda out: os.mkfifo(out / "report.html"),
    "a circle of links": lambda out: [linked("report.html", "report.html")(out), linked("a.svg", "a.svg")(out)],
}


@pytest.mark.parametrize(
    "build", [*FOLDERS.values(), pytest.param(nested, marks=pytest.mark.slow)], ids=[*FOLDERS, "nested"]
)
def test_nothing_outside_a_hostile_folder_changes_and_the_way_out_is_said(build, tmp_path):
    """Either the results are written, or one line names what is in the way; without that they are written."""
    outside, out = tmp_path / "outside", tmp_path / "out"
    outside.mkdir()
    out.mkdir()
    (outside / "victim.txt").write_text("precious")
    build(out)

    def write():
        with staged_output(out) as stage:
            stage.write("report.html", "new")

    refusal = None
    try:
        write()
    except FileError as error:
        refusal = error
    if refusal is not None:
        named = refusal.allowed.partition("or remove ")[2].partition(" to drop")[0] or refusal.path
        assert named.startswith(f"{out}/")
        subprocess.run(["rm", "-r", named], check=True)
        write()
    assert content_of(outside) == {"victim.txt": b"precious"}
    assert (out / "report.html").read_text() == "new"
    assert not (out / "report.html").is_symlink()


def test_an_input_that_has_the_name_of_a_hidden_folder_is_kept(tmp_path):
    (tmp_path / ".probewise-writing").write_text("precious")
    with (
        pytest.raises(FileError, match="an input has a name that results need"),
        staged_output(tmp_path, inputs=[tmp_path / ".probewise-writing"]),
    ):
        pass
    assert content_of(tmp_path) == {".probewise-writing": b"precious"}


LINKS = {
    "explore": ("journal.jsonl", ".journal.jsonl.lock", "live.html", "frames", "frames/1.png"),
    "investigate": ("rounds", "rounds/1.csv"),
    "study": ("trials.jsonl", ".trials.jsonl.lock"),
    "challenge": ("cases.jsonl", ".cases.jsonl.lock"),
}
PIPES = {"explore": ("journal.jsonl", "frames/2.png"), "investigate": ("rounds/1.csv",), "study": ("trials.jsonl",)}
IN_THE_WAY = [
    *((verb, name, None, "is a symbolic link") for verb, names in LINKS.items() for name in names),
    *((verb, name, "--resume", "is a device or a pipe") for verb, names in PIPES.items() for name in names),
]


@pytest.mark.parametrize(("verb", "name", "resume", "says"), IN_THE_WAY)
def test_a_link_or_a_pipe_where_a_run_would_write_is_refused_before_it_begins(
    verb, name, resume, says, sensor_file, tmp_path, capsys
):
    out = tmp_path / "out"
    (out / name).parent.mkdir(parents=True)
    (tmp_path / "victim").write_text("precious")
    if resume:
        os.mkfifo(out / name)
    else:
        (out / name).symlink_to(tmp_path / "victim")
    words = {"explore": ["--sensor", str(sensor_file)], "investigate": ["--plan", "paper", "--rounds", "1"]}
    more = [resume] if resume and verb in words else []
    said = refused(capsys, tmp_path, verb, *words.get(verb, []), *more, "--quiet", "--out", out)
    assert f"{out / name}: " in said
    assert says in said


def test_a_persons_folder_of_the_name_of_a_runs_is_left_alone(sensor_file, tmp_path, capsys):
    mine = tmp_path / "out" / "rounds" / "1.csv"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    words = ("investigate", "--plan", "paper", "--rounds", "1", "--sensor", sensor_file, "--out", tmp_path / "out")
    assert f"{mine.parent}: " in refused(capsys, tmp_path, *words)


def predict(sensor_file, recording_file, out):
    return run("predict", sensor_file, recording_file, "--quiet", "--out", out)


def check(sensor_file, recording_file, out):
    return run("arm", "check", "--quiet", "--out", out)


@pytest.mark.parametrize("write", [predict, check])
def test_a_pipe_and_a_device_are_written_to_a_link_is_followed_and_a_folder_is_refused(
    write, sensor_file, recording_file, tmp_path, capsys
):
    plain, pipe, folder = tmp_path / "plain.csv", tmp_path / "pipe", tmp_path / "folder"
    assert write(sensor_file, recording_file, plain) == 0
    os.mkfifo(pipe)
    heard = []
    reader = threading.Thread(target=lambda: heard.append(pipe.read_bytes()), daemon=True)
    reader.start()
    assert write(sensor_file, recording_file, pipe) == 0
    reader.join(10)
    assert heard == [plain.read_bytes()]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert not list(tmp_path.glob("pipe?*"))
    (tmp_path / "link.csv").symlink_to("elsewhere.csv")
    assert write(sensor_file, recording_file, tmp_path / "link.csv") == 0
    assert (tmp_path / "link.csv").is_symlink()
    assert len((tmp_path / "elsewhere.csv").read_bytes()) == len(heard[0])
    folder.mkdir()
    assert write(sensor_file, recording_file, folder) == 2
    assert "this is a directory" in capsys.readouterr().err
    try:
        os.mknod(tmp_path / "null", stat.S_IFCHR | 0o666, os.makedev(1, 3))
        (tmp_path / "null").open("wb").close()
    except OSError:
        return  # only root makes devices, and not on every file system
    assert write(sensor_file, recording_file, tmp_path / "null") == 0
    assert stat.S_ISCHR((tmp_path / "null").stat().st_mode)


def test_a_file_keeps_its_permissions_and_a_new_one_has_those_of_any_new_file(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "umask", lambda mode: pytest.fail("other threads would write with it"))
    (tmp_path / "ordinary").touch()
    write_bytes_atomically(tmp_path / "new", b"1")
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "ordinary").stat().st_mode
    (tmp_path / "new").chmod(0o640)
    write_bytes_atomically(tmp_path / "new", b"2")
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o640


def test_a_write_protected_file_is_not_replaced(tmp_path, monkeypatch):
    (tmp_path / "p.csv").touch(mode=0o444)
    monkeypatch.setattr(os, "access", lambda path, mode: path.stat().st_mode & stat.S_IWUSR)  # as of anyone but root
    with pytest.raises(FileError, match="is write-protected; allowed: a file that you may write to, or a new one"):
        checked_output_file(tmp_path / "p.csv")


def test_files_beside_the_named_one_follow_no_link(recording_file, tmp_path):
    (tmp_path / "victim").write_text("precious")
    (tmp_path / "rec.json").symlink_to(tmp_path / "victim")
    write_recording(read_recording(recording_file), tmp_path / "rec.csv")
    assert (tmp_path / "victim").read_text() == "precious"
    assert len(read_recording(tmp_path / "rec.csv")) > 0


def test_a_changed_simulator_is_refused_and_not_run(tmp_path, capsys):
    (tmp_path / "fitted.json").write_text(fitted().to_json())
    (tmp_path / "heater.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    (tmp_path / "table.csv").write_text("time_s\n1\n")
    words = ("predict", tmp_path / "fitted.json", tmp_path / "table.csv", "--simulator", tmp_path / "heater.py")
    said = refused(capsys, tmp_path, *words, "--out", tmp_path / "p.csv")
    assert "fingerprint abc; allowed: that file unchanged" in said
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("closed", "given", "status"),
    [(">&-", "", 0), ("2>&-", "", 0), ("<&- >&- 2>&-", "", 0), ("2>&-", "--seed x", 2), ("2>&-", "--simulator a", 2)],
)
def test_closed_streams_change_neither_the_file_nor_the_status(
    closed, given, status, sensor_file, recording_file, tmp_path
):
    command = f"{sys.executable} -m probewise predict {sensor_file} {recording_file} --out {tmp_path}/p.csv {given}"
    done = subprocess.run(["sh", "-c", f"{command} {closed}"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (status, "")
    assert (tmp_path / "p.csv").exists() is (status == 0)


def test_a_nul_in_a_path_is_refused_in_one_line(sensor_file, recording_file, tmp_path, capsys):
    assert predict(sensor_file, recording_file, f"{tmp_path}/a\0b") == 2
    assert "a text with a NUL names no file" in capsys.readouterr().err
    with pytest.raises(FileError, match="null byte"):
        write_bytes_atomically(f"{tmp_path}/a\0b", b"")


def test_control_characters_of_names_do_not_reach_the_terminal(sensor_file, recording_file, tmp_path, capsys):
    name = "\x1b[2J\x07\x9b31m\udcffa\rb"
    folder = tmp_path / name
    folder.mkdir()
    for path in (recording_file, recording_file.with_suffix(".json")):
        path.rename(folder / path.name)
    recording = folder / recording_file.name
    for status, words in [
        (0, ("predict", sensor_file, recording, "--out", folder / "p.csv")),
        (2, ("predict", folder / "none.json", recording, "--out", folder / "p.csv")),
        (2, ("predict", sensor_file, recording, "--out", folder / "p.csv", name)),
        (2, ("explore", "--sensor", sensor_file, "--arm", f"{name}.py", "--out", folder / "out")),
        (0, ("audit", recording)),
    ]:
        assert run(*words) == status
        said = capsys.readouterr()
        assert all(line.isprintable() for line in (said.out + said.err).split("\n")), words


def test_results_of_files_whose_names_are_no_utf_8_are_written_and_read_back(recording_file, tmp_path, capsys):
    (tmp_path / "\udcff.csv").write_text("x,y\n" + "".join(f"{k},{2 * k + 0.1 * (k * 7 % 5)}\n" for k in range(24)))
    (tmp_path / "\udcff.py").write_text(
        'reading, unit, parameters = "y", "V", {"a": (0, 10)}\ndef simulate(p, data):\n    return p["a"] * data["x"]\n'
    )
    given = (tmp_path / "\udcff.csv", "--simulator", tmp_path / "\udcff.py", "--quiet", "--out")
    assert run("fit", *given, tmp_path / "out") == 0
    assert run("predict", tmp_path / "out" / "fitted.json", *given, tmp_path / "p.csv") == 0
    assert "\\udcff.csv" in (tmp_path / "out" / "report.html").read_text()
