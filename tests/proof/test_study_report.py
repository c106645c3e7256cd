"""The page of a study: every row, with its numbers and their errors."""

import csv
import io

import numpy as np
import pytest

from probewise.experiment import CLEAN
from probewise.proof import pages as report
from probewise.proof.concealed_study import ConcealedTrial
from probewise.proof.study import REFERENCE, SearchConfiguration, Trial, summaries
from probewise.report.html import draw_or_raise

from .conftest import search

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
