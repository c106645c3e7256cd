"""The whole program against the whole emulator, over a pseudo-terminal and by the wall's clock: some minutes."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm_faults import MISSED_MM, SENSOR, TRUTH

from probewise.calibration import write_sensor
from probewise.cli import main

pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="this system has no pseudo-terminals")

MAX_SESSIONS, REOPEN_S = 20, 0.5


@pytest.mark.slow
def test_the_robot_finds_the_circle_over_a_line_that_is_cut_again_and_again(
    emulator: Callable[..., AbstractContextManager[Any]], tmp_path: Path
) -> None:
    sensor, link, out = tmp_path / "sensor.json", tmp_path / "rfcomm0", tmp_path / "found"
    write_sensor(SENSOR, sensor)
    scene = ",".join(f"{length:g}" for length in TRUTH)
    options = ["--sensor", str(sensor), "--scene", scene, "--link", str(link)]
    arguments = ["explore", "--sensor", str(sensor), "--out", str(out), "--arm", f"nxt:{link}", "--quiet"]
    endings = []
    with emulator(*options, "--fault", "disconnect=0.02", "--fault", "fragment=0.3"):
        for _ in range(MAX_SESSIONS):
            resume = ["--resume"] if (out / "journal.jsonl").exists() else []
            endings.append(main([*arguments, *resume]))
            if endings[-1] == 0:
                break
            time.sleep(REOPEN_S)
    assert endings[-1] == 0
    assert set(endings[:-1]) == {1}, "cut at least once, and never ended by anything else"
    lines = [json.loads(line) for line in (out / "journal.jsonl").read_text(encoding="utf-8").splitlines()[1:]]
    assert [line["index"] for line in lines] == list(range(1, len(lines) + 1))
    assert (np.diff([line["time_s"] for line in lines]) > 0).all()
    found = [lines[-1]["belief"]["mean"][name] for name in ("x_mm", "y_mm", "radius_mm")]
    np.testing.assert_allclose(found, TRUTH, atol=MISSED_MM)
