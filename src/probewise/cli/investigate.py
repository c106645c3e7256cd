"""`probewise investigate`: record, diagnose, take the advised readings, repeat."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from probewise._signals import reporting_what_is_kept
from probewise._writing import Drawings, checked_output_directory
from probewise.cli import _common as common
from probewise.cli._arm import (
    SHIPPED,
    ArmName,
    add_arm,
    add_geometry,
    parse_arm,
    parse_place,
    read_or_shipped_geometry,
    read_or_shipped_plan,
)
from probewise.errors import ParameterError

if TYPE_CHECKING:
    import numpy as np

    from probewise._writing import StagedFiles
    from probewise.arm import Reading
    from probewise.investigation import RoundsFolder, Take
    from probewise.recordings import Plan
    from probewise.world import World


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options of `probewise investigate`."""
    add_arm(parser)
    about = f"the first plan: a plan or recording, its JSON beside it; or {' or '.join(SHIPPED)}, which ship"
    common.add(parser, "--plan PLAN.csv", about, required=True)
    about = (
        "where on the field the plan's origin lies (default: the field's middle; with FILE.py 0,0; none with simulated)"
    )
    common.add(parser, "--origin-mm X,Y", about)
    add_geometry(parser)
    common.add_out(parser)
    common.add(
        parser, "--sensor S.json", "an earlier calibration, whose posterior becomes the prior", type=common.parse_path
    )
    about = (
        "effect concealed in the simulated world, such as backlash:0.5 or nothing; several joined by + (default: "
        "one effect drawn from the seed, named at the end)"
    )
    common.add(parser, "--truth NAME:V,V", about)
    about = "largest number of readings beyond the first plan (default 400)"
    common.add(parser, "--readings N", about, type=common.parse_count, default=400)
    about = "largest number of minutes beyond the first plan (default: no limit)"
    common.add(parser, "--minutes M", about, type=common.positive_number_parser("minutes"), default=math.inf)
    about = "largest number of rounds, including the first (default 6)"
    common.add(parser, "--rounds N", about, type=common.parse_count, default=6)
    common.add(parser, "--no-hands", "no person turns or exchanges sheets: take only readings over the sheet in place")
    common.add(parser, "--resume", "resume from the rounds in DIR")
    common.add_seed_and_quiet(parser)


def run(arguments: argparse.Namespace) -> int:
    """Record and diagnose in rounds, save every reading, and write the report; return the exit status."""
    import hashlib

    import numpy as np

    from probewise._progress import progress_shown
    from probewise.calibration import read_sensor
    from probewise.cli.diagnose import OF_ONE_RUN, write_files
    from probewise.diagnosis import NEXT_PLAN, join
    from probewise.investigation import Budget, Investigation, RoundsFolder, SimulatedRecorder, investigate
    from probewise.recordings import Recording, fingerprint, write_recording
    from probewise.report import diagnosis as of_a_diagnosis
    from probewise.report import investigation as report

    out = checked_output_directory(arguments.out, "rounds", main="diagnosis.json")
    chosen = parse_arm(arguments.arm)
    if arguments.truth is not None and chosen.kind != "simulated":
        raise ParameterError("--truth", arguments.truth, f"none with {arguments.arm}: it is for the simulated arm")
    idle = {"simulated": ("origin_mm", "geometry"), "file": ("geometry",)}.get(chosen.kind, ())
    common.refuse_options(arguments, f"{arguments.arm}, which has no use for it", *idle)
    plan = _first_plan(arguments, chosen)
    sensor = None if arguments.sensor is None else read_sensor(arguments.sensor)
    truth_seed, noise_seed, rounds_seed, files_seed = np.random.SeedSequence(arguments.seed).spawn(4)
    noise = int(noise_seed.generate_state(1)[0])
    world = (
        _shipped_world_with_effects(arguments.truth, np.random.default_rng(truth_seed))
        if chosen.kind == "simulated"
        else None
    )
    settings = {
        "arm": arguments.arm,
        "plan": fingerprint(Recording(plan, np.zeros(len(plan)))),
        "sensor": None if arguments.sensor is None else hashlib.sha256(arguments.sensor.read_bytes()).hexdigest(),
        "truth": arguments.truth,
        "hands": not arguments.no_hands,
        "seed": str(arguments.seed),
    }
    folder = RoundsFolder(out / "rounds", settings, resume=arguments.resume)

    def kept_message() -> str:
        return common.message_to_resume(folder.path, folder.n_readings, "reading", arguments, "--resume")

    common.print_result(f"seed {arguments.seed}", quiet=arguments.quiet)
    rounds = []
    with contextlib.ExitStack() as stack:
        stack.enter_context(reporting_what_is_kept(kept_message))
        if world is None:
            take = stack.enter_context(_opened_plan_runner(arguments, chosen, folder, seed=noise))
        else:
            take = SimulatedRecorder(world, noise)
        progress = stack.enter_context(progress_shown(quiet=arguments.quiet))
        for each in investigate(
            partial(folder.record_round, take=take, progress=progress),
            plan,
            sensor=sensor,
            budget=Budget(arguments.readings, arguments.minutes),
            rounds=arguments.rounds,
            hands=not arguments.no_hands,
            rng=np.random.default_rng(rounds_seed),
            progress=progress,
        ):
            rounds.append(each)
    found = Investigation(tuple(rounds))
    diagnosis = found.last.diagnosis
    read = [] if arguments.plan in SHIPPED else [Path(arguments.plan)]
    read += [] if arguments.sensor is None else [arguments.sensor]
    drawings = Drawings(out)
    figures = of_a_diagnosis.figure_drawers(diagnosis) | {"by_round.png": partial(report.probabilities_png, found)}
    concealed = None if world is None else tuple(effect.name for effect in world.concealed)

    def write_all_files(stage: StagedFiles) -> None:
        write_files(diagnosis, stage, rng=np.random.default_rng(files_seed))
        write_recording(join([each.recording for each in rounds]), stage / "recording.csv")

    with reporting_what_is_kept(kept_message, results=True), progress_shown(quiet=arguments.quiet) as progress:
        renamed = drawings.write_results(
            write_all_files,
            figures,
            lambda drawn: report.page_html(
                found, drawn, source=arguments.arm, seed=arguments.seed, concealed=concealed
            ),
            inputs=common.inputs_and_filled_in_plan(read, out / NEXT_PLAN),
            outdated=OF_ONE_RUN,
            progress=progress,
        )
    known = [] if concealed is None else [f"concealed    {', '.join(concealed) or 'nothing'}"]
    return common.finish(drawings, found.summary(), *known, *renamed, f"written to {out}", quiet=arguments.quiet)


def _first_plan(arguments: argparse.Namespace, chosen: ArmName) -> Plan:
    """Read the first plan and adapt it to the chosen arm; raise ParameterError if --no-hands cannot carry it out."""
    from probewise.cli._bench import plan_for_lego_arm, plan_for_own_instrument

    plan = read_or_shipped_plan(arguments.plan)
    if chosen.kind == "simulated":
        return plan
    if arguments.no_hands and len(set(plan.pattern.tolist())) > 1:
        raise ParameterError(
            "--no-hands", True, f"a plan over one pattern; {arguments.plan} has several, which a person must exchange"
        )
    if chosen.kind == "file":
        return plan_for_own_instrument(plan)
    return plan_for_lego_arm(plan, read_or_shipped_geometry(arguments))


@contextlib.contextmanager
def _opened_plan_runner(
    arguments: argparse.Namespace, chosen: ArmName, folder: RoundsFolder, *, seed: int
) -> Iterator[Take]:
    """Open an arm; yield the function that takes a plan's readings with it. A person or the bench lays the sheets."""
    from probewise.arm import RequestToPerson, carry_out
    from probewise.cli._bench import open_arm_and_bench, prompter, warn_and_confirm_lowering

    geometry = read_or_shipped_geometry(arguments)
    width, height = (0.0, 0.0) if chosen.kind == "file" else geometry.field_mm
    origin = (width / 2, height / 2)
    if arguments.origin_mm is not None:
        origin = parse_place("--origin-mm", arguments.origin_mm)
    opened, bench = open_arm_and_bench(
        chosen, geometry, arguments.geometry, seed=seed, start_s=folder.last_time_s, n_taken=folder.n_readings
    )
    warn_and_confirm_lowering(chosen, opened, geometry)
    with opened as arm:
        by_hand, laid = prompter(arm), list[str]()
        if bench is None and not arguments.no_hands:
            arm.mounted_rad = math.nan  # an earlier process may have left the sensor turned

        def take_readings(number: int, plan: Plan, asked: str, taken: Sequence[Reading]) -> Iterator[Reading]:
            def ask(request: RequestToPerson) -> None:
                if bench is not None:
                    bench.carry_out_request(plan.patterns, origin, request)
                elif not arguments.no_hands:
                    by_hand(request)
                elif request.pattern is None or laid:
                    raise common.CommandError(
                        f"with --no-hands nobody can {request}; leave it out, or take another plan"
                    )
                laid.extend([] if request.pattern is None else [request.pattern])

            return carry_out(arm, plan, origin_mm=origin, ask=ask, first=len(taken))

        yield take_readings


def _shipped_world_with_effects(truth: str | None, rng: np.random.Generator) -> World:
    """Build the world of the shipped recordings with the effects in `truth` concealed; None: one drawn effect."""
    from dataclasses import replace

    from probewise.investigation import parse_concealed
    from probewise.world.shipped import CANDIDATES
    from probewise.world.shipped import true_world as world_behind

    concealed = (CANDIDATES[int(rng.integers(len(CANDIDATES)))],) if truth is None else parse_concealed(truth)
    return replace(world_behind("paper"), concealed=concealed)
