"""Any simulator over any table: what a person brings, and the chain of what it may leave out."""

from probewise.systems.file import read_simulator
from probewise.systems.simulator import Extra, Law, Noise, Simulator
from probewise.systems.system import System, SystemChain
from probewise.systems.table import RunRecording, RunTable, read_run_table, write_run_table

__all__ = [
    "Extra",
    "Law",
    "Noise",
    "RunRecording",
    "RunTable",
    "Simulator",
    "System",
    "SystemChain",
    "read_run_table",
    "read_simulator",
    "write_run_table",
]
