"""Results in a campaign's file that somebody changed by hand: one line says which, and nothing is counted."""

import copy
import json

import pytest

from probewise import __version__
from probewise.cli import main
from probewise.proof.campaign import CONCEALED_TRIAL, SENSOR_CASE, TRIAL, misfit, misfit_of_case
from probewise.proof.challenge import Task
from probewise.proof.concealed_study import ConcealedTrial
from probewise.proof.study import REFERENCE, Trial

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
