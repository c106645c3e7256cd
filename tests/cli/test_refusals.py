"""Commands that cannot be carried out: exit status 2, one line that says what, where and what is allowed, no change."""

import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from command import refused
from hand_made import small_recording, spread_sensor
from heater import FILE, runs

from probewise.arm import shipped_geometry_path
from probewise.calibration import write_sensor
from probewise.cli import VERBS
from probewise.recordings import Image, Plan, write_plan, write_recording
from probewise.systems import run_table_csv

OWN = "class Arm:\n    def measure(self, pose): 1 / 0\ndef connect(): return Arm()\n"
HELD = {  # the file by which results of another verb are known, and verbs that do not write there
    "diagnosis.json": ("fit data.csv --simulator heater.py", "calibrate data.csv", "audit data.csv"),
    "fit.json": (
        *("diagnose data.csv --simulator heater.py", "diagnose data.csv --each", "investigate --plan paper"),
        *("explore", "demo", "study", "challenge"),
    ),
    "result.json": ("fit data.csv --simulator heater.py",),
    "answers.json": ("calibrate data.csv",),
    "trials.jsonl": ("study --concealed",),
    "cases.jsonl": ("study",),
    "counts.svg": ("challenge",),
}
EXPLORE, INVESTIGATE = "explore --sensor sensor.json", "investigate --plan paper"
SCAN, RECORD, FIT = "arm scan 300,200 310,200", "arm record paper --out r.csv", "arm fit-geometry --out a.toml"
LONG = ("x" * 300, f"new/{'x' * 300}/new", "/".join(["x" * 200] * 30))
COUNTS = (
    *("calibrate rec.csv --live", f"{SCAN} --readings", "explore --batch", "explore --repeats"),
    *("explore --max-readings", "study --circles", "study --concealed --clean", "study --batch", "study --workers"),
    *("challenge --cases", f"{INVESTIGATE} --rounds"),
)
DIRECTORIES = {
    "demo": "demo", "calibrate": "calibrate small.csv", "explore": EXPLORE, "diagnose": "diagnose small.csv",
    "investigate": f"{INVESTIGATE} --truth nothing", "study": "study", "audit": "audit small.csv",
    "challenge": "challenge", "fit": "fit data.csv --simulator heater.py",
    "predict": "predict sensor.json small.csv --out taken/p.csv", "sheets": "sheets field --out taken/field.pdf",
    "arm": "arm check --out taken/reach.png", "emulate-nxt": "emulate-nxt --log taken/log.txt",
}  # fmt: skip
# Each command, and what its refusal says: fragments in their order.
REFUSED = {
    # what is misspelt, missing or too much
    "": "required",
    "unheard-of": "is not one of",
    "explor": "did you mean explore?",
    "explore --sensr s.json": "no option --sensr; did you mean --sensor?",
    f"{EXPLORE} --max-raedings=5": "did you mean --max-readings?",
    f"{EXPLORE} --shape circel": "did you mean circle?",
    f"{EXPLORE} --model perfect": "'perfect' is not one of ssf, naive",
    f"{EXPLORE} --field=--": "argument --field: -- is not a value",
    "calibrate a.csv b.csv": "arguments: b.csv (see probewise calibrate --help)",
    "predict only-one": "required",
    "arm raed": "did you mean read?",
    "arm jog base -5 --dryrun": "did you mean --dry-run?",
    "arm read --zzz": "no option --zzz (see",
    # values of options
    **{f"{words}={value}": "is not a whole number from 1 to" for words in COUNTS for value in ("0", "1" * 5000)},
    "study --concealed --seed -1": "'-1' is not a whole number of 0 or more",
    "study --batch 3 --utility entropy": "batch is 3; allowed: 1, or more with",
    "calibrate small.csv --live 51": "52 or more",
    "calibrate small.csv --orders 1 99": "n_live is 300; allowed: a whole number, 1192 or more",
    f"{EXPLORE} --field 10": "--field is '10'; allowed: WIDTH,HEIGHT in mm",
    f"{EXPLORE} --orientations 0,north": "not a list of numbers",
    f"{EXPLORE} --reference 120,100,80,60,1.5": "albedo",
    f"{EXPLORE} --reference 5,5,80,60,1": "a card on the field of 1048 x 520 mm",
    f"{EXPLORE} --truth cirle:600,260,90": "did you mean circle?",
    f"{EXPLORE} --truth 500,250,-90": "radius_mm of --truth 500,250,-90 is -90.0; allowed: 20 to 150,",
    f"{EXPLORE} --truth 500,nan,90": "y_mm of --truth 500,nan,90 is nan; allowed: 0 to 520,",
    f"{EXPLORE} --truth rectangle:500,250,100,60,2": "angle_rad of --truth ... is 2.0; allowed: 0 to 1.5708,",
    f"{EXPLORE} --truth ellipse:500,250,90,120,0.3": "semi_minor_mm of --truth ... is 120.0; allowed: 20 to 90,",
    f"{EXPLORE} --utility about:width_mm --quiet": "parameter is 'width_mm'; allowed: one of x_mm, y_mm, radius_mm",
    "demo --out its_demo": "--out is 'its_demo/diagnosis'; allowed: a directory, existing or new",
    "demo --truth 600,260,40": "radius_mm of --truth ... is 40.0; allowed: 50 to 150,",
    f"{EXPLORE} --conceal bcklash:1": "did you mean backlash",
    f"{EXPLORE} --conceal battery_sag:1": "battery_mv among them",
    f"{EXPLORE} --arm emulator --conceal lag:1": "none with any arm but the simulated one",
    f"{INVESTIGATE} --truth backlash:nan": "'backlash:nan'; allowed: backlash:",
    f"{INVESTIGATE} --truth bcklash:1": "did you mean backlash",
    f"{INVESTIGATE} --arm own.py --truth lag:1": "--truth is 'lag:1'",
    "emulate-nxt --fault gremlins": "--fault",
    "emulate-nxt --scene 1,2": "--scene",
    "emulate-nxt --scene blob:1,2,3": "--scene",
    "emulate-nxt --sleep 7": "sleep_min",
    "emulate-nxt --seed -1": "--seed",
    # options that contradict each other
    "study --model naive --learn-sensor": "learn_sensor is True; allowed: False with",
    "study --clean 3": "--clean is '3'; allowed: none with a study without --concealed",
    "study --concealed --beside-paper": "--beside-paper is 'True'; allowed: none with --concealed",
    f"{INVESTIGATE} --origin-mm 1,2": "--origin-mm is '1,2'; allowed: none with",
    f"{INVESTIGATE} --geometry arm.toml": "--geometry is 'arm.toml'; allowed: none with",
    f"{INVESTIGATE} --arm own.py --no-hands": "a plan over one pattern; paper has several",
    f"{EXPLORE} --resume": "no such file; allowed: a journal to resume",
    f"{EXPLORE} --heights 10 --model naive": "which knows no height",
    f"{EXPLORE} --heights 10 --both-models": "the naive model has no height",
    f"{EXPLORE} --heights 10": "does not say at which height_mm it was calibrated",
    f"{EXPLORE} --model naive --reference 120,100,80,60,1": "which knows two levels alone",
    f"{EXPLORE} --method paper --trust 0.9": "trust is 0.9; allowed: 1",
    f"{EXPLORE} --nested-stop change": "nested_stop is 'change'; allowed: None, but with the paper's method",
    f"{EXPLORE} --method paper --levels x.csv": "--levels is 'x.csv'; allowed: none with any but --method",
    "diagnose small.csv --workers 2": "for --each",
    "diagnose data.csv --simulator heater.py --sensor s.json": "--sensor is 's.json'; allowed: none with --simulator",
    # arms
    f"{EXPLORE} --arm emulatr": "did you mean emulator?",
    f"{EXPLORE} --arm printer": "--arm is 'printer'; allowed: simulated; emulator, ",
    f"{EXPLORE} --arm own.py --geometry a.toml": "--geometry is 'a.toml'; allowed: none with FILE.py",
    f"{EXPLORE} --arm own.py --truth 600,260,90": "--truth is '600,260,90'; allowed: none with a real arm",
    f"{EXPLORE} --arm nxt:x --truth 600,260,90": "--truth is '600,260,90'; allowed: none with a real arm",
    f"{EXPLORE} --arm nxt:x --field 800,400": "1048,520, the geometry's",
    f"{EXPLORE} --arm nxt:x --orientations 0,45": "no joint of which turns its sensor",
    f"{EXPLORE} --arm nxt:x --heights 10,14": "none with the LEGO arm but 14: it reads that many",
    f"{EXPLORE} --arm nxt:x --method paper --model naive": "--levels is 'none'; allowed: a recording",
    "explore --arm nxt:none": "--sensor is 'none'",
    "arm read": "--arm is missing: name the brick",
    "arm read --arm simulated": "nxt:PORT",
    "arm read --arm emulator": "that of `probewise emulate-nxt`",
    "arm read --arm ev3:/dev/x": "nxt:PORT",
    "arm home --arm own.py": "allowed: nxt:PORT; FILE.py is for `arm scan`, `arm record` and `explore`",
    "arm check --arm simulated --out reach.png": "allowed: nxt:PORT",
    "arm heights 524,260 --arm emulator": "two places or more",
    "arm heights --arm simulated": "nxt:PORT",
    FIT: "--arm is missing",
    f"{FIT} --arm simulated": "nxt:PORT or emulator:TRUE.toml",
    "arm fit-geometry --out kept.toml --arm emulator": "--resume to continue it",
    "arm jog wrist 5 --dry-run": "allowed: X,Y in mm; or base, shoulder, elbow, and degrees",
    "arm jog base far --dry-run": "a number of degrees",
    "arm jog base inf --dry-run": "WHERE is 'inf'; allowed: a number of degrees",
    "arm jog base nan --dry-run": "WHERE is 'nan'; allowed: a number of degrees",
    "arm jog 300;200 --dry-run": "X,Y in mm",
    "arm jog 5,5 --dry-run": "a place on the field",
    "arm scan 300,200 400,nan --dry-run": "X,Y is '400,nan'",
    f"{SCAN} --arm nxt:x --scene 600,250,80": "--scene is '600,250,80'; allowed: none with a real arm",
    f"{SCAN} --arm simulated --dry-run": "--dry-run is True; allowed: none with simulated: it is for the LEGO arm",
    f"{SCAN} --arm own.py --dry-run": "--dry-run is True; allowed: none with own.py: it is for",
    f"{SCAN} --arm emulator --scene blob": "--scene is 'blob'; allowed: ",
    f"{SCAN} --arm own.py --geometry a.toml": "a.toml",
    "arm record nowhere.csv --out r.csv --dry-run": "nowhere.csv",
    f"{RECORD} --origin-mm 5,5 --dry-run": "move the plan's origin",
    f"{RECORD} --origin-mm middle --dry-run": "--origin-mm is 'middle'",
    f"{RECORD} --arm own.py --range 5": "--range is '5'; allowed: LOW,HIGH",
    f"{RECORD} --arm own.py --unit V --range 5,1": "max is 1.0; allowed: greater than",
    "arm check --geometry thin.toml": "reach is 'nowhere on the field'",
    # what is read
    f"{INVESTIGATE.replace('paper', 'nowhere.csv')}": "nowhere.csv",
    "emulate-nxt --geometry nowhere.toml": "nowhere.toml",
    "emulate-nxt --sensor nowhere.json": "nowhere.json",
    "diagnose swings.csv": "column x_mm: no such column ... a table of anything else needs --simulator FILE.py",
    "diagnose volts.csv --sensor sensor.json": "'LEGO'",
    "audit volts.csv --sensor sensor.json": "'LEGO'",
    "diagnose journal.jsonl": "--sensor",
    "diagnose journal.jsonl journal.jsonl --sensor sensor.json": "one at a time",
    "diagnose journal.jsonl --simulator heater.py": "a journal; allowed: a CSV table",
    "diagnose data.csv data.csv --simulator heater.py": "these hold the same rows",
    **{
        f"{words} journal.jsonl": "probewise diagnose journal.jsonl --sensor S.json --out DIR"
        for words in ("predict sensor.json", "audit", "calibrate")
    },
    # where results go
    **{f"{words} --out ''": "names no file or directory" for words in ("diagnose small.csv", "calibrate small.csv")},
    **{f"{words} --out {name}": "too long" for words in ("calibrate paper", "demo", "arm check") for name in LONG},
    **{
        f"{words} --out /proc/foo": "/proc/foo: /proc cannot be written to; allowed: a directory you may write to"
        for words in ("calibrate small.csv", "diagnose small.csv")  # root may, by its permissions, and cannot
        if Path("/proc/self").exists()
    },
    **{words if " taken/" in words else f"{words} --out taken": "taken" for words in DIRECTORIES.values()},
    **{
        f"{words} --out held/{held}": f"another folder: this one holds ... ({held}), with which these results would mix"
        for held, several in HELD.items()
        for words in several
    },
    # what is read is not written
    **{f"predict sensor.json small.csv --out {name}": "another file" for name in ("small.csv", "small.json")},
    **{
        f"sheets {what} --out {name}": "another file than the input"
        for what in ("card.csv", "card.json")
        for name in ("card.csv", "card.json", "card.png")
    },
    "arm check --geometry arm.toml --out arm.toml": "--out is",
    "arm check --geometry arm.toml --drawing arm.toml": "--drawing is",
    "arm fit-geometry --marks marks.csv --geometry arm.toml --out arm.toml": "--out is",
    "arm fit-geometry --marks marks.csv --out marks.csv": "another file than the input marks.csv",
    "arm fit-geometry --arm emulator --marks new --out new": "another file than the input new",
    "arm fit-geometry --arm emulator:arm.toml --out arm.toml": "another file than the input arm.toml",
    "arm check --out new.png --drawing new.png": "--drawing is",
    "emulate-nxt --log card.csv --link small.csv": "small.csv",
    "emulate-nxt --log new --link new": "--log is 'new'; allowed: another file",
    "emulate-nxt --link its_link": "its_link: the path exists already",
    f"{FIT} --arm nxt:none --geometry arm.toml --marks arm.toml": "--marks is",
    "emulate-nxt --geometry arm.toml --log arm.toml": "--log is",
    "emulate-nxt --sensor sensor.json --log sensor.json": "--log is",
    "emulate-nxt --link small.csv": "small.csv",
    "sheets jig --geometry arm.toml --out arm.toml": "--out is",
    **{
        f"arm record card.csv --out {folder}/r.csv --arm nxt:/none": "the file exists already; allowed: --resume to"
        for folder in ("its_csv", "its_json", "its_png")
    },
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the commands read, and what stands in their way."""
    at = tmp_path_factory.mktemp("refused")
    write_sensor(spread_sensor(), at / "sensor.json")
    write_recording(small_recording(), at / "small.csv")
    for name in ("volts.csv", "volts.json"):
        shutil.copy(at / f"small{name[5:]}", at / name)
    (at / "volts.json").write_text((at / "volts.json").read_text().replace('"LEGO"', '"mW"'))
    card = {"card": Image(np.eye(4), 3.0, (-5.0, -6.0), "card.png")}
    write_plan(Plan.from_arrays(x_mm=[1.0, 2.0], y_mm=0.0, patterns=card, unit="V"), at / "card.csv")
    geometry = shipped_geometry_path().read_text()
    texts = {
        "own.py": OWN, "heater.py": FILE, "data.csv": run_table_csv(runs()), "swings.csv": "t_s,angle\n0,1\n1,2\n",
        "journal.jsonl": '{"format": "journal/1"}\n', "taken": "mine", "arm.toml": geometry, "kept.marks.csv": "",
        "thin.toml": geometry.replace("upper_mm = 350", "upper_mm = 1e-320"),
        **{f"held/{name}/{name}": "{}" for name in HELD},
        "its_csv/r.csv": "mine", "its_json/r.json": "mine", "its_png/card.png": "mine",
        "its_demo/diagnosis": "mine",
    }  # fmt: skip
    for name, text in texts.items():
        (at / name).parent.mkdir(parents=True, exist_ok=True)
        (at / name).write_text(text)
    (at / "its_link").symlink_to("small.csv")
    return at


@pytest.mark.parametrize(
    ("command", "says"), REFUSED.items(), ids=[f"{k} {command[:60]}" for k, command in enumerate(REFUSED)]
)
def test_a_command_that_cannot_be_carried_out_is_refused_in_one_line_and_changes_nothing(
    command, says, folder, monkeypatch, capsys
):
    monkeypatch.chdir(folder)
    words = shlex.split(command)
    into = words and words[0] not in ("arm", "emulate-nxt", "sheets") and "--out" not in words
    said, place = refused(capsys, folder, *words, *(["--out", "out"] if into else [])), 0
    for fragment in says.split(" ... "):
        place = said.find(fragment, place)
        assert place >= 0, said


def test_every_verb_refuses_a_file_in_place_of_its_directory():
    assert DIRECTORIES.keys() == VERBS.keys()
