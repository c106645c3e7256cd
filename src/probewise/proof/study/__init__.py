"""Studies over many circles: how many readings the robot needs (paper, section 4, "Results").

A study is a campaign of autonomous runs. The rows of its table have the same noise in units of its sd, rows of one
population the same circles; each differs from a reference row in one factor or two.
"""

from probewise.proof.study.circles import POPULATIONS, Population, noise_of_run_in_sds
from probewise.proof.study.concealed import (
    CONCEALED,
    ConcealedRow,
    ConcealedTrial,
    concealed_csv_rows,
    concealed_rows,
    run_concealed,
    run_concealed_trial,
)
from probewise.proof.study.rows import REFERENCE, SearchConfiguration, paper_comparison_rows, standard_rows
from probewise.proof.study.run import Study, read_study, run_study
from probewise.proof.study.table import LEAST_FOR_MEDIAN, Estimate, Summary, share_with_interval, summarise
from probewise.proof.study.trial import Trial, arm_of, experiment_of, run_trial

__all__ = [
    "CONCEALED",
    "LEAST_FOR_MEDIAN",
    "POPULATIONS",
    "REFERENCE",
    "ConcealedRow",
    "ConcealedTrial",
    "Estimate",
    "Population",
    "SearchConfiguration",
    "Study",
    "Summary",
    "Trial",
    "arm_of",
    "concealed_csv_rows",
    "concealed_rows",
    "experiment_of",
    "noise_of_run_in_sds",
    "paper_comparison_rows",
    "read_study",
    "run_concealed",
    "run_concealed_trial",
    "run_study",
    "run_trial",
    "share_with_interval",
    "standard_rows",
    "summarise",
]
