"""Mistakes in a person's file and table: exit status 2, one line that says which, where and what is allowed."""

import sys
from pathlib import Path

import command
import numpy as np
import pytest
from heater import FILE, runs

from probewise.cli import main
from probewise.systems import System, read_simulator, run_table_csv


def refused(capsys, tmp_path, file, *, table=None, more=()):
    (tmp_path / "heater.py").write_text(file)
    (tmp_path / "data.csv").write_text(table if table is not None else run_table_csv(runs()))
    words = ("diagnose", tmp_path / "data.csv", *more, "--simulator", tmp_path / "heater.py")
    return command.refused(capsys, tmp_path, *words, "--out", tmp_path / "out")


def law_whose_rates(do):
    """A file like the heater's, of a law with one state, temp_c, and a last line of its rates."""
    return f'{FILE.partition("def simulate")[0]}states = {{"temp_c": "start_c"}}\n\ndef rates(s, p, u):\n    {do}\n'


MUTE = "class Mute(Exception):\n    def __str__(self): raise ValueError\n"

FILES = {
    "a column that the table lacks": (
        ('data["power_w"]', 'data["power"]'), "line 10: simulate raises KeyError: 'power'; allowed: columns run, t_s,",
    ),
    "readings of another shape": (("return p", "return np.ones(3)\n    return p"), "shape (3,); allowed: (36,)"),
    "an effect of one's own without mass": (
        ("noise =", 'extra = {"drag": {"prior": (1, 1), "null": 0.0, "says": "drag {value}"}}\nnoise ='),
        "extra['drag'].prior is (1, 1); allowed:",
    ),
    "no number at all": (("return p", 'return np.nan * data["t_s"]\n    return p'), "not finite at any of the"),
    "a prior without mass": (("(0, 10)", "(10, 10)"), "parameters['gain'] is (10, 10)"),
    "a reading that the table lacks": (('"temp_c"', '"temp"'), "reading is 'temp'; allowed: a column of the table"),
    "a name that is misspelt": (("\nparameters", "\nparameter"), "was parameter meant to be parameters?"),
    "an error at every place": (
        ("return p", "raise ValueError('too hot')\n    return p"), "line 10: simulate raises ValueError: too hot",
    ),
    "a control that the table lacks": (
        ('["power_w"]\nnoise', '["powr_w"]\nnoise'), "controls is 'powr_w'; allowed: a column that the table has",
    ),
    "a noise that the table lacks": (('"sd": 0.05', '"sd": "u_c"'), "noise[\"sd\"] is 'u_c'"),
    "a zero that is NaN": (('"sd": 0.05', '"zero": float("nan")'), 'noise["zero"] is nan; allowed: a finite number'),
    "a range that ends at no number": (('"sd": 0.05', '"range": (0, "5")'), "noise[\"range\"] is (0, '5')"),
    "what is no Python": (("def simulate(p, data):", "def simulate(p, data)"), "line 9: is no Python"),
    "100,000 pluses": (("noise =", f"sum = 1{100000 * '+1'}\nnoise ="), "too long or too deeply nested"),
    "8,000 minus signs": (("noise =", f"sign = {8000 * '-'}1\nnoise ="), "too long or too deeply nested"),
    "an end": (("noise =", "raise BaseException('over')\nnoise ="), "line 7: stops with BaseException: over"),
    "an exit": (("noise =", "raise GeneratorExit\nnoise ="), "line 7: stops with GeneratorExit; allowed"),
    "an error that cannot be shown": (("noise =", f"{MUTE}raise Mute\nnoise ="), "its message raises ValueError"),
    "a prior beyond floats": (("(0, 10)", "(0, 10**400)"), "allowed: (low, high), "),
    "a prior that cannot be shown": (
        ("noise =", "class Odd:\n    def __repr__(self): 1 / 0\nparameters['gain'] = Odd()\nnoise ="), "is a Odd",
    ),
    "no simulator": (("def simulate", "def simulat"), "simulate, rates is 'neither'"),
    "readings that are no real numbers": (("return p", "return 1j + p"), "simulate returns array(["),
    "a time that is the reading": (('"t_s"', '"temp_c"'), "time is 'temp_c'; allowed: another column than the reading"),
    "a prior wider than squares of floats": (("(0, 10)", "(-1e200, 1e200)"), "e+199; allowed: a prior with magnitudes"),
    "runs that are not named": (
        ('time, run = "t_s", "run"', 'time = "t_s"'), "per_run is ['start_c']; allowed: nothing, or run =",
    ),
}  # fmt: skip


def test_an_exit_at_some_parameters_makes_them_impossible(tmp_path):
    path = tmp_path / "heater.py"
    path.write_text(FILE.replace("return p", "if np.any(p['gain'] < 5): raise SystemExit\n    return p"))
    system = System.of(read_simulator(path), runs())
    chain = system.chain(runs(), ())
    readings = chain.predict(np.array([[15.0, gain, 20.0, 21.0, 19.0] for gain in (3.0, 7.0)]), runs())
    assert np.isnan(readings[0]).all()
    assert np.isfinite(readings[1]).all()


def test_a_file_that_goes_elsewhere_leaves_names_of_folders_and_libraries_what_they_are(tmp_path, monkeypatch):
    """It changes the working directory when it is run and when it is called; a module lies beside it."""
    path = tmp_path / "own" / "heater.py"
    path.parent.mkdir()
    (path.parent / "beside.py").write_text("")
    go = "import os; os.chdir(os.path.dirname(__file__))"
    path.write_text(f"{go}\n{FILE}".replace("return p", f"{go}; import beside\n    return p"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    System.of(read_simulator(path), runs())
    assert Path.cwd() == tmp_path
    assert sys.path[-1] == str(path.parent)


def cell(row, column, text):
    lines = [line.split(",") for line in run_table_csv(runs()).splitlines()]
    lines[row - 1][lines[0].index(column)] = text
    return "\n".join(map(",".join, lines)) + "\n"


TABLES = {
    "a reading that is text": (cell(5, "temp_c", "warm"), "in row 5 is 'warm'"),
    "a reading beyond floats": (cell(5, "temp_c", "1e400"), "in row 5 is '1e400'"),
    "an input too large to be squared": (cell(5, "room_c", "-1e308"), "column 'room_c' in row 5 is -1e+308; allowed:"),
    "a span too small to be squared": (
        run_table_csv(runs().with_columns({"room_c": np.arange(36) * 1e-300})),
        "span of column 'room_c' is 3.5e-299",
    ),
    "an input that is text": (cell(5, "power_w", "4;5"), "these contain text: power_w ('4;5')"),
    "a time that is missing": (cell(5, "t_s", ""), "row 5, column t_s: the cell is empty"),
    "a time that falls": (
        cell(5, "t_s", "1"),
        "column 't_s' in row 5 is 1.0; allowed: 10 or more, since time does not fall within run 1; sort the rows",
    ),
    "no rows": ("run,t_s,power_w,room_c,temp_c\n", "no row below the header"),
}


HEADER = FILE.partition("def simulate")[0]
LAWS = {
    "a state that starts nowhere": (
        f'{HEADER}states = {{"temp_c": None}}\n\ndef rates(s, p, u):\n    return {{"temp_c": -s["temp_c"]}}\n',
        "states['temp_c'] is ",
    ),
    "another state": (
        law_whose_rates('return {"temp_c": p["gain"] * s["heat"]}'), "line 12: rates raises KeyError: 'heat'",
    ),
    "a rate by another name": (
        law_whose_rates('return {"temp": -s["temp_c"]}'), "a rate for each state, under its name: temp_c",
    ),
    "a list of rates": (law_whose_rates('return [-s["temp_c"]]'), "rates returns a list or a tuple; allowed: a dict"),
    "an error": (law_whose_rates('raise ValueError("too hot")'), "line 12: rates raises ValueError: too hot"),
    "a sine of one number": (
        "import math\n" + law_whose_rates('return {"temp_c": -math.sin(s["temp_c"])}'),
        "allowed: np.sin(x) in place of math.sin(x)",
    ),
    "rates that are no real numbers": (
        law_whose_rates('return {"temp_c": 1j * s["temp_c"]}'), "rates raises ComplexWarning: Casting complex",
    ),
    "steps without end": (
        law_whose_rates('return {"temp_c": -s["temp_c"]}').replace("states", "max_step_s = 1e-9\nstates", 1),
        "max_step_s is 1e-09; allowed: 0.00",
    ),
    "an if": (
        law_whose_rates('return {"temp_c": -1.0 if s["temp_c"] > 0 else 1.0}'),
        "allowed: np.where(condition, a, b) in place of if",
    ),
    "a state far faster than the rows": (
        law_whose_rates('return {"temp_c": 1e15 * (p["gain"] - s["temp_c"])}'),
        "in each row somewhere in the prior, or for a state far faster than the rows its equilibrium",
    ),
    "another reading": (
        f'{HEADER}states = {{"warm": 0.0}}\ndef rates(s, p, u):\n    return {{"warm": -s["warm"] / p["tau_s"]}}\n'
        'def observe(s, p, u):\n    return s["hot"]\n',
        "line 13: observe raises KeyError: 'hot'; allowed: columns",
    ),
    "readings of another shape": (
        law_whose_rates('return {"temp_c": -s["temp_c"]}') + "\n\ndef observe(s, p, u):\n    return np.ones(3)\n",
        "observe returns an array of shape (3,); allowed: (",
    ),
}  # fmt: skip


FURTHER = {
    "text in a further table": (cell(5, "temp_c", "warm"), "reading 'temp_c' in row 5 is warm; allowed: a number"),
    "a further table's time": (cell(5, "t_s", "1"), "column 't_s' in row 5 is 1.0; allowed: 10 or more"),
    "no reading in a further table": (
        run_table_csv(runs()).replace("temp_c", "temp"),
        "no column 'temp_c'; allowed: the reading, as in data.csv; the header has 'run', 't_s'",
    ),
}  # fmt: skip
WITH_A_NOTE = "\n".join(("note," if k == 0 else "a,") + row for k, row in enumerate(run_table_csv(runs()).splitlines()))
# By name the file, its table, a further table, and what is said; laws meet a column of text, such as a note.
MISTAKES = {
    **{name: (FILE.replace(*change), None, None, said) for name, (change, said) in FILES.items()},
    **{name: (FILE, table, None, said) for name, (table, said) in TABLES.items()},
    **{f"law: {name}": (law, f"{WITH_A_NOTE}\n", None, said) for name, (law, said) in LAWS.items()},
    **{name: (FILE, None, text, f"more.csv: {said}") for name, (text, said) in FURTHER.items()},
}


@pytest.mark.parametrize(("file", "table", "further", "said"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_one_line(capsys, tmp_path, file, table, further, said):
    assert file != FILE or table or further
    if further is not None:
        (tmp_path / "more.csv").write_text(further)
    more = () if further is None else (str(tmp_path / "more.csv"),)
    assert said in refused(capsys, tmp_path, file, table=table, more=more)


def test_a_row_in_which_an_input_is_missing_is_left_out_and_noted():
    from probewise.diagnosis.diagnose_simulator import prepare_system
    from probewise.systems import Simulator

    x = np.arange(30.0)
    simulator = Simulator("y", "V", {"a": (0, 10)}, simulate=lambda p, data: p["a"] * data["x"])
    prepared = prepare_system(
        simulator, _table(np.where(x == 3, np.nan, x), 2 * x + 0.1 * np.sin(9 * x)), with_effects=False
    )
    assert "1 reading left out: a column that the simulator reads is missing there" in prepared.recording.notes
    assert 3 not in prepared.usable_rows


def test_a_law_says_how_much_of_a_run_a_gap_in_an_input_costs(tmp_path, capsys):
    """Also at the prompt: the verdict is of far fewer readings than the table has."""
    law = law_whose_rates('return {"temp_c": (p["gain"] * u["power_w"] + u["room_c"] - s["temp_c"]) / p["tau_s"]}')
    (tmp_path / "heater.py").write_text(law)
    (tmp_path / "data.csv").write_text(cell(8, "room_c", ""))
    words = (str(tmp_path / "data.csv"), "--simulator", str(tmp_path / "heater.py"), "--out", str(tmp_path / "out"))
    assert main(["fit", *words]) == 0
    said = "note: 5 readings left out: a column that the law reads is missing in row 8, and a law ends at the first gap"
    assert capsys.readouterr().out.count(said) == 1


def test_an_extra_effect_has_the_priors_of_a_file_and_a_finite_null():
    from probewise.errors import ParameterError
    from probewise.priors import Uniform
    from probewise.systems import Extra, Simulator

    def simulator(extra):
        return Simulator("y", "V", {"a": (0, 1)}, simulate=lambda p, u: p["a"] * u["x"], extra={"drag": extra})

    assert simulator(Extra((0, 0.3), 0.0, "drag of {value}")).extra["drag"].prior == Uniform(0, 0.3)
    with pytest.raises(ParameterError, match="null"):
        simulator(Extra(Uniform(0, 0.3), float("nan"), "drag of {value}"))


def _table(x, y):
    from probewise.systems import RunTable

    return RunTable({"x": x, "y": y})
