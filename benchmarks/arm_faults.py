"""The whole autonomous run with the LEGO arm on the emulator, under every fault that its radio link may have.

    python benchmarks/arm_faults.py --injections 1000 --seed 1 --out docs/results/arm_faults.json

The robot looks for a circle; the line fails, is opened again, and the run goes on from its journal. The clock is
one that nobody waits for. What must not happen is counted: see `violations`.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from probewise.arm import LegoArm, Pose, Reading, read_geometry, shipped_geometry
from probewise.arm.nxt import Brick, BrickMachine, Link, Timing
from probewise.calibration import FittedSensor
from probewise.emulator import Bench, Faults, Stand, VirtualClock, VirtualLine, set_up
from probewise.emulator import read_geometry as read_numbers
from probewise.errors import LinkError
from probewise.experiment import Experiment, Step, experiment_for, explore, read_journal, world_like
from probewise.inquiry import Grid
from probewise.recordings import Disc, Instrumentation
from probewise.scene import Circle, Field
from probewise.sensor import field_of, footprint_of

FAULTS = {
    "fragment": Faults(fragment=0.5),
    "late": Faults(late=0.03, late_s=2.5),
    "drop": Faults(drop=0.003),
    "silence": Faults(silence=0.03),
    "deaf": Faults(deaf=0.03),
    "unasked": Faults(unasked=0.2),
    "disconnect": Faults(disconnect=0.01),
    "sag": Faults(sag=300.0),
}
"""More often than on a bad day; the battery is empty after six minutes."""

TRUTH = (600.0, 250.0, 120.0)
GEOMETRY = read_geometry(shipped_geometry())
MAX_READINGS = 60
MAX_SESSIONS = 200
QUIET_S = 10.0  # the longest limited move, with its run-on
MISSED_MM = 16.0  # four times the sd at which a run stops
PLACE_MM = 2.0  # a motor's count, play and the way that a count makes at the far end of the arm


def sensor() -> FittedSensor:
    """Make a sensor as a calibration would leave it, known almost exactly: one Gaussian, off the centre."""
    mean = np.array([0.5, 0.0, 1.5, 1 / 32, 1 / 12.5, 0.0, 10.0, 60.0])
    axis = np.arange(-20.0, 20.5)
    return FittedSensor(
        names=("a_1", "u_1", "v_1", "A_1", "B_1", "C_1", "I_min", "I_max"),
        samples=mean + 1e-4 * np.random.default_rng(0).standard_normal((500, 8)),
        n_gaussians=1,
        noise_sd=np.full(500, 0.6),
        field=field_of(footprint_of(mean[None, :6], 1), u_mm=axis, v_mm=axis),
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

    def ask(self, request):
        began_s = self._clock.monotonic()
        try:
            return super().ask(request)
        finally:
            self.longest_s = max(self.longest_s, self._clock.monotonic() - began_s)


class WatchedArm(LegoArm):
    """An arm that remembers each reading that it gave, and where the sensor truly stood when it was taken."""

    def __init__(self, machine, geometry, *, taken, stand, clock, start_s):
        super().__init__(machine, geometry, clock=clock, start_s=start_s)
        self.link = machine.brick.link
        self._taken, self._stands = taken, []
        read = machine.read_percent
        machine.read_percent = lambda: (self._stands.append(stand()), read())[1]

    def measure(self, pose):
        reading = super().measure(pose)
        self._taken.append(Taken(pose, reading, self._stands[-1]))
        return reading


@dataclass(frozen=True)
class Taken:
    """A reading, the pose that was asked for, and where the sensor truly stood."""

    asked: Pose
    reading: Reading
    stand: Stand


@dataclass
class Run:
    """What happened in one run, over all its sessions."""

    steps: list[Step] = field(default_factory=list)
    taken: list[Taken] = field(default_factory=list)
    journal: tuple[Reading, ...] = ()
    mishaps: Counter[str] = field(default_factory=Counter)
    endings: list[str] = field(default_factory=list)
    longest_s: float = 0.0
    n_left_running: int = 0

    @property
    def found_mm(self) -> float:
        """Largest error of the circle's three lengths."""
        return float(np.abs(self.steps[-1].mean - TRUTH).max())


def bench_with(faults: Faults, clock: VirtualClock, *, seed: int) -> Bench:
    """Set up the arm over the circle."""
    circle = Disc(TRUTH[:2], TRUTH[2])
    return set_up(read_numbers(shipped_geometry()), WORLD, circle, clock, seed=seed, faults=faults)


def connected(bench: Bench, clock: VirtualClock, taken: list[Taken], *, start_s: float = 0.0) -> WatchedArm:
    """Open the line to it; what is measured is added to `taken`."""
    machine = BrickMachine(Brick(TimedLink(VirtualLine(bench.radio, clock), clock=clock), clock=clock), GEOMETRY)
    return WatchedArm(machine, GEOMETRY, taken=taken, stand=bench.arm.stand, clock=clock, start_s=start_s)


def explored(asked: Experiment, faults: Faults, *, seed: int, journal: Path) -> Run:
    """Let the robot find the circle, opening the line again and going on from the journal whenever it ends."""
    clock, run = VirtualClock(), Run()
    bench = bench_with(faults, clock, seed=seed)
    for _ in range(MAX_SESSIONS):
        ended = _session(run, bench, clock, asked, seed=seed, journal=journal)
        run.n_left_running += not _comes_to_rest(bench, clock)
        if ended is None:
            break
        run.endings.append(ended)
    run.mishaps, run.journal = bench.radio.mishaps, read_journal(journal).readings
    return run


def _session(run: Run, bench: Bench, clock: VirtualClock, asked: Experiment, *, seed: int, journal: Path) -> str | None:
    """Go on until the run or the line ends; say how the line did."""
    start_s = read_journal(journal).readings[-1].time_s if run.taken else 0.0
    arm = connected(bench, clock, run.taken, start_s=start_s)
    try:
        with arm:
            rng = np.random.default_rng(seed)
            run.steps = list(explore(arm, asked, rng=rng, max_readings=MAX_READINGS, journal=journal))
    except LinkError as error:
        return f"{type(error).__name__}: {error}"
    finally:
        run.longest_s = max(run.longest_s, arm.link.longest_s)
    return None


def _comes_to_rest(bench: Bench, clock: VirtualClock) -> bool:
    """Tell whether nothing turns any more once the last move has come to its end, and nothing then starts to."""
    clock.sleep(QUIET_S)
    bench.radio.brick.advance()
    before = [motor.angle_deg for motor in bench.arm.motors()]
    clock.sleep(1.0)
    bench.radio.brick.advance()
    return before == [motor.angle_deg for motor in bench.arm.motors()]


def violations(run: Run) -> list[str]:
    """Name what a run may not do, where it did it."""
    wrong = []
    if not run.steps:
        return [f"no end after {len(run.endings)} sessions: {run.endings[-1]}"]
    given = [taken.reading for taken in run.taken]
    if [(r.value, r.pose, r.time_s) for r in run.journal] != [(r.value, r.pose, r.time_s) for r in given]:
        wrong.append(f"the journal's {len(run.journal)} readings are not the {len(given)} that were taken")
    if len(run.steps) != len(given):
        wrong.append(f"{len(run.steps)} steps from {len(given)} readings")
    if any(after <= before for before, after in zip(*[[r.time_s for r in given[k:]] for k in (0, 1)], strict=False)):
        wrong.append("times that do not grow")
    for number, taken in enumerate(run.taken, start=1):
        reading, stand = taken.reading, taken.stand
        away_mm = math.dist((reading.pose.x_mm, reading.pose.y_mm), (stand.x_mm, stand.y_mm))
        if away_mm > PLACE_MM:
            wrong.append(f"reading {number} was taken {away_mm:.1f} mm from where it says")
        expected = expected_at(stand)
        if abs(reading.value - expected) > 1 + 4 * float(SENSOR.noise_sd.mean()) + 0.05 * expected:
            wrong.append(f"reading {number} is {reading.value:g}, {expected:.1f} at its place")
    if run.longest_s > Timing().longest_s:
        wrong.append(f"a question took {run.longest_s:.1f} s")
    if run.n_left_running:
        wrong.append(f"motors left running after {run.n_left_running} sessions")
    if "is known" not in str(run.steps[-1].stop_reason):
        wrong.append(f"the run ended with: {run.steps[-1].stop_reason}")
    if run.found_mm > MISSED_MM:
        wrong.append(f"the circle missed by {run.found_mm:.1f} mm")
    return wrong


def expected_at(stand: Stand) -> float:
    """Return the mean of what the world shows at a place."""
    disc, rng = Disc(TRUTH[:2], TRUTH[2]), np.random.default_rng(0)
    reads = [WORLD.read(disc, stand.x_mm, stand.y_mm, stand.orientation_rad, time_s=0.0, rng=rng) for _ in range(9)]
    return float(np.mean(reads))


def campaign(n_injections: int, seed: int) -> dict[str, object]:
    """Run on under each fault in turn until as many mishaps as its share of the injections have happened."""
    asked, found = experiment(), {}
    with tempfile.TemporaryDirectory() as folder:
        for name, faults in FAULTS.items():
            runs: list[Run] = []
            began_s = time.process_time()
            # A sagging battery is no mishap of a moment: one run of it.
            share = 0 if name == "sag" else math.ceil(n_injections / (len(FAULTS) - 1))
            while not runs or sum(run.mishaps[name] for run in runs) < share:
                at = Path(folder) / f"{name}{len(runs)}.jsonl"
                runs.append(explored(asked, faults, seed=seed + len(runs), journal=at))
            found[name] = {
                "injections": sum(run.mishaps[name] for run in runs),
                "runs": len(runs),
                "readings": sum(len(run.taken) for run in runs),
                "sessions_that_ended": sum(len(run.endings) for run in runs),
                "longest_question_s": round(max(run.longest_s for run in runs), 2),
                "largest_error_mm": round(max(run.found_mm for run in runs if run.steps), 2),
                "violations": [wrong for run in runs for wrong in violations(run)],
                "cpu_s": round(time.process_time() - began_s, 1),
            }
            print(name, json.dumps(found[name]), flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--injections", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    found = {
        "command": f"python benchmarks/arm_faults.py --injections {arguments.injections} --seed {arguments.seed}",
        "seed": arguments.seed,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "deadline_of_a_question_s": Timing().longest_s,
        "faults": campaign(arguments.injections, arguments.seed),
    }
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
