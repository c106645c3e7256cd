"""What people wait for: processor seconds and memory of today's commands over those of an earlier commit.

    python benchmarks/speed.py --before EARLIER/bin/python --out docs/results/speed.json

Every row is run before, now, before, now (those over 20 s once each; children included, one thread of linear
algebra), and its ratio is the mean of both pairs: seconds grow where a machine does other things too, so only what
stands in one row may be compared. A run of more than --limit processor seconds is stopped: over. Rows in the file stay,
unless --rows names them. Both environments need the dependencies; `--tests` times the README's tests (wall time) of
that earlier checkout and this one. Calls of the slow simulator, which would take .05 s each, are counted.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

HERE = Path(__file__).resolve().parent.parent
DATA = HERE / "src/probewise/data"
PENDULUM = HERE / "examples/simulators/pendulum.py"
NOISE = 0.1
CLOSED_ROWS, LAW_ROWS = (120, 500, 20_000, 200_000, 1_000_000), (500, 5000)
LONG_S = 20  # a row that takes as long before is run once each
CLOSED = """import numpy as np
reading, unit, time, run, vectorized = "y", "V", "t_s", "run", True
parameters = {"a": (0, 20), "tau_s": ("log", 1, 1000), "b": ("normal", 0, 10), "gain": ("normal", 1, 1)}
def simulate(p, data):
    return p["a"] * np.exp(-data["t_s"] / p["tau_s"]) + p["b"] + p["gain"] * data["u"]
"""
SLOW = """import math, os
reading, unit, time, run = "y", "V", "t_s", "run"
parameters = {"a": (0, 20), "tau_s": ("log", 1, 1000), "b": ("normal", 0, 10), "gain": ("normal", 1, 1)}
def simulate(p, data):
    with open(os.environ["CALLS"], "ab") as calls:
        calls.write(b".")
    t, u, tau = data["t_s"], data["u"], float(p["tau_s"])
    return [p["a"] * math.exp(-t[k] / tau) + p["b"] + p["gain"] * u[k] for k in range(len(t))]
"""
INQUIRY = """import numpy as np
from probewise import Inquiry, priors
prior = {"c": priors.Uniform(2, 4), "h": priors.Uniform(.5, 2), "bg": priors.Normal(0, .5)}
peak = lambda p, x: p["bg"] + p["h"] / (1 + ((x - p["c"]) / 0.1) ** 2)
ask = Inquiry(peak, prior, np.linspace(1.5, 4.5, 101), .1, goal={"c": .001}, rng=np.random.default_rng(1))
rng = np.random.default_rng(4)
for _ in range(12):
    x = ask.next()
    ask.tell(float(.2 + 1.2 / (1 + ((x - 3.37) / .1) ** 2) + .1 * rng.standard_normal()), x)
"""


NEW = "a new folder"  # of each run: one takes the results of one verb


def table(n: int) -> str:
    """Write n rows of the closed form in four runs; a logged column has an effect that the file leaves out."""
    rng = np.random.default_rng(n)
    t, run = np.linspace(0, 60, n), np.repeat(np.arange(4), -(-n // 4))[:n]
    u, room = np.sin(t) + rng.standard_normal(n), 20 + np.cos(t / 7) + 0.1 * rng.standard_normal(n)
    y = 8 * np.exp(-t / 12) + 1 + u + 0.2 * (room - 20) + NOISE * rng.standard_normal(n)
    rows = "\n".join(f"{a:.4f},{b:.5f},{c:.5f},{d},{e:.5f}" for a, b, c, d, e in zip(t, u, room, run, y, strict=True))
    return f"t_s,u,room_c,run,y\n{rows}\n"


def swings(n: int) -> str:
    """Write n rows of a pendulum with drag, in ten releases."""
    rng, t = np.random.default_rng(n), 0.05 * np.arange(n // 10)

    def rates(_: float, s: np.ndarray) -> list[float]:
        return [s[1], -9.81 / 0.9 * np.sin(s[0]) - 0.05 * s[1] - 0.08 * abs(s[1]) * s[1]]

    out = "release,t_s,room_c,angle_deg\n"
    for k in range(10):
        phi = solve_ivp(rates, (0, t[-1]), [rng.uniform(-1, 1), 0], t_eval=t, rtol=1e-9, atol=1e-9).y[0]
        angle = np.degrees(phi) + NOISE * rng.standard_normal(len(t))
        out += "".join(f"r{k},{a:.2f},{20 + 0.1 * k:.1f},{b:.4f}\n" for a, b in zip(t, angle, strict=True))
    return out


def recording(to: Path, *every: int) -> Path:
    """Write every so many readings of the shipped two-way recording, one such part after the other."""
    first, *rows = (DATA / "concealed.csv").read_text().splitlines()
    parts = [f"part{k}_{row}" for k, step in enumerate(every) for row in rows[::step]]
    to.write_text("\n".join([first, *parts]) + "\n")
    to.with_suffix(".json").write_text((DATA / "concealed.json").read_text())
    return to


def rows(at: Path, before: Path) -> dict[str, tuple[float, list[str]]]:
    """Make the inputs; return by name of each row its goal, and its command after `python`, cheap ones first."""
    for name, text in (("closed.py", CLOSED), ("slow.py", SLOW), *((f"{n}.csv", table(n)) for n in CLOSED_ROWS)):
        (at / name).write_text(text)
    for n in LAW_ROWS:
        (at / f"law{n}.csv").write_text(swings(n))
    run, out = ["-m", "probewise"], ["--quiet", "--out", NEW]
    calibrated = [before, *run, "calibrate", DATA / "paper.csv", "--orders", "1", "--quiet", "--out", at / "sensor"]
    subprocess.run(calibrated, check=True, env=environment(before))
    subprocess.run([sys.executable, HERE / "examples/plot_pendulum.py", "--out", at / "swings.csv"], check=True)
    look = [*run, "explore", "--sensor", str(at / "sensor/sensor.json"), "--seed", "3", "--max-readings", "8", *out]

    def read(file: Path, simulator: Path | None = None) -> list[str]:
        return [*run, "diagnose", str(file), *([] if simulator is None else ["--simulator", str(simulator)]), *out]

    def fitted(file: Path) -> list[str]:
        return [*run, "calibrate", str(file), *out, "--orders", "1", "2", "3", "4"]

    closed = at / "closed.py"
    return {
        "diagnose --help": (0.3, [*run, "diagnose", "--help"]),
        "import probewise": (1.0, ["-c", "import probewise"]),
        "diagnose: a slow simulator, 120 rows": (0.25, read(at / "120.csv", at / "slow.py")),
        "Inquiry: 12 readings": (0.1, ["-c", INQUIRY]),
        "explore: 8 readings, trusting": (0.5, [*look, "--trust", "1"]),
        "diagnose: the README's pendulum": (0.35, read(at / "swings.csv", PENDULUM)),
        "diagnose: a closed form, 500 rows": (0.35, read(at / "500.csv", closed)),
        "diagnose: a recording of 408": (0.35, read(DATA / "paper.csv")),
        "calibrate: 408 readings": (0.4, fitted(DATA / "paper.csv")),
        "diagnose: a closed form, 20,000 rows": (0.2, read(at / "20000.csv", closed)),
        "explore: 8 readings, in doubt": (0.25, look),
        "diagnose: a law of two states, 500 rows": (0.4, read(at / "law500.csv", PENDULUM)),
        "diagnose: a recording of 24": (0.35, read(recording(at / "24.csv", 41))),
        "calibrate: 961 readings": (0.3, fitted(DATA / "concealed.csv")),
        "calibrate: 1,804 readings": (0.5, fitted(recording(at / "1804.csv", 1, 8, 2, 4))),
        "demo": (0.3, [*run, "demo", *out]),
        "diagnose: a law of two states, 5,000 rows": (0.4, read(at / "law5000.csv", PENDULUM)),
        "diagnose: a closed form, 200,000 rows": (0.2, read(at / "200000.csv", closed)),
        "diagnose: a closed form, 1,000,000 rows": (0.2, read(at / "1000000.csv", closed)),
    }


def environment(python: Path) -> dict[str, str]:
    """Return the variables of a run: one thread, and another tree's path for no other Python than this one."""
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONPATH" or python == Path(sys.executable)}
    return kept | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "Agg"}


def measured(python: Path, command: list[str], at: Path, limit_s: int | None, cwd: Path) -> dict[str, float]:
    """Run once; return seconds, peak memory and calls of the slow simulator, or only `over_s` beyond the limit."""
    (at / "calls").write_bytes(b"")
    began, how = time.monotonic(), {"cwd": cwd, "env": environment(python) | {"CALLS": str(at / "calls")}}
    quiet = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        "preexec_fn": limit_s and partial(resource.setrlimit, resource.RLIMIT_CPU, (limit_s, limit_s)),
    }
    words = [str(python), *(str(at / f"{time.time_ns()}") if word == NEW else word for word in command)]
    _, status, used = os.wait4(subprocess.Popen(words, **how, **quiet).pid, 0)
    if status and limit_s is not None and used.ru_utime + used.ru_stime > limit_s - 1:
        return {"over_s": limit_s}
    out = {
        "cpu_s": round(used.ru_utime + used.ru_stime, 2),
        "wall_s": round(time.monotonic() - began, 1),
        "mb": used.ru_maxrss // 1024,
    }
    assert not status, (command, os.waitstatus_to_exitcode(status))
    calls = (at / "calls").stat().st_size
    return out | ({"calls": calls} if calls else {})


def told(name: str, row: dict) -> str:
    """Say one row of the table."""
    by = "calls" if "calls" in (row["now"] or [{}])[0] else "cpu_s"
    before, now = (f"{np.mean([r.get(by, np.nan) for r in row[w]]):.4g}" for w in ("before", "now"))  # nan: cut off
    mb = ", ".join(str(max((r.get("mb", 0) for r in row[w]), default=0)) for w in ("before", "now"))
    ratio = "–" if row["ratio"] is None else f"{row['ratio']:.2f}"
    return f"| {name} | {before} | {now} | {ratio} | {mb} |"


def main() -> None:
    """Measure what the file lacks, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True, metavar="PYTHON")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rows", nargs="+", default=(), help="only rows whose name holds one of these words, again")
    parser.add_argument("--limit", type=int, default=300, metavar="SECONDS")
    parser.add_argument("--tests", type=Path, metavar="CHECKOUT")
    told_to = parser.parse_args()
    found = json.loads(told_to.out.read_text()) if told_to.out.exists() else {}
    pythons = {"before": told_to.before, "now": Path(sys.executable)}
    for python in pythons.values():  # so that no row pays for it
        compiled = "import compileall, probewise as p; compileall.compile_dir(p.__path__[0], quiet=2)"
        subprocess.run([python, "-c", compiled], check=True, env=environment(python))
    with tempfile.TemporaryDirectory() as folder:
        at, trees = Path(folder), {"before": told_to.tests or folder, "now": HERE if told_to.tests else folder}
        tests = {"the README's tests": (0.4, ["-m", "pytest", "-q", "-n", "logical", "--dist", "loadfile"])}
        for name, (goal, command) in (tests if told_to.tests else rows(at, told_to.before)).items():
            if (name in found and not told_to.rows) or not any(w in name for w in told_to.rows or [name]):
                continue
            row = {"goal": goal, "before": [], "now": [], "ratio": None}
            limit_s = None if told_to.tests else told_to.limit
            for which in ("before", "now") * 2:
                if len(row["now"]) < 1 or row["before"][0].get("cpu_s", LONG_S) < LONG_S:
                    row[which].append(measured(pythons[which], command, at, limit_s, trees[which]))
            by = "wall_s" if told_to.tests else "calls" if "calls" in row["now"][0] else "cpu_s"
            pairs = [b[by] / a[by] for a, b in zip(row["before"], row["now"], strict=True) if by in a and by in b]
            row["ratio"] = round(float(np.mean(pairs)), 3) if pairs else None
            found[name] = row
            told_to.out.write_text(json.dumps(found, indent=1) + "\n")
            print(told(name, row), flush=True)
    print("\n| what | before | now | ratio | MB |\n|---|---|---|---|---|")
    print("\n".join(told(name, row) for name, row in found.items()))


if __name__ == "__main__":
    main()
