"""Results in a campaign's file that somebody changed by hand; the page of a study, with numbers and errors."""

import copy
import csv
import io
import json

import numpy as np
import pytest

from probewise import __version__
from probewise.cli import main
from probewise.experiment import CLEAN
from probewise.proof import pages as report
from probewise.proof.campaign import CONCEALED_TRIAL, SENSOR_CASE, TRIAL, misfit, misfit_of_case
from probewise.proof.challenge import Task
from probewise.proof.concealed_study import ConcealedTrial
from probewise.proof.study import REFERENCE, SearchConfiguration, Trial, summaries
from probewise.report.html import draw_or_raise

from .conftest import case, hidden, search, single

RUN = {"readings": 3, "error_mm": 1.0, "chance_wrong": 0.01, "held": [True, True, False]}
SEARCH = search(3, p_value=None)
HIDDEN = RUN | {"known": True, "p_truth": 0.9, "credible": ["clean"], "noticed": False, "cpu_s": [0.1, 0.2]}


def damaged(value, path="result"):
    """Yield (path, copy of a JSON value with one part gone or of another type)."""
    if value is not None:
        yield path, [] if not isinstance(value, list) else "text"
    for key in value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
        below = f"{path}.{key}" if isinstance(value, dict) else f"{path}[{key}]"
        for where, instead in damaged(value[key], below):
            other = copy.copy(value)
            other[key] = instead
            yield where, other


@pytest.mark.parametrize("kind", ["trial", "concealed trial", "case"])
def test_every_part_that_is_of_another_type_or_missing_is_named(kind):
    whole, schema = {
        "trial": (SEARCH, TRIAL),
        "concealed trial": (HIDDEN, CONCEALED_TRIAL),
        "case": (single(cosine=0.2), SENSOR_CASE),
    }[kind]
    assert misfit(whole, schema) is None
    for path, result in damaged(whole):
        found = misfit(result, schema)
        assert found is not None
        assert found[0].startswith(f"{path} is ")
    for key in schema:
        less = {name: value for name, value in whole.items() if name != key}
        assert misfit(less, schema)[0] == f"result.{key} is missing"


def test_a_case_conceals_as_many_effects_as_its_kind_says():
    assert misfit_of_case(single(), SENSOR_CASE) is None
    assert misfit_of_case(case("pair", hides=[hidden("lag")]), SENSOR_CASE)[0] == "result.hidden has 1 of them"
    assert "cosine" in misfit_of_case(case("alias", hides=[hidden("lag")]), SENSOR_CASE)[0]


FILES = {
    "study --circles 2 --model ssf": ("trials.jsonl", "study", [Trial(REFERENCE, k).key for k in (0, 1)], SEARCH),
    "study --concealed --circles 1 --size small": (
        "concealed.jsonl",
        "concealed",
        [ConcealedTrial("", 0, 0, trust).key for trust in (0.9, 1.0)],
        HIDDEN,
    ),
    "challenge --cases 2 --seed 5": ("cases.jsonl", "challenge", [Task(5, k).key for k in (0, 1)], None),
}


@pytest.mark.parametrize("command", FILES)
def test_a_damaged_result_ends_the_verb_in_one_line(command, tmp_path, capsys):
    name, key, tasks, result = FILES[command]
    result = single() if result is None else result
    settings = {key: __version__} | ({"seed": 5} if key == "challenge" else {"max_readings": 100})
    lines = [{"format": "campaign/1", "settings": settings | ({"seed": 2013} if key == "concealed" else {})}]
    lines += [{"key": task, "result": result} for task in tasks]
    lines[-1]["result"] = {**result, "readings": "many"}
    (tmp_path / name).write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert main([*command.split(), "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert f"{name}, line 3: result.readings is 'many'; allowed: a whole number" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "table.csv").exists()


ROWS = [REFERENCE, SearchConfiguration(model="naive")]


def trial(rng, mean):
    n = int(rng.poisson(mean)) + 2
    return search(min(n, 40), reached=n < 40, error_mm=float(rng.exponential(1.0)))


@pytest.fixture(scope="module")
def study():
    rng = np.random.default_rng(0)
    return {Trial(row, n, 40): trial(rng, 10 * (k + 1)) for k, row in enumerate(ROWS) for n in range(30)}


def test_the_page_is_whole_and_says_what_the_first_row_needs(study):
    page = report.study_page(study, command="probewise study").html(draw_or_raise)
    needed = summaries(study)[REFERENCE].mean.value
    assert f"{needed:.1f}" in page.split("<figure>")[0]
    assert all(row.name in page for row in ROWS)
    assert "://" not in page
    assert page.count("data:image/png") == 2


def test_the_csv_holds_every_number_and_its_bounds(study):
    rows = list(csv.DictReader(io.StringIO(report.study_csv(summaries(study)))))
    assert [row["row"] for row in rows] == [row.name for row in ROWS]
    for row, summary in zip(rows, summaries(study).values(), strict=True):
        assert float(row["mean"]) == pytest.approx(summary.mean.value, rel=1e-5)
        assert float(row["mean_low"]) < float(row["mean"]) < float(row["mean_high"])
        assert "cpu" not in ",".join(row)


@pytest.mark.slow
def test_a_page_of_one_row_has_no_empty_table_and_none_wider_than_a_page(study):
    one = {trial: result for trial, result in study.items() if trial.row == ROWS[1]}
    page = report.study_page(one, command="probewise study --model naive").html(draw_or_raise)
    assert "<tbody></tbody>" not in page
    assert max(head.count("<th ") for head in page.split("<thead>")[1:]) <= 7
    assert report.lower_bound_table(summaries(one)) is None


def concealed_runs():
    good = {"known": True, "readings": 11, "error_mm": 1.0, "held": [True] * 3, "noticed": True, "cpu_s": [0.5, 1.0]}
    bad = {**good, "readings": 7, "error_mm": 30.0, "held": [False] * 3, "noticed": False}
    return {
        ConcealedTrial(effect, size, circle, trust): {
            **(bad if effect and trust == 1 else good),
            "credible": [effect or CLEAN] if trust < 1 else [CLEAN],
        }
        for effect, size in (("", 0), ("backlash", 1))
        for circle in range(3)
        for trust in (0.9, 1.0)
    }


def test_the_page_of_concealed_faults_counts_runs_that_are_sure_and_wrong():
    found = report.concealed_page(concealed_runs(), command="probewise study --concealed")
    assert found.sentence.startswith(
        "Sure and wrong: 3 of 6 runs where the robot trusts its sensor, 0 of 6 runs where it doubts it"
    )
    page = found.html(draw_or_raise)
    assert "backlash (play) of the arm, 6" in page
    assert "0.00 | 1.00" in page
    assert "By form" not in page
