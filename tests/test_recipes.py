"""The worked examples of CONTRIBUTING.md do what they say, each run as if it stood in the file where it belongs."""

import __future__

import argparse
import importlib
import re
from importlib.resources import files
from pathlib import Path

import numpy as np
from mixtures import mean_albedo_under_gaussians

from probewise import nested
from probewise.priors import Uniform
from probewise.proof.systems.cases import draw_system
from probewise.recordings import paper_plan
from probewise.sensor import FixedMixture, Poses, mean_albedo_by_pixels, mean_ssf_field
from probewise.systems import Noise, RunTable, Simulator, System, read_simulator
from probewise.systems.forms import ReferenceFit

PAGE = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


def example(name, *modules):
    """Run the example that defines `name` with what the modules import and define, the first most; return its value."""
    (code,) = (code for code in EXAMPLES if re.search(rf"^(class|def) {name}\b|^{name} =", code, re.MULTILINE))
    known = {}
    for module in reversed(modules):
        known |= {k: v for k, v in vars(importlib.import_module(module)).items() if not k.startswith("__")}
    known["__name__"] = modules[0]
    exec(compile(code, name, "exec", __future__.annotations.compiler_flag), known)
    return known[name]


def test_every_example_is_tried():
    tried = re.findall(r'example\(\s*"(\w+)"', Path(__file__).read_text(encoding="utf-8"))
    assert len(EXAMPLES) == len(set(tried))


def test_a_shape():
    square = example("Square", "probewise.scene.shapes")()
    theta = np.array([[500.0, 250.0, 120.0], [300.0, 200.0, 60.0]])
    assert np.isfinite(square.prior.log_prob(theta)).all()
    points = np.random.default_rng(1).uniform([200, 150], [600, 350], (500, 2))
    inside = [(np.abs(points - centre) < side / 2).all(axis=1) for *centre, side in theta]
    np.testing.assert_array_equal(square.region(theta).albedo(points), np.array(inside))


def test_a_region_with_its_closed_form():
    ring = example("RingRegion", "probewise.scene.regions", "probewise.sensor.gaussian")
    region = ring(np.array([[2.0, 1.0]]), np.array([[5.0, 12.0]]))
    grid = np.arange(-25.0, 25.125, 0.25)
    ssf = FixedMixture([1.0], [[0.0, 0.0]], [np.array([[16.0, 3.0], [3.0, 9.0]])])
    field = mean_ssf_field(ssf.footprint(np.empty((1, 0))), u_mm=grid, v_mm=grid)
    x, y = np.array([[-6.0, 0.0, 2.0, 12.0]]), np.array([[3.0, -2.0, 8.0, 4.0]])
    closed = mean_albedo_under_gaussians(
        region, x[..., None], y[..., None], *(np.full((1, 1, 1), c) for c in (16.0, 9.0, 3.0))
    )
    by_pixels = mean_albedo_by_pixels(region, field, Poses(x, y, np.zeros((1, 4))))
    np.testing.assert_allclose(closed[:, :, 0], by_pixels, atol=4e-4)


def test_an_effect():
    kind = example("arm_creep", "probewise.effects.pose")
    assert kind.words == "an arm that creeps"
    creep = kind()
    plan = paper_plan()
    poses = Poses(*(np.zeros((1, len(plan))) for _ in range(3)))
    moved = creep.apply(poses, np.array([[0.8]]), plan)
    np.testing.assert_allclose(moved.x_mm[0], 0.8 * plan.time_s / 3600)
    assert creep.sentence(np.array([0.8]), np.array([0.1])) == "the arm creeps by 0.80 ± 0.10 mm per hour along X"


def test_a_form():
    t_s = np.tile(np.arange(0.0, 30.0), 2)
    table = RunTable({"t_s": t_s, "run": np.repeat([1.0, 2.0], 30), "y": 0 * t_s}, time="t_s", run="run")
    simulator = Simulator(
        "y", "V", {"k": (0, 4)}, simulate=lambda p, u: p["k"] + 0 * u["t_s"], time="t_s", run="run", noise=Noise(sd=0.1)
    )
    about = ReferenceFit(System.of(simulator, table), table, np.zeros(1), 0.1)
    (form,) = example("_creep_form", "probewise.systems.forms.readings")(about)
    found = about.system.chain(table, [form]).predict(np.array([[2.0, 0.3]]), table)[0]
    np.testing.assert_allclose(found, 2.0 + 0.3 * np.log10(1 + t_s))


def test_a_move():
    """A normal of sd 0.1 in the middle of a square of 2 has the evidence 1 / 4; the chance of four errors is 6e-5."""
    walk = example("Walk", "probewise.nested.moves")()
    run = nested.run(
        lambda theta: -0.5 * ((theta / 0.1) ** 2).sum(axis=1) - 2 * np.log(0.1 * np.sqrt(2 * np.pi)),
        {"a": Uniform(-1.0, 1.0), "b": Uniform(-1.0, 1.0)},
        vectorized=True,
        move=walk,
        rng=np.random.default_rng(4),
    )
    assert abs(run.log_z - np.log(0.25)) < 4 * run.log_z_error


def test_a_system(tmp_path):
    spring = example("SPRING", "probewise.proof.systems.kinds")
    drawn = draw_system(spring, rng=np.random.default_rng(5))
    file = tmp_path / "spring.py"
    file.write_text(spring.text.replace("{noise}", ""), encoding="utf-8")
    predicted = read_simulator(file).simulate(drawn.shared, drawn.table.columns)
    np.testing.assert_allclose(predicted, drawn.simulate_all_rows([]))


def test_a_verb(capsys):
    define_options = example("_tally", "probewise.cli._options", "probewise.cli.predict")
    parser = argparse.ArgumentParser()
    define_options(parser)
    assert define_options.__globals__["run"](parser.parse_args([str(files("probewise.data") / "paper.csv")])) == 0
    assert capsys.readouterr().out == "408 readings\n"
