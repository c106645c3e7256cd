"""A user's simulator over a table of readings, and the chain of effects that it may leave out."""

from probewise.systems.fitted import FittedSystem, read_fitted_system, samples_csv, write_fitted_system
from probewise.systems.prediction import SystemPrediction, as_recording, predict_system, write_system_prediction
from probewise.systems.simulator import Extra, Law, Noise, Simulator, read_simulator, read_table_for, table_for
from probewise.systems.system import System, SystemChain
from probewise.systems.table import RunRecording, RunTable, concatenate_tables, read_run_table, run_table_csv

__all__ = [
    "Extra",
    "FittedSystem",
    "Law",
    "Noise",
    "RunRecording",
    "RunTable",
    "Simulator",
    "System",
    "SystemChain",
    "SystemPrediction",
    "as_recording",
    "concatenate_tables",
    "predict_system",
    "read_fitted_system",
    "read_run_table",
    "read_simulator",
    "read_table_for",
    "run_table_csv",
    "samples_csv",
    "table_for",
    "write_fitted_system",
    "write_system_prediction",
]
