"""The benchmark's problems against second routes to their evidence, and its bookkeeping."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from nested_sampling import compare, problems, records, references, seeds, ssf
from nested_sampling.ours import ours
from nested_sampling.sampler import Counted, Outcome
from scipy.special import logsumexp


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240229)


@pytest.mark.parametrize("n_gaussians", [1, 2, 4])
def test_the_ssf_likelihood_is_the_one_written_down_from_the_formulas(
    n_gaussians: int, rng: np.random.Generator
) -> None:
    """Closed forms and incomplete gammas of the package against quadratures, every constant included."""
    known = problems.ssf(n_gaussians)
    u = rng.random((200, known.n_params))
    theta = known.prior.from_unit_cube(u)
    direct = ssf.Direct(ssf.recording())
    assert known.log_likelihood(theta) == pytest.approx(direct.log_likelihood(theta, np), abs=1e-4)
    assert ssf.from_unit(n_gaussians, u, np) == pytest.approx(theta)


def test_a_denser_recording_has_the_same_layout_and_the_same_formulas(rng: np.random.Generator) -> None:
    for n in (25, 250):
        recording = ssf.recording(n)
        assert len(recording) == 4 * n + 4
        assert np.ptp(recording.plan.x_mm) == 100
        theta = ssf.prior(1).from_unit_cube(rng.random((20, 8)))
        direct = ssf.Direct(recording).log_likelihood(theta, np)
        assert ssf.problem(1, n_per_scan=n).log_likelihood(theta) == pytest.approx(direct, abs=1e-3)


@pytest.mark.parametrize("name", ["shells 2-D", "eggbox", "LogGamma 2-D", "plateau", "Rosenbrock 2-D", "Gaussian 2-D"])
def test_evidence_and_moments_agree_with_a_fine_grid(name: str) -> None:
    """Midpoint rule on 1500 x 1500 cells of the unit square."""
    known = problems.problem(name)
    side = (np.arange(1500) + 0.5) / 1500
    u = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    theta = known.prior.from_unit_cube(u)
    height = known.log_likelihood(theta)
    log_z = float(logsumexp(height)) - math.log(len(u))
    assert log_z == pytest.approx(known.log_z, abs=1e-3)
    weight = np.exp(height - logsumexp(height))
    for check in known.checks:
        values = check.function(theta)
        mean = float(weight @ values)
        sd = math.sqrt(float(weight @ (values - mean) ** 2))
        assert mean == pytest.approx(check.mean, abs=2e-3 * sd), check.name


@pytest.mark.parametrize("name", ["slab and spike 5-D", "two far peaks 5-D", "LogGamma 10-D"])
def test_evidence_and_moments_agree_with_importance_sampling(name: str, rng: np.random.Generator) -> None:
    """Draws from the mixture that each likelihood is made of, cut at the box; within five standard errors."""
    n = 40_000
    if name.startswith("slab"):
        known = problems.slab_and_spike()
        sd = np.where(rng.random(n) < 0.5, 0.1, 0.01)[:, None]
        theta = 0.5 + sd * rng.standard_normal((n, 5))
        square = ((theta - 0.5) ** 2).sum(axis=1)
        parts = [-0.5 * square / s**2 - 5 * math.log(s) for s in (0.1, 0.01)]
        proposal = np.logaddexp(*parts) - math.log(2) - 2.5 * problems.LOG_2PI
    elif name.startswith("two"):
        known = problems.problem(name)
        centre = np.where(rng.random(n) < 0.5, 0.3, 0.7)[:, None]
        theta = centre + 0.02 * rng.standard_normal((n, 5))
        parts = [-0.5 * (((theta - c) / 0.02) ** 2).sum(axis=1) for c in (0.3, 0.7)]
        proposal = np.logaddexp(*parts) - math.log(2) - 5 * (0.5 * problems.LOG_2PI + math.log(0.02))
    else:
        known = problems.problem(name)
        # Student-like tails on either side of the modes: a mixture of uniform and logistic draws.
        centre = np.full((n, 10), 2 / 3)
        centre[:, :2] = rng.choice([1 / 3, 2 / 3], (n, 2))
        theta = centre + rng.logistic(0, 0.03, (n, 10))

        def logistic(z: np.ndarray) -> np.ndarray:
            return -np.abs(z) - 2 * np.log1p(np.exp(-np.abs(z))) - math.log(0.03)

        high, low = logistic((theta - 2 / 3) / 0.03), logistic((theta - 1 / 3) / 0.03)
        proposal = high[:, 2:].sum(axis=1) + np.logaddexp(high[:, :2], low[:, :2]).sum(axis=1) - 2 * math.log(2)
    inside = ((theta > 0) & (theta < 1)).all(axis=1)
    log_weight = np.where(inside, known.log_likelihood(np.where(inside[:, None], theta, 0.5)) - proposal, -np.inf)
    log_z = float(logsumexp(log_weight)) - math.log(n)
    weight = np.exp(log_weight - logsumexp(log_weight))
    assert log_z == pytest.approx(known.log_z, abs=5 * math.sqrt(float(weight @ weight)))
    for check in known.checks:
        values = check.function(theta)
        mean = float(weight @ values)
        error = math.sqrt(float(weight**2 @ (values - mean) ** 2))
        assert mean == pytest.approx(check.mean, abs=5 * error + 1e-6), check.name


def test_the_stored_references_are_what_is_computed() -> None:
    for n_params in (2, 5):
        log_z, mean = problems.rosenbrock_reference(n_params, 2500)
        stored = problems.reference(f"Rosenbrock {n_params}-D")
        assert log_z == pytest.approx(stored["log_z"], abs=1e-5)
        assert mean == pytest.approx(stored["mean"], abs=1e-4)
    stored = problems.reference("SSF 1 Gaussian")
    found = references.by_importance(problems.ssf(1), n_samples=20_000, seed=9)
    assert found["log_z"] == pytest.approx(stored["log_z"], abs=5 * found["log_z_error"])
    for key, (mean, error) in found["mean"].items():
        assert mean == pytest.approx(stored["mean"][key][0], abs=5 * error), key


def test_the_circle_agrees_with_importance_sampling_about_its_posterior(rng: np.random.Generator) -> None:
    """Student's t about the posterior mean against adaptive cells; log Z within five standard errors."""
    known = problems.circle()
    mean = np.array([check.mean for check in known.checks])
    spread = np.array([1.0, 1.0, 1.0])
    for n in (5_000, 10_000):
        z = rng.standard_normal((n, 3)) / np.sqrt(rng.chisquare(4, n) / 4)[:, None]
        theta = mean + z * spread
        square = (z**2).sum(axis=1)
        proposal = -3.5 * np.log1p(square / 4) - np.log(spread).sum()
        proposal += math.lgamma(3.5) - math.lgamma(2) - 1.5 * math.log(4 * math.pi)
        log_weight = known.log_likelihood(theta) - math.log(1048 * 520 * 130) - proposal
        weight = np.exp(log_weight - logsumexp(log_weight))
        spread = np.sqrt(weight @ (theta - mean) ** 2) * 1.3
    log_z = float(logsumexp(log_weight)) - math.log(n)
    assert log_z == pytest.approx(known.log_z, abs=5 * math.sqrt(float(weight @ weight)))
    assert weight @ theta == pytest.approx(mean, abs=0.05)


def test_an_unknown_problem_is_named_with_what_is_allowed() -> None:
    with pytest.raises(ValueError, match="allowed: shells 2-D"):
        problems.problem("shell 2-D")


def test_tempering_finds_a_known_evidence() -> None:
    """A second sampler of the references' own, on closed forms: within 0.3 nats, about five of its errors."""
    runs = [references.tempered("Gaussian 3-D", seed, n_particles=500, n_moves=20).log_z for seed in range(4)]
    assert np.mean(runs) == pytest.approx(problems.problem("Gaussian 3-D").log_z, abs=0.3)


def test_limits_are_what_normal_numbers_keep_to(rng: np.random.Generator) -> None:
    """Both agreed sizes against 4000 draws; at other sizes one in a thousand leaves either limit."""
    assert seeds.limits(1000) == (0.1, 0.93, 1.07)
    for n in (100, 400):
        mean, low, high = seeds.limits(n)
        z = rng.standard_normal((4000, n))
        assert (np.abs(z.mean(axis=1)) > mean).mean() < 0.004
        sd = z.std(axis=1, ddof=1)
        assert ((sd < low) | (sd > high)).mean() < 0.006


def _lines(rng: np.random.Generator, n: int, bias: float = 0.0, factor: float = 1.0) -> list[dict[str, object]]:
    return [
        {
            "problem": "plateau",
            "seed": seed,
            "n_live": 100,
            "log_z": problems.plateau().log_z + 0.2 * (bias + factor * z),
            "log_z_error": 0.2,
            "n_evaluations": 1000,
            "cpu_s": 0.1,
            "n_eff": 100.0,
            "insertion_p_value": p,
            "doubts": ["a doubt"] if seed == 3 else [],
            "checks": {"mean of p1": [0.5 + 0.03 * (z + bias), 0.3]},
        }
        for seed, (z, p) in enumerate(zip(rng.standard_normal(n), rng.random(n), strict=True))
    ]


def test_the_summary_of_seeds_passes_a_right_sampler_and_fails_a_wrong_one(rng: np.random.Generator) -> None:
    known = problems.Known(
        problems.plateau().prior,
        problems.plateau().function,
        problems.plateau().log_z,
        checks=(problems.plateau().checks[2],),
    )
    right = seeds.summarise(_lines(rng, 400), known)
    assert right["held"]
    assert right["checks_held"]
    assert right["doubtful"] == 1
    assert right["checks"][0]["rms_z"] == pytest.approx(1.0, abs=0.15)
    biased = seeds.summarise(_lines(rng, 400, bias=0.5), known)
    assert not biased["held"]
    assert not biased["checks_held"]
    assert not seeds.summarise(_lines(rng, 400, factor=1.5), known)["held"]


def test_seeds_that_were_interrupted_go_on_where_they_stood(tmp_path: Path) -> None:
    out = tmp_path / "seeds.jsonl"
    seeds.campaign("plateau", seeds=range(3), n_live=20, workers=1, out=out)
    whole = out.read_bytes()
    out.write_bytes(whole[:-30])
    seeds.campaign("plateau", seeds=range(4), n_live=20, workers=1, out=out)
    lines = records.read_lines(out)
    assert [line["seed"] for line in lines] == [0, 1, 2, 3]
    before = [json.loads(line) for line in whole.splitlines()]
    assert [line["log_z"] for line in lines[:3]] == [line["log_z"] for line in before]
    entry = seeds.summary_of([out])[0]
    assert (entry["seeds"], entry["problem"]) == (4, "plateau")
    assert "plateau" in seeds.table([entry])


def test_evaluations_are_counted_and_samples_follow_the_weights() -> None:
    counted = Counted(problems.plateau())
    found = ours(counted, 0, 30)
    assert found.n_evaluations == counted.n_evaluations > 30
    two = Outcome(0.0, 0.1, 5, np.array([[1.0], [2.0]]), np.log([1.0, 3.0]))
    assert two.samples(400, 0).mean() == pytest.approx(1.75)
    assert two.n_eff == pytest.approx(1.6)
    assert two.mean(two.theta[:, 0])[0] == pytest.approx(1.75)


def test_the_comparison_names_the_best_correct_peer() -> None:
    """Three seeds each, worked out by hand: a fast peer that is wrong is no measure."""

    def line(sampler: str, offset: float, cpu_s: float, seed: int) -> dict[str, object]:
        return {
            "problem": "plateau",
            "sampler": sampler,
            "seed": seed,
            "status": "ok",
            "log_z": 3.0 + offset,
            "log_z_error": 0.1,
            "n_evaluations": 1000,
            "cpu_s": cpu_s,
            "compiling_s": 0.0,
            "n_live": 100,
            "information": 2.0,
            "worst_check": 1.0,
        }

    lines = [
        line(name, offset, cpu, seed)
        for name, offset, cpu in (("ours", 0.1, 1.0), ("right", -0.2, 10.0), ("wrong", 1.0, 0.1))
        for seed in range(3)
    ]
    lines.append({"problem": "plateau", "sampler": "slow", "seed": 0, "status": "DNF"})
    rows = {row["sampler"]: row for row in compare.summarise(lines, {"plateau": (3.0, 0.0)})}
    assert [rows[name]["correct"] for name in ("ours", "right", "wrong", "slow")] == [True, True, False, False]
    assert rows["ours"]["cpu_s_ratio"] == pytest.approx(0.1)
    assert rows["ours"]["work"] == pytest.approx(1000 * 0.1**2)
    assert rows["ours"]["work_ratio"] == pytest.approx(0.25)
    assert rows["ours"]["per_nat"] == pytest.approx(5.0)
    assert "DNF" in compare.table(rows.values())


@pytest.mark.slow
def test_a_run_in_a_process_of_its_own_is_told_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "compare.jsonl"
    for _ in range(2):
        compare.campaign(["plateau"], ["ours"], seeds=range(1), live=20, cap=30.0, out=out)
    (line,) = records.read_lines(out)
    assert line["status"] == "ok"
    assert line["cpu_s"] > 0
    assert capsys.readouterr().out.count("plateau, ours") == 1
