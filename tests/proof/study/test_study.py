"""A study is the same whoever does it: here, processes, or machines of which one is lost."""

import pytest

from probewise.errors import ParameterError
from probewise.proof.study import (
    REFERENCE,
    SearchConfiguration,
    Trial,
    experiment_of_trial,
    paper_comparison_rows,
    run_trial,
    summaries,
    trials_by_row,
)
from probewise.proof.study import study as campaign_of

ROWS = {REFERENCE: 2, SearchConfiguration(model="naive"): 2}
BRIEF = {"max_readings": 3}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "trials.jsonl"
    return campaign_of(ROWS, **BRIEF).run(path=path), path


def timeless(results):
    return {trial: {key: value for key, value in t.items() if key != "cpu_s"} for trial, t in results.items()}


@pytest.mark.slow
def test_the_robot_knows_the_circle_when_it_stops():
    trial = run_trial(Trial(REFERENCE, 2))
    assert trial["reached"]
    assert trial["error_mm"] < 12
    assert len(trial["widest_mm"]) == trial["readings"]
    assert trial["widest_mm"][-1] < 4 <= trial["widest_mm"][-2]
    assert trial["first_white"] < trial["readings"]
    assert trial["bits_at_white"] < trial["bits"]


@pytest.mark.slow
def test_a_run_that_may_not_go_on_is_a_miss(study):
    table, trials = summaries(study[0]), trials_by_row(study[0])
    for row in ROWS:
        assert [t["reached"] for t in trials[row]] == [False, False]
        assert [t["readings"] for t in trials[row]] == [3, 3]
        assert table[row].mean.value == 3
        assert table[row].reached.value == 0


@pytest.mark.slow
def test_the_papers_method_stands_beside_ours_on_the_same_circle():
    """The first place is drawn by the same rule from other samples; levels come from readings before the run."""
    ours, paper, _, naive = rows = paper_comparison_rows(nested_stop="remaining")
    assert [row.method for row in rows] == ["particles", "paper"] * 2
    assert paper.name == "inside, SSF, the paper's method to remaining evidence"
    assert ours == REFERENCE
    for row in (paper, naive):
        found = run_trial(Trial(row, 0, max_readings=1))
        assert (found["readings"], found["reached"]) == (1, False)
    one, again, other = (experiment_of_trial(Trial(naive, k)).likelihood for k in (0, 0, 1))
    assert one == again != other
    assert abs(one.mu_black - 10) < 5 / 20**0.5
    assert abs(one.mu_white - 60) < 5 / 20**0.5


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"method": "other"}, "method"),
        ({"method": "paper"}, "utility, learn_sensor, batch"),
        ({"method": "paper", "utility": "entropy", "learn_sensor": True}, "utility, learn_sensor, batch"),
        ({"method": "paper", "utility": "entropy", "nested_stop": "never"}, "nested_stop"),
        ({"nested_stop": "remaining"}, "nested_stop"),
    ],
)
def test_rows_that_cannot_be_are_refused(changes, named):
    with pytest.raises(ParameterError) as caught:
        SearchConfiguration(**changes)
    assert caught.value.name == named


def test_what_a_file_holds_is_not_done_again(study):
    told = []
    one = campaign_of({REFERENCE: 1}, max_readings=3)
    again = one.run(path=study[1], progress=lambda *words: told.append(words))
    assert told == [("runs", 1, 1)]
    (trial,) = one.tasks.values()
    assert again == {trial: study[0][trial]}
    assert summaries(again) == {}


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_loses_and_counts_twice_nothing(study, tmp_path):
    """Two workers on this machine; one is killed as soon as the first run has ended."""
    distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")
    path, killed = tmp_path / "trials.jsonl", []
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, processes=True, host="127.0.0.1"
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        victim = cluster.workers[0].process.process

        def kill(stage, done, total, note=""):
            if note and not killed:
                victim._process.kill()
                killed.append(note)

        found = campaign_of(ROWS, **BRIEF).run(path=path, executor=client.get_executor(pure=False), progress=kill)
    assert killed
    assert timeless(found) == timeless(study[0])
    assert len(path.read_text().splitlines()) == 1 + 4
