"""A campaign: every task once, whatever the executor and whenever it was stopped; the subset of cells for CI."""

import json
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_all_start_methods, get_context
from pathlib import Path

import matrix
import pytest

import probewise
from probewise.errors import FileError, LinkError, NotConvergedError, ParameterError
from probewise.proof.campaign import Campaign, read_campaign

TASKS = {f"task {k}": k for k in range(12)}
SETTINGS = {"seed": 1, "rows": ["a", "b"]}


def run_campaign(work, tasks, *, path, settings, executor=None):
    """Run a campaign; return its results by key."""
    found = Campaign(work, tasks, settings).run(path=path, executor=executor)
    return {key: found[task] for key, task in tasks.items()}


def square(k: int) -> dict[str, float]:
    return {"square": k * k, "third": k / 3}


def die(k: int) -> dict[str, float]:
    if k == 5:
        os._exit(1)
    return square(k)


def test_results_come_in_the_order_of_the_tasks_whatever_the_executor(tmp_path):
    here = run_campaign(square, TASKS, path=tmp_path / "here.jsonl", settings=SETTINGS)
    with ThreadPoolExecutor(3) as pool:
        there = run_campaign(square, TASKS, path=tmp_path / "there.jsonl", settings=SETTINGS, executor=pool)
    assert list(here) == list(there) == list(TASKS)
    assert here == there == {key: square(k) for key, k in TASKS.items()}


def test_a_campaign_that_was_stopped_does_only_what_is_left(tmp_path):
    done = []

    def until_five(k: int) -> dict[str, float]:
        if len(done) == 5:
            raise KeyboardInterrupt
        done.append(k)
        return square(k)

    path = tmp_path / "c.jsonl"
    with pytest.raises(KeyboardInterrupt):
        run_campaign(until_five, TASKS, path=path, settings=SETTINGS)
    assert len(read_campaign(path).results) == 5
    later = []

    def rest(k: int) -> dict[str, float]:
        later.append(k)
        return square(k)

    assert run_campaign(rest, TASKS, path=path, settings=SETTINGS) == {key: square(k) for key, k in TASKS.items()}
    assert sorted(done + later) == list(range(12))


@pytest.mark.parametrize("torn", range(1, 40, 7))
def test_a_line_torn_by_a_kill_is_done_again(tmp_path, torn):
    path = tmp_path / "c.jsonl"
    whole = run_campaign(square, TASKS, path=path, settings=SETTINGS)
    path.write_bytes(path.read_bytes()[:-torn])
    assert run_campaign(square, TASKS, path=path, settings=SETTINGS) == whole
    assert read_campaign(path).results == whole


def test_other_settings_and_damaged_files_are_refused(tmp_path):
    path = tmp_path / "c.jsonl"
    run_campaign(square, TASKS, path=path, settings=SETTINGS)
    with pytest.raises(FileError, match="belongs to a campaign with seed 1; allowed: seed 2, as asked now; or another"):
        run_campaign(square, TASKS, path=path, settings={**SETTINGS, "seed": 2})
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines, lines[-1]]))
    with pytest.raises(FileError, match="a second time"):
        read_campaign(path)
    path.write_text("".join([lines[0], "nonsense\n", *lines[1:]]))
    with pytest.raises(FileError, match="line 2"):
        read_campaign(path)
    path.write_text(json.dumps({"something": "else"}) + "\n")
    with pytest.raises(FileError, match="this is not a campaign file"):
        read_campaign(path)
    with pytest.raises(FileError, match="there is no such file"):
        read_campaign(tmp_path / "missing.jsonl")


def test_a_result_that_is_no_json_is_refused_and_not_written(tmp_path):
    path = tmp_path / "c.jsonl"
    with pytest.raises(ParameterError, match="finite numbers"):
        run_campaign(lambda k: {"value": float("nan")}, TASKS, path=path, settings=SETTINGS)
    assert not read_campaign(path).results


@pytest.mark.skipif("fork" not in get_all_start_methods(), reason="processes cannot be forked here")
def test_a_worker_that_dies_loses_nothing(tmp_path):
    path = tmp_path / "c.jsonl"
    fork = get_context("fork")  # a fresh process could not import this module
    with ProcessPoolExecutor(1, fork) as pool, pytest.raises(NotConvergedError, match="a worker died"):
        run_campaign(die, TASKS, path=path, settings=SETTINGS, executor=pool)
    kept = read_campaign(path).results
    assert kept == {f"task {k}": square(k) for k in range(5)}
    assert run_campaign(square, TASKS, path=path, settings=SETTINGS) == {key: square(k) for key, k in TASKS.items()}


def test_an_executor_that_drops_its_tasks_loses_nothing(tmp_path):
    """As that of a cluster whose scheduler was killed."""

    class Dropping(ThreadPoolExecutor):
        def submit(self, work, k):
            future = super().submit(work, k)
            future.result()
            if k == 3:
                future._state = "CANCELLED_AND_NOTIFIED"
            return future

    path = tmp_path / "c.jsonl"
    with Dropping(1) as lost, pytest.raises(LinkError, match="the connection to its scheduler was lost"):
        run_campaign(square, TASKS, path=path, settings=SETTINGS, executor=lost)
    assert run_campaign(square, TASKS, path=path, settings=SETTINGS) == {key: square(k) for key, k in TASKS.items()}


def test_two_campaigns_do_not_write_to_one_file(tmp_path):
    """A task of the first begins the second; the first goes on undisturbed."""
    path = tmp_path / "campaign.jsonl"

    def again(k: int) -> dict[str, float]:
        with pytest.raises(FileError, match="another process is writing to it"):
            run_campaign(square, {"other": 3}, path=path, settings={})
        return square(k)

    assert run_campaign(again, {"own": 2}, path=path, settings={}) == {"own": square(2)}
    assert list(read_campaign(path).results) == ["own"]


def test_no_other_verb_loads_what_proves_the_package():
    root = Path(probewise.__file__).parent
    modules = [".".join(path.relative_to(root.parent).with_suffix("").parts) for path in root.rglob("*.py")]
    those = (".proof.", "__main__", ".cli.study", ".cli.challenge")
    others = [name.removesuffix(".__init__") for name in modules if not any(part in name for part in those)]
    code = f"import {', '.join(others)}, sys; sys.exit('probewise.proof' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_the_subset_for_every_change_is_of_cells_that_exist():
    keys = Path(matrix.__file__).with_name("matrix_ci.txt").read_text().splitlines()
    assert len(keys) == len(set(keys)) > 40
    assert set(keys) <= set(matrix.all_cells(52))
