"""The whole autonomous run with the LEGO arm on the emulator, under every fault that its radio link may have.

    python benchmarks/arm_faults.py --injections 1000 --seed 1 --out docs/results/arm_faults.json

The robot looks for a circle; the line fails, is opened again, and the run goes on from its journal. The clock is
one that nobody waits for. Every reading is compared with what the emulated brick says that it answered, and with
where the sensor stood then: see `wrong`, `lost`, `twice` and `violations`. A campaign that was stopped goes on
from OUT.partial.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import struct
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from probewise.arm import LegoArm, Pose, Reading, read_geometry, shipped_geometry_path
from probewise.arm.nxt import Brick, BrickMachine, Link
from probewise.arm.nxt.link import LONGEST_S
from probewise.calibration import FittedSensor
from probewise.emulator import EmulatedBench, Faults, SensorPose, VirtualClock, VirtualLine, set_up_bench
from probewise.emulator import read_geometry as read_numbers
from probewise.errors import LinkError
from probewise.experiment import Experiment, Step, experiment_for, explore, read_journal, world_like
from probewise.inquiry import Grid
from probewise.recordings import Disc, Instrumentation
from probewise.scene import Circle, Field
from probewise.sensor import footprint_of, mean_ssf_field

FAULTS = {
    "fragment": Faults(fragment=0.5),
    "merge": Faults(merge=0.03),
    "double": Faults(double=0.05),
    "corrupt": Faults(corrupt=0.05),
    "delay": Faults(late=0.05, late_s=0.5),
    "late": Faults(late=0.03, late_s=2.5),
    "drop": Faults(drop=0.003),
    "half": Faults(half=0.05),
    "error": Faults(error=0.05),
    "silence": Faults(silence=0.03),
    "deaf": Faults(deaf=0.03),
    "unasked": Faults(unasked=0.2),
    "disconnect": Faults(disconnect=0.01),
    "all": Faults(
        fragment=0.03, merge=0.005, double=0.005, corrupt=0.005, late=0.005, late_s=1.0, drop=0.0003, half=0.005,
        error=0.005, silence=0.005, deaf=0.005, unasked=0.03, disconnect=0.002,
    ),
    "sag": Faults(sag=300.0),
}  # fmt: skip
"""More often than on a bad day; the battery is empty after six minutes."""

TRUTH = (600.0, 250.0, 120.0)
GEOMETRY = read_geometry(shipped_geometry_path())
MAX_READINGS, MAX_SESSIONS = 60, 200
QUIET_S = 10.0  # the longest limited move, with its run-on
MISSED_MM = 16.0  # four times the sd at which a run stops
PLACE_MM = 2.0  # a motor's count, play and the way that a count makes at the far end of the arm
TURN_DEG = 1.0  # the base's
HEIGHT_MM = 3.0  # of a reading, off the height that it is meant for
BATTERY_MV = 60.0
LIGHT, BATTERY, LED_ON = 0x07, 0x0B, 0x05


def sensor() -> FittedSensor:
    """Make a sensor as a calibration would leave it, known almost exactly: one Gaussian, off the centre."""
    mean = np.array([0.5, 0.0, 1.5, 1 / 32, 1 / 12.5, 0.0, 10.0, 60.0])
    axis = np.arange(-20.0, 20.5)
    return FittedSensor(
        names=("a_1", "u_1", "v_1", "A_1", "B_1", "C_1", "I_min", "I_max"),
        samples=mean + 1e-4 * np.random.default_rng(0).standard_normal((500, 8)),
        n_gaussians=1,
        noise_sd=np.full(500, 0.6),
        field=mean_ssf_field(footprint_of(mean[None, :6], 1), u_mm=axis, v_mm=axis),
        instrumentation=Instrumentation(),
    )


SENSOR = sensor()
WORLD = world_like(SENSOR)


def experiment(n_x: int = 66, n_y: int = 33, n_particles: int = 1000) -> Experiment:
    """Ask for a circle, on a grid coarser than the paper's, so that many runs fit into a minute."""
    place = Field(*GEOMETRY.field_mm)
    asked = experiment_for(SENSOR, Circle(place), place)
    return replace(asked, grid=Grid(place.width_mm, place.height_mm, n_x, n_y), n_particles=n_particles)


class TimedLink(Link):
    """A link that remembers its longest question."""

    longest_s = 0.0

    def ask(self, request, *, check=None):
        began_s = self._clock.monotonic()
        try:
            return super().ask(request, check=check)
        finally:
            self.longest_s = max(self.longest_s, self._clock.monotonic() - began_s)


@dataclass(frozen=True)
class Answer:
    """What the brick answered to a question for its light sensor: when, how bright, and where the sensor stood."""

    time_s: float
    percent: float
    stand: SensorPose
    battery_mv: float


@dataclass
class BrickLog:
    """The brick's own record: every valid light reading that it put on the line."""

    bench: EmulatedBench | None = None
    answers: list[Answer] = field(default_factory=list)

    def __call__(self, now_s: float, event: str, text: str) -> None:
        telegram = bytes.fromhex(text.split("  ")[0]) if event == "<" else b""
        if telegram[1:3] == bytes((LIGHT, 0)) and telegram[4]:
            (normalized,) = struct.unpack_from("<H", telegram, 10)
            here = self.bench.arm.sensor_pose(), self.bench.radio.brick.battery_mv
            self.answers.append(Answer(now_s, 100 * normalized / 1023, *here))

    def last(self, began_s: float, ended_s: float) -> int | None:
        """Return the number of the last answer of that time."""
        return next((k for k, a in reversed([*enumerate(self.answers)]) if began_s <= a.time_s <= ended_s), None)


class WatchedArm(LegoArm):
    """An arm that remembers each reading that it gave, and what the brick said of it."""

    def __init__(self, machine, geometry, *, run, log, clock, start_s):
        super().__init__(machine, geometry, clock=clock, start_s=start_s)
        self.link = machine.brick.link
        self._run, self._log, self._read = run, log, machine.read_percent
        machine.read_percent = self._watched
        self._seen = None

    def _watched(self):
        began_s = self._clock.monotonic()
        percent = self._read()
        self._run.n_read += 1
        self._seen = percent, self._log.last(began_s, self._clock.monotonic())
        return percent

    def measure(self, pose):
        reading = super().measure(pose)
        percent, number = self._seen
        answer = None if number is None else self._log.answers[number]
        self._run.taken.append(Taken(pose, reading, percent, number, answer))
        return reading


@dataclass(frozen=True)
class Taken:
    """A reading, the pose that was asked for, the percentage that the driver made it of; the brick's last answer."""

    asked: Pose
    reading: Reading
    percent: float
    number: int | None
    answer: Answer | None


@dataclass
class Run:
    """What happened in one run, over all its sessions."""

    steps: list[Step] = field(default_factory=list)
    taken: list[Taken] = field(default_factory=list)
    journal: tuple[Reading, ...] = ()
    mishaps: Counter[str] = field(default_factory=Counter)
    endings: list[str] = field(default_factory=list)
    longest_s: float = 0.0
    n_read: int = 0
    n_left_running: int = 0
    n_left_lit: int = 0

    @property
    def found_mm(self) -> float:
        """Largest error of the circle's three lengths."""
        return float(np.abs(self.steps[-1].mean - TRUTH).max())


def bench_with(faults: Faults, clock: VirtualClock, *, seed: int) -> tuple[EmulatedBench, BrickLog]:
    """Set up the arm over the circle, and the brick's record."""
    log = BrickLog()
    circle = Disc(TRUTH[:2], TRUTH[2])
    log.bench = set_up_bench(
        read_numbers(shipped_geometry_path()), WORLD, circle, clock, seed=seed, faults=faults, trace=log
    )
    return log.bench, log


def connected(log: BrickLog, clock: VirtualClock, run: Run, *, start_s: float = 0.0) -> WatchedArm:
    """Open the line to the bench; what is measured is added to the run."""
    link = TimedLink(VirtualLine(log.bench.radio, clock), clock=clock)
    machine = BrickMachine(Brick(link, clock=clock), GEOMETRY)
    return WatchedArm(machine, GEOMETRY, run=run, log=log, clock=clock, start_s=start_s)


def explored(asked: Experiment, faults: Faults, *, seed: int, journal: Path) -> Run:
    """Let the robot find the circle, opening the line again and going on from the journal whenever it ends."""
    clock, run = VirtualClock(), Run()
    bench, log = bench_with(faults, clock, seed=seed)
    for _ in range(MAX_SESSIONS):
        ended = _session(run, log, clock, asked, seed=seed, journal=journal)
        run.n_left_lit += bench.radio.is_open and _is_lit(bench)
        run.n_left_running += not _comes_to_rest(bench, clock)
        if ended is None:
            break
        run.endings.append(ended)
    run.mishaps, run.journal = bench.radio.mishaps, read_journal(journal).readings
    return run


def _session(
    run: Run, log: BrickLog, clock: VirtualClock, asked: Experiment, *, seed: int, journal: Path
) -> str | None:
    """Go on until the run or the line ends; say how the line did."""
    start_s = read_journal(journal).readings[-1].time_s if run.taken else 0.0
    arm = connected(log, clock, run, start_s=start_s)
    try:
        with arm:
            rng = np.random.default_rng(seed)
            run.steps = list(explore(arm, asked, rng=rng, max_readings=MAX_READINGS, journal=journal))
    except LinkError as error:
        return f"{type(error).__name__}: {error}"
    finally:
        run.longest_s = max(run.longest_s, arm.link.longest_s)
    return None


def _is_lit(bench: EmulatedBench) -> bool:
    """Ask the brick, past the line, whether its port feeds the LED."""
    return bench.radio.brick.answer(bytes((0, LIGHT, GEOMETRY.sensor_port)))[5] == LED_ON


def _comes_to_rest(bench: EmulatedBench, clock: VirtualClock) -> bool:
    """Tell whether nothing turns any more once the last move has come to its end, and nothing then starts to."""
    clock.sleep(QUIET_S)
    bench.radio.brick.advance()
    before = [motor.angle_deg for motor in bench.arm.motors()]
    clock.sleep(1.0)
    bench.radio.brick.advance()
    return before == [motor.angle_deg for motor in bench.arm.motors()]


def wrong(run: Run) -> list[str]:
    """Name the readings that are not what the brick answered last, where and when it did."""
    found = []
    for number, taken in enumerate(run.taken, start=1):
        reading, answer = taken.reading, taken.answer
        if answer is None:
            found.append(f"reading {number} was never answered")
            continue
        shown = math.floor(answer.percent) if GEOMETRY.whole_percent else answer.percent
        if taken.percent != answer.percent or reading.value != min(max(shown, 1.0), 100.0):
            found.append(f"reading {number} is {reading.value:g} of {taken.percent:.2f} %, not {answer.percent:.2f} %")
        stand = answer.stand
        away_mm = math.dist((reading.pose.x_mm, reading.pose.y_mm), (stand.x_mm, stand.y_mm))
        if away_mm > PLACE_MM:
            found.append(f"reading {number} was taken {away_mm:.1f} mm from where it says")
        turned_deg = math.degrees(math.remainder(reading.pose.orientation_rad - stand.orientation_rad, math.tau))
        if abs(turned_deg) > TURN_DEG:
            found.append(f"reading {number} was taken {turned_deg:.1f} degrees from how it says")
        if abs(stand.height_mm - GEOMETRY.read_height_mm) > HEIGHT_MM:
            found.append(f"reading {number} was taken {stand.height_mm:.1f} mm above the surface")
        off_mv = reading.covariates["battery_mv"] - answer.battery_mv
        if abs(off_mv) > BATTERY_MV:
            found.append(f"reading {number} has a battery that is {off_mv:.0f} mV off")
        expected = expected_at(stand)
        if abs(reading.value - expected) > 1 + 4 * float(SENSOR.noise_sd.mean()) + 0.05 * expected:
            found.append(f"reading {number} is {reading.value:g}, {expected:.1f} at its place")
    return found


def lost(run: Run) -> int:
    """Count the readings that the driver had and did not give, or that did not come to the journal."""
    kept = Counter(map(_key, run.journal))
    return run.n_read - len(run.taken) + (Counter(_key(taken.reading) for taken in run.taken) - kept).total()


def twice(run: Run) -> int:
    """Count the answers of the brick that became more than one reading, and the journal's lines that nobody took."""
    answers = [taken.number for taken in run.taken if taken.number is not None]
    kept = Counter(map(_key, run.journal))
    return len(answers) - len(set(answers)) + (kept - Counter(_key(taken.reading) for taken in run.taken)).total()


def _key(reading: Reading) -> tuple[float, Pose, float]:
    return reading.value, reading.pose, reading.time_s


def violations(run: Run) -> list[str]:
    """Name what a run may not do, where it did it."""
    if not run.steps:
        return [f"no end after {len(run.endings)} sessions: {run.endings[-1]}"]
    given = [taken.reading for taken in run.taken]
    found = wrong(run)
    if lost(run) or twice(run):
        found.append(f"{lost(run)} readings lost, {twice(run)} twice")
    if [*map(_key, run.journal)] != [*map(_key, given)]:
        found.append(f"the journal's {len(run.journal)} readings are not the {len(given)} that were taken, in order")
    if len(run.steps) != len(given):
        found.append(f"{len(run.steps)} steps from {len(given)} readings")
    if any(after <= before for before, after in zip(*[[r.time_s for r in given[k:]] for k in (0, 1)], strict=False)):
        found.append("times that do not grow")
    if run.longest_s > LONGEST_S:
        found.append(f"a question took {run.longest_s:.1f} s")
    if run.n_left_running:
        found.append(f"motors left running after {run.n_left_running} sessions")
    if run.n_left_lit:
        found.append(f"the LED left on after {run.n_left_lit} sessions whose line stood")
    if "is known" not in str(run.steps[-1].stop_reason):
        found.append(f"the run ended with: {run.steps[-1].stop_reason}")
    if run.found_mm > MISSED_MM:
        found.append(f"the circle missed by {run.found_mm:.1f} mm")
    return found


def expected_at(stand: SensorPose) -> float:
    """Return the mean of what the world shows at a place."""
    disc, rng = Disc(TRUTH[:2], TRUTH[2]), np.random.default_rng(0)
    reads = [WORLD.read(disc, stand.x_mm, stand.y_mm, stand.orientation_rad, time_s=0.0, rng=rng) for _ in range(9)]
    return float(np.mean(reads))


def injected(run: Run, name: str) -> int:
    """Count the mishaps of a run that its fault brought; a byte dropped from a reply is one."""
    return run.mishaps.total() if name == "all" else run.mishaps[{"delay": "late"}.get(name, name)]


def under(name: str, share: int, seed: int, bar: tqdm) -> dict[str, object]:
    """Run on under a fault until as many mishaps as its share have happened, once at least."""
    asked, runs, began_s = experiment(), [], time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        while not runs or sum(injected(run, name) for run in runs) < share:
            at = Path(folder) / f"{len(runs)}.jsonl"
            runs.append(explored(asked, FAULTS[name], seed=seed + len(runs), journal=at))
            bar.update(injected(runs[-1], name))
    return {
        "injections": sum(injected(run, name) for run in runs),
        "runs": len(runs),
        "readings": sum(len(run.taken) for run in runs),
        "wrong": sum(len(wrong(run)) for run in runs),
        "lost": sum(lost(run) for run in runs),
        "twice": sum(twice(run) for run in runs),
        "sessions_that_ended": sum(len(run.endings) for run in runs),
        "longest_question_s": round(max(run.longest_s for run in runs), 2),
        "largest_error_mm": round(max((run.found_mm for run in runs if run.steps), default=math.inf), 2),
        "violations": [text for run in runs for text in violations(run)],
        "endings": dict(Counter(text.split(":")[0] for run in runs for text in run.endings)),
        "cpu_s": round(time.process_time() - began_s, 1),
    }


def campaign(n_injections: int, seed: int, partial: Path | None) -> dict[str, dict[str, object]]:
    """Run under each fault in turn; what is done already stands in the partial file."""
    found = json.loads(partial.read_text(encoding="utf-8")) if partial is not None and partial.exists() else {}
    share = math.ceil(n_injections / (len(FAULTS) - 1))
    with tqdm(total=n_injections, initial=sum(part["injections"] for part in found.values()), unit="fault") as bar:
        for name in FAULTS:
            if name in found:
                continue
            bar.set_description(name)
            # A sagging battery is no mishap of a moment: one run of it.
            found[name] = under(name, 0 if name == "sag" else share, seed, bar)
            if partial is not None:
                fresh = partial.with_suffix(".new")
                fresh.write_text(json.dumps(found), encoding="utf-8")
                os.replace(fresh, partial)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--injections", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    out = arguments.out
    partial = None if out is None else out.with_name(f"{out.name}.{arguments.injections}-{arguments.seed}.partial")
    faults = campaign(arguments.injections, arguments.seed, partial)
    counted = ("injections", "runs", "readings", "wrong", "lost", "twice", "sessions_that_ended")
    found = {
        "command": f"python benchmarks/arm_faults.py --injections {arguments.injections} --seed {arguments.seed}",
        "seed": arguments.seed,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "deadline_of_a_question_s": LONGEST_S,
        "in_all": {name: sum(part[name] for part in faults.values()) for name in counted},
        "faults": faults,
    }
    text = json.dumps(found, indent=1)
    print(text)
    if out is not None:
        out.write_text(text + "\n", encoding="utf-8")
        partial.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
