"""A simulated bench for the tasks of `arm`: a table on which the program itself lays the patterns."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probewise.arm import LegoArm, OwnInstrument, Reading, ReadingScale, RequestToPerson, SimulatedArm
from probewise.cli._arm import SCENE, ArmName, open_emulated_arm_and_bench, open_nxt_arm, open_own_instrument
from probewise.cli._common import DEFAULT_SEED
from probewise.emulator import Tabletop, parse_scene
from probewise.errors import ParameterError
from probewise.recordings import Disc, HalfPlane, Image, Pattern, Polygon, Quadrant, Ramp, Stripes, Uniform

if TYPE_CHECKING:
    from probewise.arm import Geometry, Pose
    from probewise.cli._marks import MarkQuestion
    from probewise.emulator import SensorPose
    from probewise.recordings import Instrumentation
    from probewise.world import Surface, World

_SEEN_MM = 0.5  # least offset of the sensor from a mark that a simulated person notices
_TOUCHES_MM = 0.5  # least gap above the block that a simulated person notices


class SimulatedBench:
    """A table under a simulated or an emulated arm.

    Parameters
    ----------
    world
        World of the sensor.
    scene
        Initial target, in the format of `emulate-nxt`.
    scale
        Rounding and range of the simulated arm's readings.
    seed
        Seed of the noise.
    n_taken
        Number of readings of an earlier session, after which the noise continues.
    """

    def __init__(self, world: World, scene: str, *, scale: ReadingScale, seed: int, n_taken: int = 0) -> None:
        self._world, self._scale, self._seed, self._n_taken = world, scale, seed, n_taken
        self._table = Tabletop(parse_scene(scene))
        self._stand: Callable[[], SensorPose] | None = None

    def open_simulated_arm(self, geometry: Geometry | None, *, start_s: float = 0.0) -> SimulatedArm:
        """Return the simulated arm over the table; its sensor takes any orientation."""
        number = itertools.count(self._n_taken)

        def read_world(pose: Pose, time_s: float, height_mm: float) -> float:
            rng = np.random.default_rng([self._seed, next(number)])
            place = (pose.x_mm, pose.y_mm, pose.orientation_rad)
            return self._world.read(self._table.surface, *place, time_s=time_s, rng=rng, height_mm=height_mm)

        make = partial(SimulatedArm, read_world, reach=geometry, scale=self._scale, height_mm=self._world.height_mm)
        rest = make().pose
        return make(last=Reading(math.nan, rest, start_s))

    def open_emulated_arm(self, geometry: Geometry, geometry_file: Path | None, *, start_s: float = 0.0) -> LegoArm:
        """Return the LEGO arm over the table, on an emulated brick."""
        surface, seed = self._table.surface, self._seed + self._n_taken
        arm, bench = open_emulated_arm_and_bench(
            geometry, geometry_file, self._world, surface, seed=seed, start_s=start_s
        )
        self._table, self._stand = bench.table, bench.arm.sensor_pose
        return arm

    def answer_at_mark(self, question: MarkQuestion) -> str:
        """Answer like a person who watches the emulated arm's sensor over a mark: "ok", or moves such as "x 5 down 2".

        Raises
        ------
        ParameterError
            If the arm is not an emulated one.
        """
        if self._stand is None:
            raise ParameterError("--arm", "simulated", "emulator: the simulated arm has no position error to see")
        stand = self._stand()
        across = (question.mark_mm[0] - stand.x_mm, question.mark_mm[1] - stand.y_mm)
        gap_mm = stand.height_mm - question.block_mm
        words = [
            f"{axis} {round(2 * off) / 2:g}" for axis, off in zip("xy", across, strict=True) if abs(off) > _SEEN_MM
        ]
        if not words and gap_mm <= _TOUCHES_MM:
            return "ok"
        if gap_mm < -_TOUCHES_MM:
            words.append(f"up {round(-2 * gap_mm) / 2 + _TOUCHES_MM:g}")
        elif not words:
            words.append(f"down {max(min(gap_mm - _TOUCHES_MM / 2, gap_mm / 2 if gap_mm > 8 else gap_mm), 0.2):.1f}")
        return " ".join(words)

    def carry_out_request(self, patterns: Mapping[str, Pattern], origin_mm: tuple[float, float], request: str) -> None:
        """Carry out a request of `carry_out`: lay a pattern with its origin at `origin_mm`, or turn the sensor."""
        if isinstance(request, RequestToPerson) and request.pattern is not None:
            self._table.surface = shifted_pattern(patterns[request.pattern], origin_mm)
        if isinstance(request, RequestToPerson) and request.turned_rad is not None:
            self._table.turned_rad = request.turned_rad


def open_arm_and_bench(
    chosen: ArmName,
    geometry: Geometry,
    geometry_file: Path | None,
    *,
    sensor: Path | None = None,
    scene: str = SCENE,
    seed: int = DEFAULT_SEED,
    start_s: float = 0.0,
    n_taken: int = 0,
) -> tuple[LegoArm | OwnInstrument | SimulatedArm, SimulatedBench | None]:
    """Open an arm to carry out a plan; return it with its simulated bench, None for a real arm.

    Parameters
    ----------
    chosen
        The arm, from `parse_arm`.
    geometry, geometry_file
        Geometry of the LEGO arm, and its file if given; with a file, the simulated arm has its reach.
    sensor, scene, seed
        For a simulated or emulated arm: the file of its sensor, the initial target, the seed of the noise.
    start_s, n_taken
        Time at the start, and number of readings of an earlier session.

    Raises
    ------
    ParameterError
        If the brick cannot read in the sensor's unit.
    """
    if chosen.kind == "nxt":
        return open_nxt_arm(chosen.where, geometry, start_s=start_s), None
    if chosen.kind == "file":
        return open_own_instrument(chosen.where, start_s=start_s), None
    from probewise.experiment import scale_of

    world, instrumentation = world_and_instrumentation(sensor)
    if chosen.is_lego and instrumentation is not None and instrumentation.unit not in ("", "LEGO"):
        raise ParameterError("--sensor", str(sensor), "one that reads in LEGO units, as the brick does")
    scale = ReadingScale() if instrumentation is None else scale_of(instrumentation)
    bench = SimulatedBench(world, scene, scale=scale, seed=seed, n_taken=n_taken)
    if chosen.is_lego:
        return bench.open_emulated_arm(geometry, chosen.true_geometry_file(geometry_file), start_s=start_s), bench
    return bench.open_simulated_arm(None if geometry_file is None else geometry, start_s=start_s), bench


def world_and_instrumentation(sensor: Path | None) -> tuple[World, Instrumentation | None]:
    """Return the world and instrumentation of a sensor.json; for None the shipped recordings' world, and None."""
    if sensor is None:
        from probewise.world.shipped import true_world

        return true_world("paper"), None
    from probewise.calibration import read_sensor
    from probewise.experiment import world_like

    found = read_sensor(sensor)
    return world_like(found), found.instrumentation


def shifted_pattern(pattern: Pattern, by_mm: tuple[float, float]) -> Surface:
    """Return a pattern shifted by `by_mm`; raise ParameterError for a ramp, which cannot be shifted."""
    x_mm, y_mm = by_mm
    match pattern:
        case Uniform():
            return pattern
        case HalfPlane():
            return replace(pattern, offset_mm=pattern.offset_mm + _shift_along_normal_mm(pattern.normal_rad, by_mm))
        case Quadrant():
            return replace(pattern, corner_mm=(pattern.corner_mm[0] + x_mm, pattern.corner_mm[1] + y_mm))
        case Disc():
            return replace(pattern, center_mm=(pattern.center_mm[0] + x_mm, pattern.center_mm[1] + y_mm))
        case Polygon():
            return replace(pattern, vertices_mm=tuple((x + x_mm, y + y_mm) for x, y in pattern.vertices_mm))
        case Stripes():
            return replace(pattern, phase_mm=pattern.phase_mm + _shift_along_normal_mm(pattern.normal_rad, by_mm))
        case Image():
            return replace(pattern, origin_mm=(pattern.origin_mm[0] + x_mm, pattern.origin_mm[1] + y_mm))
        case Ramp():
            if by_mm != (0.0, 0.0):
                raise ParameterError("--origin-mm", by_mm, "0,0 with a ramp, which is given in field coordinates")
            return pattern


def _shift_along_normal_mm(normal_rad: float, by_mm: tuple[float, float]) -> float:
    return by_mm[0] * math.cos(normal_rad) + by_mm[1] * math.sin(normal_rad)
