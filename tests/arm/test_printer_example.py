"""The example of a person's own instrument, a printer's gantry, against a printer that answers as Marlin does."""

import contextlib
import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("serial")
pytest.importorskip("tty")

from marlin import BED_MM, Marlin

from probewise.arm import OwnInstrument, Pose
from probewise.cli import main
from probewise.errors import LinkError

EXAMPLE = Path(__file__).parents[2] / "examples" / "instruments" / "printer.py"
LINES_FIRST = 6  # that the example sends before the first move


def disc(x_mm, y_mm, height_mm):
    """Read ten bits over a bright disc; from another height than the example's it is dark."""
    return 840 if math.hypot(x_mm - 120, y_mm - 100) < 40 and height_mm == 12.0 else 140


@pytest.fixture
def bench(tmp_path):
    """Set a printer up, and the example as its owner would change it: other ports, and less patience."""

    @contextlib.contextmanager
    def set_up(**faults):
        with Marlin(disc, **faults) as printer:
            text, path = EXAMPLE.read_text(encoding="utf-8"), tmp_path / "printer.py"
            for old, new in (
                ("/dev/ttyUSB0", printer.line.path),
                ("/dev/ttyACM0", printer.sensor.path),
                ("RESTART_S, PATIENCE_S, TRIES = 3.0, 10.0, 4", "RESTART_S, PATIENCE_S, TRIES = 0.05, 0.3, 4"),
            ):
                assert old in text
                text = text.replace(old, new)
            path.write_text(text)
            yield printer, path

    return set_up


def test_it_reads_where_the_head_has_come_to_and_lets_go_of_the_motors(bench):
    with bench() as (printer, path):
        with OwnInstrument.from_file(path) as arm:
            readings = [arm.measure(Pose(x_mm, 100.0)) for x_mm in (20.0, 120.0, 200.0)]
            reach = arm.reachable(np.array([[0.0, 0.0], [220.0, 220.0], [221.0, 0.0], [-1.0, 5.0]]))
            seconds = arm.travel_s(Pose(20.0, 100.0), np.array([[120.0, 100.0]]))
        assert [reading.value for reading in readings] == [140.0, 840.0, 140.0]
        assert printer.read == [(20.0, 100.0), (120.0, 100.0), (200.0, 100.0)]
        assert reach.tolist() == [True, True, False, False]
        assert seconds.tolist() == pytest.approx([1.3])
        assert max(BED_MM) == 220.0
    assert printer.obeyed[0] == "M110 N0"
    assert printer.obeyed[-1] == "M84"


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        ({"halt": LINES_FIRST + 1}, "printer says 'Error:Printer halted. kill() called!' to 'G1 X120.00"),
        ({"bumps_mm": 100.0}, "the printer says 'echo:endstops hit: X:120.00' to 'M400'"),
        ({"deaf": LINES_FIRST + 1}, "the printer does not answer 'G1 X120.00 Y100.00 F6000' within 0.3 s"),
        ({"garble": range(LINES_FIRST + 1, 99)}, "does not understand 'G1 X120.00 Y100.00 F6000'; a cable?"),
    ],
)
def test_what_the_printer_complains_of_is_told_and_the_motors_are_let_go(bench, faults, said):
    with bench(**faults) as (printer, path):
        with (
            pytest.raises(LinkError, match=r"printer\.py, line \d+: measure raises \w+: ") as raised,
            OwnInstrument.from_file(path) as arm,
        ):
            arm.measure(Pose(120.0, 100.0))
        assert said in str(raised.value)
    assert printer.received[-1] == "M84"


def test_a_scan_from_the_command_line(bench, capsys):
    with bench() as (_, path):
        assert main(["arm", "scan", "20,100", "120,100", "--readings", "3", "--arm", str(path)]) == 0
    header, *rows = capsys.readouterr().out.splitlines()
    assert header == "x_mm,y_mm,orientation_deg,time_s,reading"
    assert [row.rpartition(",")[2] for row in rows] == ["140", "140", "840"]
