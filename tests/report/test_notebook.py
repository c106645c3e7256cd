"""Results show themselves in a notebook, with a picture; they are saved as their commands save them."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.axes import Axes

import probewise
from probewise._display import ShowsItself
from probewise.cli import main
from probewise.errors import DoubtfulResultWarning, ParameterError
from probewise.nested import run
from probewise.priors import Product, Uniform
from probewise.recordings import Recording, paper_plan, shipped, write_recording
from probewise.sensor import SSFField
from probewise.systems import read_simulator, read_table_for

SIMULATOR = """reading, unit, time, run = "y", "V", "t_s", "run"
parameters = {"a": (0, 20)}
def simulate(p, data):
    return p["a"] / (1 + data["t_s"])
"""
ROWS = [f"{t},{run},{8 / (1 + t) + 0.1 * (t % 3 - 1)}" for run in ("1.1", "1.10") for t in range(6)]


class Bell:
    prior = Product({"x_mm": Uniform(-5.0, 5.0), "y_mm": Uniform(-5.0, 5.0)})

    def log_likelihood(self, theta):
        return -0.5 * (theta**2).sum(axis=1)


@pytest.mark.parametrize(
    "make",
    [
        lambda: run(Bell(), rng=np.random.default_rng(0), n_live=50),
        lambda: SSFField(np.ones((5, 5)), 1.0, (-2.0, -2.0)),
        lambda: Recording(paper_plan(), np.linspace(10, 60, 408)),
    ],
    ids=["nested result", "SSF field", "recording"],
)
def test_a_value_shows_a_picture(make):
    assert "data:image/png;base64" in make()._repr_html_()


def test_what_has_no_picture_says_so():
    with pytest.raises(ParameterError, match="one with a picture"):
        ShowsItself().plot()


@pytest.mark.parametrize("verb", ["calibrate", "diagnose", "audit", "fit"])
def test_a_result_is_saved_as_its_command_saves_it(verb, tmp_path):
    write_recording(probewise.read_recording(shipped("paper")).take(np.arange(0, 408, 21)), tmp_path / "few.csv")
    (tmp_path / "sim.py").write_text(SIMULATOR)
    (tmp_path / "data.csv").write_text("\n".join(["t_s,run,y", *ROWS, ""]))
    words = {"calibrate": ["--orders", "1", "--live", "20"], "fit": ["--simulator", str(tmp_path / "sim.py")]}
    recorded = str(tmp_path / ("data.csv" if verb == "fit" else "few.csv"))
    seed = [] if verb == "audit" else ["--seed", "7"]
    assert main([verb, recorded, *words.get(verb, []), *seed, "--quiet", "--out", str(tmp_path / "cli")]) == 0

    rng = {} if verb == "audit" else {"rng": np.random.default_rng(7)}
    if verb == "fit":
        simulator = read_simulator(tmp_path / "sim.py")
        found = probewise.fit(read_table_for(simulator, recorded), simulator=simulator, progress=False, **rng)
    else:
        more = {"orders": [1], "n_live": 20} if verb == "calibrate" else {}
        found = getattr(probewise, verb)(probewise.read_recording(recorded), progress=False, **rng, **more)
    out = found.save(tmp_path / "saved", seed=7)
    files = {path.name: path.read_bytes() for path in (tmp_path / "cli").iterdir()}
    assert {path.name for path in out.iterdir()} == set(files)
    for name in set(files) - {"report.html", "fit.json", "fitted.json"}:  # these name the source, and the list has them
        assert name.startswith(".probewise") or (out / name).read_bytes() == files[name], name
    for folder, seed in (("a\0b", 1), ("saved", -1), ("saved", "1")):
        with pytest.raises(ParameterError, match=r"folder is|seed is"):
            found.save(folder, seed=seed)
    assert "data:image/" in found.to_html()
    drawn = [*np.ravel(found.plot()), *np.ravel(found.recording.plot() if verb == "fit" else [])]
    assert all(isinstance(ax, Axes | None) for ax in drawn)


def test_tables_come_out_as_data_frames(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    recording = Recording(paper_plan(), np.linspace(10, 60, 408))
    again = Recording.from_table(recording.to_frame(), patterns=recording.plan.patterns, unit="LEGO", min=0, max=100)
    assert again.plan.scan_names == recording.plan.scan_names
    np.testing.assert_array_equal(again.plan.x_mm, recording.plan.x_mm)
    ramp = probewise.Simulator("y", "V", {"a": (0, 20)}, lambda p, data: p["a"] * data["x"])
    table, rng = {"x": np.arange(6.0), "y": 3 * np.arange(6.0) + 0.1 * np.cos(np.arange(6))}, np.random.default_rng(1)
    fit = probewise.fit(table, simulator=ramp, rng=rng, progress=False)
    assert list(fit.to_frame()) == ["parameter", "mode", "median", "sd", "low", "high"]
    few = probewise.diagnose(table, simulator=ramp, rng=rng, progress=False)
    assert sum(few.to_frame()["probability"]) == pytest.approx(1.0)
    assert few.probability_of("nonlinearity") >= few.probability_of(("nonlinearity",)) > 0
    audit = probewise.audit(table, simulator=ramp)
    assert audit.to_frame()["effect"] == [effect.name for effect in audit.effects]
    with pytest.warns(DoubtfulResultWarning) as caught:
        planned = probewise.predict(fit, {"x": [7.0, np.nan]}, rng=rng, progress=False)
    assert caught[0].filename == __file__  # the line of the caller, not of the package
    assert "data:image/png;base64" in planned._repr_html_()
    found = run(Bell(), rng=np.random.default_rng(0), n_live=50).to_frame()
    assert list(found) == ["weight", "log_likelihood", "x_mm", "y_mm"]
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ParameterError, match="pip install pandas"):
        recording.to_frame()
