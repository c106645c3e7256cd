"""`probewise investigate`: record, diagnose, take the advised readings, repeat."""

import argparse
import contextlib
import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from probewise._signals import reporting_what_is_kept
from probewise._writing import Drawings, checked_output_directory, hold_lock
from probewise.arm import Reading, RequestToPerson, carry_out
from probewise.calibration import read_sensor
from probewise.cli import _bench as benches
from probewise.cli._common import CommandError, finish, message_to_resume, progress_of, say
from probewise.cli._inputs import read_or_shipped_geometry, read_or_shipped_plan, tables_and_descriptions
from probewise.cli._options import SHIPPED, refuse_options
from probewise.errors import ParameterError
from probewise.investigation import (
    Budget,
    Investigation,
    RoundsFolder,
    SimulatedRecorder,
    Take,
    investigate,
    parse_concealed,
)
from probewise.recordings import Plan, Recording, fingerprint
from probewise.report.investigation import output_of
from probewise.world import World
from probewise.world.shipped import CANDIDATES, true_world


def run(arguments: argparse.Namespace) -> int:
    """Record and diagnose in rounds, save every reading, and write the report; return the exit status."""
    out = checked_output_directory(arguments.out, "rounds", main="diagnosis.json")
    chosen = benches.parse_arm(arguments.arm)
    simulated = chosen.kind == "simulated"
    if not simulated:
        refuse_options(arguments, f"{arguments.arm}: it is for the simulated arm", "truth")
    idle = {"simulated": ("origin_mm", "geometry"), "file": ("geometry",)}.get(chosen.kind, ())
    refuse_options(arguments, f"{arguments.arm}, which has no use for it", *idle)
    plan = _first_plan(arguments, chosen)
    sensor = None if arguments.sensor is None else read_sensor(arguments.sensor)
    truth_seed, noise_seed, rounds_seed, files_seed = np.random.SeedSequence(arguments.seed).spawn(4)
    noise = int(noise_seed.generate_state(1)[0])
    world = _shipped_world_with_effects(arguments.truth, np.random.default_rng(truth_seed)) if simulated else None
    settings = {
        "arm": arguments.arm,
        "plan": fingerprint(Recording(plan, np.zeros(len(plan)))),
        "sensor": None if arguments.sensor is None else hashlib.sha256(arguments.sensor.read_bytes()).hexdigest(),
        "truth": arguments.truth,
        "hands": not arguments.no_hands,
        "seed": str(arguments.seed),
    }
    folder = RoundsFolder(out / "rounds", settings, resume=arguments.resume)

    kept_message = partial(message_to_resume, folder.path, lambda: folder.n_readings, "reading", arguments, "--resume")
    say(arguments, f"seed {arguments.seed}")
    with contextlib.ExitStack() as stack:
        stack.enter_context(reporting_what_is_kept(kept_message))
        if world is None:
            take = stack.enter_context(_opened_plan_runner(arguments, chosen, folder, seed=noise))
        else:
            take = SimulatedRecorder(world, noise)
        out.mkdir(parents=True, exist_ok=True)
        stack.enter_context(hold_lock(folder.path))
        progress = stack.enter_context(progress_of(arguments))
        rounds = investigate(
            partial(folder.record_round, take=take, progress=progress),
            plan,
            sensor=sensor,
            budget=Budget(arguments.readings, arguments.minutes),
            rounds=arguments.rounds,
            hands=not arguments.no_hands,
            rng=np.random.default_rng(rounds_seed),
            progress=progress,
        )
        found = Investigation(tuple(rounds))
    read = [*([] if arguments.plan in SHIPPED else [Path(arguments.plan)]), *filter(None, [arguments.sensor])]
    drawings = Drawings(out)
    concealed = None if world is None else tuple(effect.name for effect in world.concealed)

    files_rng = np.random.default_rng(files_seed)
    made = output_of(found, seed=arguments.seed, rng=files_rng, source=arguments.arm, concealed=concealed)
    with reporting_what_is_kept(kept_message, results=True), progress_of(arguments) as progress:
        drawings.write_results(made, inputs=tables_and_descriptions(read), progress=progress)
    known = [] if concealed is None else [f"concealed    {', '.join(concealed) or 'nothing'}"]
    return finish(arguments, drawings, found.summary(), *known, f"written to {out}")


def _first_plan(arguments: argparse.Namespace, chosen: benches.ArmName) -> Plan:
    """Read the first plan and adapt it to the chosen arm; raise ParameterError if --no-hands cannot carry it out."""
    plan = read_or_shipped_plan(arguments.plan)
    if chosen.kind == "simulated":
        return plan
    if arguments.no_hands and len(set(plan.pattern.tolist())) > 1:
        allowed = f"a plan over one pattern; {arguments.plan} has several, which a person must exchange"
        raise ParameterError("--no-hands", True, allowed)
    if chosen.kind == "file":
        return benches.plan_for_own_instrument(plan)
    return benches.plan_for_lego_arm(plan, read_or_shipped_geometry(arguments))


@contextlib.contextmanager
def _opened_plan_runner(
    arguments: argparse.Namespace, chosen: benches.ArmName, folder: RoundsFolder, *, seed: int
) -> Iterator[Take]:
    """Open an arm; yield the function that takes a plan's readings with it. A person or the bench lays the sheets."""
    geometry = read_or_shipped_geometry(arguments)
    origin = benches.origin_of_plan(arguments, geometry, is_own=chosen.kind == "file")
    opened, bench = benches.open_arm(
        chosen, geometry, arguments.geometry, seed=seed, start_s=folder.last_time_s, n_taken=folder.n_readings
    )
    benches.confirm_lowering(chosen, opened, geometry)
    with opened as arm:
        by_hand, laid = benches.prompter(arm), list[str]()
        if bench is None and not arguments.no_hands:
            arm.mounted_rad = math.nan  # an earlier process may have left the sensor turned

        def take_readings(number: int, plan: Plan, asked: str, taken: Sequence[Reading]) -> Iterator[Reading]:
            def ask(request: RequestToPerson) -> None:
                if bench is not None:
                    bench.carry_out_request(plan.patterns, origin, request)
                elif not arguments.no_hands:
                    by_hand(request)
                elif request.pattern is None or laid:
                    raise CommandError(f"with --no-hands nobody can {request}; leave it out, or take another plan")
                laid.extend([] if request.pattern is None else [request.pattern])

            return carry_out(arm, plan, origin_mm=origin, ask=ask, first=len(taken))

        yield take_readings


def _shipped_world_with_effects(truth: str | None, rng: np.random.Generator) -> World:
    """Build the world of the shipped recordings with the effects in `truth` concealed; None: one drawn effect."""
    concealed = (CANDIDATES[int(rng.integers(len(CANDIDATES)))],) if truth is None else parse_concealed(truth)
    return replace(true_world("paper"), concealed=concealed)
