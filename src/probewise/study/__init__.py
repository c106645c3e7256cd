"""Studies over many circles: how many readings the robot needs (paper, section 4, "Results").

A study is a campaign of autonomous runs: every row of its table has the same circles and the same noise, and differs
from a reference row in one factor.
"""

from probewise.study.circles import POPULATIONS, Population, standard_noise_of_run
from probewise.study.concealed import (
    CONCEALED,
    ConcealedRow,
    ConcealedTrial,
    concealed_rows,
    concealed_table,
    run_concealed,
    run_concealed_trial,
)
from probewise.study.rows import REFERENCE, Row, paper_rows, standard_rows
from probewise.study.run import Study, read_study, run_study
from probewise.study.table import LEAST_FOR_MEDIAN, Estimate, Summary, share_with_interval, summarise
from probewise.study.trial import Trial, arm_of, experiment_of, run_trial

__all__ = [
    "CONCEALED",
    "LEAST_FOR_MEDIAN",
    "POPULATIONS",
    "REFERENCE",
    "ConcealedRow",
    "ConcealedTrial",
    "Estimate",
    "Population",
    "Row",
    "Study",
    "Summary",
    "Trial",
    "arm_of",
    "concealed_rows",
    "concealed_table",
    "experiment_of",
    "paper_rows",
    "read_study",
    "run_concealed",
    "run_concealed_trial",
    "run_study",
    "run_trial",
    "share_with_interval",
    "standard_noise_of_run",
    "standard_rows",
    "summarise",
]

noise_of = standard_noise_of_run
"""The old name of `standard_noise_of_run`."""

share_within = share_with_interval
"""The old name of `share_with_interval`."""
