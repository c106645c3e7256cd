"""Every effect alone through whole commands, report included: does any of them fail?

    python benchmarks/matrix.py --out matrix --workers 2
    python benchmarks/matrix.py --out ci --keys benchmarks/matrix_ci.txt
    python benchmarks/matrix.py --out again --keys matrix/matrix.json      what failed there

A cell conceals one effect, of a size lambda of 20 where it can be as large, in a recording as small as will do, and
runs commands on it as a person would. Every effect of the light sensor is diagnosed in a plan like the paper's, a
two-way plan and one with many readings at rest, and investigated in one of them; every form is diagnosed on three
systems; every effect that the study conceals is explored; every plan and every system is audited. A cell fails at an
exit status other than 0, a traceback, a warning that is not the project's own, JSON that is not strict, a file or
picture that is missing or broken, a report or console that says nan, inf or None, and a result that a notebook does
not show.

A stopped run resumes; it ends with matrix.json. `--cover SECONDS` prints the keys of a covering subset of it.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import dataclasses
import datetime
import fnmatch
import functools
import io
import json
import math
import re
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeAlias
from unittest import mock
from xml.etree import ElementTree

import numpy as np
from next_run import calibrated
from PIL import Image

from probewise import errors
from probewise._display import Reported, ShowsItself
from probewise._progress import progress_shown
from probewise.calibration import read_sensor, write_sensor
from probewise.cli import main as command_line
from probewise.experiment import TRUST, left_out_after_step
from probewise.proof.campaign import Campaign
from probewise.proof.concealed_study import CONCEALED
from probewise.proof.refits import NullRefit, SystemRefit
from probewise.proof.sensors import INSIDE, NEEDS_SENSOR, CleanSetup, Stratum
from probewise.proof.sensors import draw_effect_of_size as conceal_in_sensor
from probewise.proof.study import BRIGHT, DARK, footprint_pixels
from probewise.proof.systems.cases import (
    KINDS,
    OTHER_NOISE,
    DrawnSystem,
    SystemCase,
    draw_system,
    make_noise,
    write_system_case,
)
from probewise.proof.systems.cases import draw_effect_of_size as conceal_in_system
from probewise.proof.systems.forms import ADDED_FAMILIES, FAMILIES, Form, SystemEffect, family_of, forms_of
from probewise.recordings import Plan, paper_plan, two_way_plan, write_recording, write_text_atomically
from probewise.recordings.plans import with_jittered_times
from probewise.world import World

Cell: TypeAlias = tuple[str, str, str, int]
"""A verb, a plan or kind of system, what is concealed, and a seed."""

SIZES = (20.0, 12.0, 8.0, 5.0, 3.0)  # the first that the effect can have
PLANS = ("paper", "two_way", "at_rest")
ONE_SCAN = {"scan_misplacement", "scan_angle_error", "height_offset"}  # `investigate --truth` takes no scans
LEVELS: Mapping[str, Mapping[str, float]] = {  # like NEEDS_SENSOR, seen only beside a sensor that is known
    "dark_level": {"black": DARK + 4, "white": BRIGHT + 4},
    "gain": {"white": BRIGHT + 6},
    "noise_sd": {"noise_sd": 2.5},
}
SYSTEMS = ("orifice flow meter", "DC motor", "thermometer in a bath")  # others where these lack a form
NOISES = tuple({"quantised": "quantisation"}.get(name, name) for name in OTHER_NOISE if name != "t4")
FITTED = ("repaired.json", "sensor.json")
ARM = """from dataclasses import replace
from probewise.proof.concealed_study import ConcealedTrial, _arm_in_concealed_world

def connect():
    arm = _arm_in_concealed_world({trial})
    measure = arm.measure
    arm.measure = lambda pose: replace(found := measure(pose), value=min(max(found.value, 1.0), 100.0))
    return arm
"""


def plan_named(name: str) -> Plan:
    """Return a small plan: the paper's, a two-way one, or one with sixteen readings at rest at each of two places."""
    plan = paper_plan() if name == "paper" else two_way_plan()
    scans = np.array(plan.scan_names)[plan.scan]
    edges = (np.abs(plan.x_mm) <= 48) & (plan.x_mm % 4 == 0)
    if name == "paper":
        return plan.take(edges)
    edges &= np.isin(scans, ("edge_0_out", "edge_0_back", "edge_180_out", "edge_180_back"))
    if name == "two_way":
        others = np.isin(scans, ("white_0", "black_0", "quadrants", "disc_y"))
        return plan.take(edges | (others & (plan.y_mm % 4 == 0)))
    rests = [np.flatnonzero((scans == f"edge_{deg}_back") & (plan.x_mm == x))[0] for deg, x in ((90, 0), (270, 4))]
    still = plan.take(np.sort([*np.flatnonzero(edges & (scans != "edge_180_back")), *np.repeat(rests, 16)]))
    return dataclasses.replace(still, time_s=1.2 * np.arange(len(still)) + 30.0 * still.scan)


def conceal_effect(what: str, plan: Plan, rng: np.random.Generator) -> tuple[World, float | None]:
    """Return the study's sensor with an effect, and its lambda; None: no size that the null model cannot take up."""
    world = World(footprint_pixels(), black=DARK, white=BRIGHT, noise_sd=1.0)
    if what not in INSIDE:
        return dataclasses.replace(world, **LEVELS.get(what, {})), None
    setup = CleanSetup(plan, world, NullRefit())
    for wanted in SIZES:
        with contextlib.suppress(errors.NotConvergedError):
            hidden = conceal_in_sensor(what, wanted, setup, rng)
            return dataclasses.replace(world, concealed=(hidden.effect,)), hidden.size_lambda
    amplitude = math.sqrt(INSIDE[what].first * INSIDE[what].limit)
    return dataclasses.replace(world, concealed=(INSIDE[what].draw(setup, rng)(amplitude),)), None


def small_system(name: str, rng: np.random.Generator) -> DrawnSystem:
    """Draw a system of a kind; every third row of its table is kept."""
    drawn = draw_system(next(kind for kind in KINDS if kind.name == name), rng=rng)
    return dataclasses.replace(drawn, table=drawn.table.select_rows(np.arange(0, len(drawn.table), 3)))


def forms_by_name(drawn: DrawnSystem) -> dict[str, list[Form]]:
    """Return the world's forms by family."""
    forms: dict[str, list[Form]] = {}
    for form in forms_of(drawn.true_system):
        forms.setdefault(family_of(form), []).append(form)
    return forms


@functools.cache
def kinds_with(form: str) -> list[str]:
    """Return the names of three kinds of systems that have a form or a noise, those of SYSTEMS first."""
    own = [k for k in KINDS if form in _names_of_forms(k.name) or form in NOISES]
    own = [k for k in own if k.run is not None or form != "noise_per_run"]
    return [kind.name for kind in sorted(own, key=lambda kind: kind.name not in SYSTEMS)[:3]]


@functools.cache
def _names_of_forms(kind: str) -> frozenset[str]:
    return frozenset(forms_by_name(small_system(kind, np.random.default_rng(0))))


def conceal_form(kind: str, what: str, rng: np.random.Generator) -> SystemCase:
    """Draw a system of a kind and its readings with a form or a noise."""
    for wanted in (*np.repeat(SIZES, 3), None):
        drawn = small_system(kind, rng)
        forms = forms_by_name(drawn).get(what, [])
        effects: list[SystemEffect] = []
        with contextlib.suppress(errors.NotConvergedError):
            if forms and wanted is not None:
                effects = [conceal_in_system(forms[rng.integers(len(forms))], wanted, drawn, SystemRefit(), rng)]
            elif forms:  # the parameters take it up, whatever its size
                amplitude = min(20 * forms[0].first, forms[0].limit)
                effects = [SystemEffect(forms[0], forms[0].of_amplitude(amplitude, forms[0].draw(rng)))]
            free = drawn.simulate_all_rows(effects)
            if np.abs(free).max() < 1e3 * np.abs(drawn.true_system.readings).max():
                break
    name = {"quantisation": "quantised"}.get(what, what if what in OTHER_NOISE else "white")
    seen = drawn.diagnosed_row_numbers, drawn.diagnosed_table
    noise = make_noise(name, free[seen[0]], seen[1], drawn.kind.sd, rng=rng)
    readings = noise.draw(free, drawn.table, rng)
    return SystemCase(
        stratum=Stratum("single", 20.0),
        drawn=drawn,
        effects=tuple(effects),
        noise=noise,
        noise_text=f'noise = {{"sd": {drawn.kind.sd:g}}}' if name == "white" else "",
        labels=tuple(f"{drawn.kind.run}{k + 1:02d}" for k in range(drawn.table.n_runs)),
        noise_free=free,
        readings=np.round(readings / noise.step) * noise.step if noise.step else readings,
    )


def commands(cell: Cell, folder: Path) -> tuple[list[list[str]], float | None]:
    """Write the inputs of a cell into a folder; return its commands, without --out, and the effect's lambda."""
    verb, where, what, seed = cell
    rng = np.random.default_rng([seed, *"".join(cell[:3]).encode()])
    write_sensor(calibrated(), folder / "known.json")
    known = ["--sensor", str(folder / "known.json")]
    if verb == "explore":
        trial = f"ConcealedTrial({what.replace('nothing', '')!r}, 2, 0, {TRUST}, seed={seed})"
        (folder / "arm.py").write_text(ARM.format(trial=trial))
        return [[verb, *known, "--arm", str(folder / "arm.py"), "--field", "1048,520", "--max-readings", "20"]], None
    if where not in PLANS:
        case = conceal_form(where, what, rng)
        file, table, test = map(str, write_system_case(case, folder))
        following = ["fit", table] if verb == "audit" else ["predict", "repaired.json", test]
        sizes = [*(effect.size_lambda for effect in case.effects), None]
        return [[words[0], *words[1:], "--simulator", file] for words in ([verb, table], following)], sizes[0]
    plan = with_jittered_times(plan_named(where), rng=rng)
    world, size = conceal_effect(what, plan, rng)
    path = str(folder / "recording.csv")
    write_recording(world.simulate(plan, rng=rng), path)
    if verb == "investigate":
        truth = [f"{e.name}:{','.join(map(repr, e.parameters.values()))}" for e in world.concealed] or ["nothing"]
        return [[verb, "--plan", path, "--truth", *truth, "--readings", "60", "--rounds", "2"]], size
    first = [verb, path, *(known if what in (*LEVELS, *NEEDS_SENSOR, "a known sensor") else [])]
    return [first, *([["predict", "sensor.json", path]] if verb == "diagnose" else [])], size


def run_cell(cell: Cell) -> dict[str, Any]:
    """Run a cell's commands; return what failed ("": nothing), and what the result says of the effect."""
    begun_s = time.process_time()
    row: dict[str, Any] = {"kind": "", "failure": ""}
    said, every = io.StringIO(), [*ShowsItself.__subclasses__(), *Reported.__subclasses__()]
    kinds = [kind for kind in every if "summary" in vars(kind)]
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        out = Path(name) / "out"
        summaries = [mock.patch.object(k, "summary", autospec=True, side_effect=k.summary) for k in kinds]
        shown = [stack.enter_context(summary) for summary in summaries]
        stack.enter_context(warnings.catch_warnings())
        try:
            wanted, size = commands(cell, Path(name))
            row["lambda"] = size and round(size, 1)
            warnings.simplefilter("error")
            for own in (errors.DoubtfulResultWarning, errors.SlowWarning):  # a person sees one line
                warnings.simplefilter("default", own)
            for words in wanted:
                words = [str(out / word) if word in FITTED else word for word in words]
                target = out / {"predict": "predicted.csv", "fit": "fit"}.get(words[0], "")
                with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
                    status = command_line([*words, "--out", str(target)])
                if status != 0:
                    raise SystemExit(f"{words[0]} exits {status}: {said.getvalue().strip().splitlines()[-1][:200]}")
            results = [call.args[0] for summary in shown for call in summary.call_args_list]
            row |= _of_result(cell, out, results)
            row["failure"] = next(
                (
                    complaint
                    for folder in (out, *(page.parent for page in out.glob("*/report.html")))
                    for complaint in complaints(folder, said.getvalue(), results)
                ),
                "",
            )
        except SystemExit as stop:
            row["failure"] = str(stop)
        except Exception as error:  # a traceback, for a person
            frame = traceback.extract_tb(error.__traceback__)[-1]
            row["failure"] = f"{type(error).__name__} in {Path(frame.filename).name}, {frame.name}: {error}"[:200]
    return {**row, "kind": row["failure"].partition(":")[0], "cpu_s": round(time.process_time() - begun_s, 1)}


def complaints(out: Path, said: str, results: Sequence[Any]) -> Iterator[str]:
    """Yield what is wrong with files, words and notebook pages of a finished cell, as "KIND: what"."""
    pictures = {path.name: path.read_bytes() for path in out.rglob("*.[sp][vn]g")}
    for path in out.rglob("*.json"):
        try:
            json.loads(path.read_text(), parse_constant=int)  # there is no integer NaN
        except ValueError as error:
            yield f"invalid JSON: {path.name}: {error}"
    page = (out / "report.html").read_text() if (out / "report.html").exists() else ""
    files = {path.name for path in out.iterdir() if path.is_dir() or path.stat().st_size}
    wanted = {"report.html", *re.findall(r'src="(?!data:)([^"]*)"', page)}
    if "diagnosis.json" in files:
        found = json.loads((out / "diagnosis.json").read_text())
        wanted |= {"calibrated.json", *(place["witness"] for place in found["where"])}
        wanted |= {found["next_measurement"]["plan"]} if found["next_measurement"] else set()
        wanted |= {"repaired.json"} - ({"repaired.json"} if "sensor.json" in files else set())
    yield from (f"missing or empty: {name}" for name in sorted(wanted - files))
    embedded = re.findall(r'src="data:image/[^"]*;base64,([^"]*)"', page)
    pictures |= {f"picture {k} of the report": base64.b64decode(picture) for k, picture in enumerate(embedded)}
    for name, picture in pictures.items():
        try:
            ElementTree.fromstring(picture) if picture[:1] == b"<" else Image.open(io.BytesIO(picture)).load()
        except (OSError, ElementTree.ParseError) as error:
            yield f"broken picture: {name}: {error}"
    words = re.sub(r"<(style|script).*?</\1>|<[^>]*>", " ", page, flags=re.DOTALL)
    if odd := re.search(r".{0,40}(?<![\w.])(nan|inf|None|Traceback)\b.{0,40}", f"{words}\n{said}"):
        yield f"odd word: {odd[0].strip()}"
    shown = [*{id(one): one for one in results}.values()]
    shown += [read_sensor(out / "sensor.json")] if "sensor.json" in files else []
    if not (embedded and shown and all("<img" in one._repr_html_() for one in shown)):
        yield f"no picture: report or notebook, {[type(one).__name__ for one in shown]}"


def _of_result(cell: Cell, out: Path, results: Sequence[Any]) -> dict[str, Any]:
    """Return verdict, first hypothesis, p, and whether the effect is in the result and in its credible set."""
    drawn = sorted(path.name for path in out.glob("*.[sp][vn]g") if "witness" not in path.name)
    if (out / "diagnosis.json").exists():
        found = json.loads((out / "diagnosis.json").read_text())
        of = {name: found[key] for name, key in (("verdict", "verdict"), ("set", "credible_set"))}
        of["p"] = float(f"{found['p_value']:.2g}")
        of |= {"first": found["hypotheses"][0]["effects"], "effects": [effect["name"] for effect in found["effects"]]}
        drawn += sorted({f"witness of {place['covariate']}" for place in found["where"]})
    elif cell[0] == "explore":
        missing = left_out_after_step(results[-1].last, TRUST)
        of = {"first": [missing.leading], "effects": [name for name, p in missing.probability.items() if p > 0.05]}
        of["set"] = missing.credible_set
    else:
        return {"figures": drawn}
    names = {name.split(":")[0] for name in (*of["first"], *of.pop("effects"))}
    held = {name.split(":")[0] for label in of.pop("set") for name in label.split("+")}
    return {**of, "figures": drawn, "in_result": cell[2].split()[0] in names, "in_set": cell[2].split()[0] in held}


def all_cells(seed: int) -> dict[str, Cell]:
    """Return every cell of the matrix by its key."""
    one_each = enumerate(["nothing", *(name for name in INSIDE if name not in ONE_SCAN)])
    rows = [
        *(("diagnose", plan, what) for what in ("nothing", *INSIDE, *LEVELS) for plan in PLANS),
        *(("diagnose", k, form) for form in (*FAMILIES, *ADDED_FAMILIES, *NOISES) for k in kinds_with(form)),
        *(("investigate", PLANS[k % 3], what) for k, what in one_each),
        *(("explore", "field", what) for what in ("nothing", *CONCEALED)),
        *(("audit", plan, what) for plan in PLANS for what in ("nothing", "a known sensor")),
        *(("calibrate", plan, "nothing") for plan in PLANS),
        *(("audit", kind.name, "nothing") for kind in KINDS),
    ]
    return {" / ".join(row): (*row, seed) for row in rows}


def cover(rows: Mapping[str, Mapping[str, Any]], limit_s: float) -> Iterator[str]:
    """Yield keys by what each adds a second: verb with place, verdict and figure; place with figure; effect."""
    left = {}
    for key, row in rows.items():
        verb, where, what = key.split(" / ")
        left[key] = {(verb, where), (what,), (verb, str(row.get("verdict")))}
        left[key] |= {(one, figure) for one in (verb, where) for figure in row.get("figures", ())}
    while any(left.values()) and limit_s > 0:
        best = max(left, key=lambda key: len(left[key]) / (1 + rows[key]["cpu_s"]))
        limit_s -= rows[best]["cpu_s"]
        added = left.pop(best)
        left = {key: others - added for key, others in left.items()}
        yield best


def main() -> None:
    """Run the cells that are missing in DIR, and write matrix.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--seed", type=int, default=52)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--only", default="*", help="cells whose key matches, such as 'diagnose / paper / *'")
    parser.add_argument("--keys", type=Path, help="a file of keys, or a matrix.json: what failed in it")
    parser.add_argument("--cover", type=float, metavar="SECONDS", help="print the keys of a covering subset")
    asked = parser.parse_args()
    cells = {key: cell for key, cell in all_cells(asked.seed).items() if fnmatch.fnmatch(key, asked.only)}
    if asked.keys:
        text = asked.keys.read_text()
        cells = {key: cells[key] for key in (json.loads(text)["failing"] if text[0] == "{" else text.splitlines())}
    asked.out.mkdir(parents=True, exist_ok=True)
    campaign = Campaign(run_cell, cells, {"seed": asked.seed}, noun="cells")
    with ProcessPoolExecutor(asked.workers) as pool, progress_shown(quiet=False) as progress:
        found = campaign.run(path=asked.out / "cells.jsonl", executor=pool, progress=progress)
    rows = {key: found[cell] for key, cell in cells.items()}
    if asked.cover:
        return print("\n".join(cover(rows, asked.cover)))
    named = [row["in_result"] for key, row in rows.items() if "in_result" in row and not key.endswith("nothing")]
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, cwd=Path(errors.__file__).parent)
    document = {
        "command": f"benchmarks/matrix.py --seed {asked.seed}",
        "date": datetime.date.today().isoformat(),
        "commit": commit.stdout.decode().strip(),
        "cells": len(rows),
        "cpu_s": round(sum(row["cpu_s"] for row in rows.values())),
        "effect in the result": f"{sum(named)} of {len(named)}",
        "failing by kind": Counter(row["kind"] for row in rows.values() if row["kind"]),
        "failing": {key: row["failure"] for key, row in rows.items() if row["kind"]},
    }
    print(json.dumps(document, indent=1))
    lines = ",\n".join(
        f"  {json.dumps(key)}: {json.dumps({**row, 'figures': len(row.get('figures', ()))})}"
        for key, row in rows.items()
    )
    text = f'{json.dumps(document, indent=1)[:-2]},\n "rows": {{\n{lines}\n }}\n}}\n'
    write_text_atomically(asked.out / "matrix.json", text)
    sys.exit(bool(document["failing"]))


if __name__ == "__main__":
    main()
