"""Evidence of fits: detectable sizes, refined nodes, values per run; principal axes of Gram matrices."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.special import log_ndtr, logsumexp
from scipy.stats import multivariate_normal, norm

from probewise.diagnosis.apparatus import PriorOdds
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import (
    LEAST_VISIBLE,
    laplace_evidence,
    log_probability_effects_detectable,
    mean_gain_over_parts,
    predictive_log_densities,
    refined,
)
from probewise.diagnosis.fit import Fit, Model, effect_coordinates, fit
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.noise import SAME_SD, NoiseLaw, NoiseModel, SdPrior, white_noise, white_noise_of_recording
from probewise.diagnosis.search.hypotheses import NoiseModels
from probewise.diagnosis.sensors import default_sensor
from probewise.effects import VOCABULARY, Extent, NoiseEffect
from probewise.effects.noise import correlated_noise, drifting_noise, outliers, random_walk, signal_dependent_noise
from probewise.recordings import Plan, Recording, paper_plan
from probewise.systems import Simulator, table_for

PLAN = paper_plan()
EXTENT = Extent(10.0, 60.0, PLAN)
SD = 0.5


@pytest.mark.parametrize("amount", [0.001, 0.004, 0.012])
def test_a_size_is_what_a_refit_without_the_effect_leaves(amount):
    """Route one: the effect's change, the slopes of all else taken out; route two: the null refitted in full."""
    sensor = default_sensor(EXTENT, 1)
    effect = VOCABULARY["ambient_gradient"].for_extent(EXTENT)
    model = Model(sensor, (effect,), PLAN)
    z = np.concatenate([np.full(sensor.n_params, 0.2), model.z_of_last_effect(np.array([[amount, 0.0]]))[0]])
    predicted, slopes = model.predict_and_differentiate(z)
    found = Fit(model, z, predicted, np.zeros(len(PLAN)), slopes, SD, 0.0)
    law = white_noise(len(PLAN))
    null = Model(sensor, (), PLAN)
    left = fit(
        null, Recording(PLAN, predicted), z[: sensor.n_params], law.with_least_sigma(SD), tolerance=1e-6
    ).residuals
    expected = float(log_ndtr(np.linalg.norm(left) / SD - LEAST_VISIBLE))
    assert log_probability_effects_detectable(found, law, np.arange(len(PLAN))) == pytest.approx(
        expected, abs=0.1 + 0.02 * abs(expected)
    )


@pytest.mark.parametrize(("n", "ratio"), [(12, 1.6), (30, 0.7), (400, 1.0), (400, 1.3), (400, 2.0)])
def test_the_evidence_of_the_calibrations_sd_is_that_of_an_integral(n, ratio):
    """Of a flat prior of log sd, the likelihood of n residuals is that of a gamma distribution of the precision."""
    prior, log_sd = SdPrior(0.0, 0.05), np.linspace(-2.0, 2.0, 20001)
    log_p = -n * (log_sd - math.log(ratio)) - 0.5 * n * (ratio / np.exp(log_sd)) ** 2
    wanted = logsumexp(log_p + norm.logpdf(log_sd, 0.0, 0.05)) - logsumexp(log_p)
    (found,) = prior.log_density(np.array([[math.log(ratio)], [0.5 / n]]))
    assert found == pytest.approx(wanted, abs=0.1, rel=0.08)


@pytest.mark.parametrize(("n", "expected"), [(24, 51.0), (100, 9.2), (408, 0.45)])
def test_an_unchanged_noise_sd_is_called_changed_as_rarely_as_computed(n, expected):
    """Of 100,000 pairs of calibration and recording, of `n` readings each; expected by two million others."""
    rng, prior = np.random.default_rng(7), PriorOdds(n_noises=7)
    sds = np.sqrt(rng.chisquare(n, (2, 100_000)) / n)
    odds = prior.log_prior_on_noise(("noise_sd",)) - prior.log_prior_on_noise(())
    known = SdPrior(0.0, math.hypot((2 * n) ** -0.5, SAME_SD), log_changed=odds)
    same, changed = known.log_odds(np.stack([np.log(sds[1] / sds[0]), np.full(100_000, 0.5 / n)]))
    assert abs(np.sum(changed > same) - expected) <= 4 * math.sqrt(expected) + 1


N = 2000


def _dense(effect: NoiseEffect) -> NoiseEffect:
    """Return the effect with 400 nodes of its one parameter, or 30 of each of two."""
    n = (400,) if len(effect.prior.names) == 1 else (30, 30)
    axes = np.meshgrid(*((np.arange(k) + 0.5) / k for k in n))
    nodes = effect.prior.from_unit_cube(np.stack(axes, axis=-1).reshape(-1, len(n)))
    return replace(effect, entries=nodes[:, None, :], nodes_per_parameter=n)


def _correlated(noise: np.ndarray, rho: float) -> np.ndarray:
    out = noise.copy()
    for k in range(1, len(out)):
        out[k] = rho * out[k - 1] + np.sqrt(1 - rho**2) * noise[k]
    return out


def _found_with(noise: np.ndarray) -> tuple[Fit, Recording]:
    """Make a fit of one parameter, at its prior's centre, to one long scan."""
    x = np.linspace(-1.0, 1.0, len(noise))
    zero = np.zeros(len(noise))
    none = np.zeros(len(noise), dtype=int)
    plan = Plan(x, zero, zero, np.arange(len(noise), dtype=float), none, ("scan",), none, ("edge",))
    model = cast(Any, SimpleNamespace(sensor=SimpleNamespace(has_exchangeable_gaussians=False)))
    slopes = np.random.default_rng(1).normal(size=(len(noise), 1))
    return Fit(model, np.zeros(1), 10 * x, noise, slopes, 1.0, 0.0), Recording(plan, 10 * x + noise)


RNG = np.random.default_rng(2)
WHITE = RNG.normal(size=N)
WIDE = np.where(RNG.random(N) < 0.05, 20.0, 1.0)


@pytest.mark.parametrize(
    ("effect", "noise"),
    [
        (random_walk(), WHITE + np.cumsum(0.9 * RNG.normal(size=N))),
        (correlated_noise(), _correlated(WHITE, 0.93)),
        (drifting_noise(), WHITE * 1.2 ** (np.arange(N) / N)),
        (signal_dependent_noise(), WHITE * np.sqrt(1 + 4 * np.arange(N) / N)),
        (outliers(), WHITE * WIDE),
    ],
    ids=lambda value: value.name if hasattr(value, "name") else "",
)
def test_refined_nodes_are_as_good_as_dense_ones(effect, noise):
    """Evidence to a tenth of a nat, mean and sd of each parameter to a fifth of the sd, and a node at the peak."""
    found, recording = _found_with(noise)
    wanted = laplace_evidence(found, NoiseModel((_dense(effect),), recording))
    own = refined(found, laplace_evidence(found, NoiseModel((effect,), recording)))
    assert own.log_z == pytest.approx(wanted.log_z, abs=0.1)
    means, sds = zip(*(_mean_and_sd(e) for e in (own, wanted)), strict=True)
    np.testing.assert_allclose(means[0], means[1], atol=0.2 * sds[1].min(), rtol=0.02)
    np.testing.assert_allclose(sds[0], sds[1], rtol=0.2)
    heights = [float((e.log_z_nodes - e.nodes.log_weights).max()) for e in (own, wanted)]
    assert heights[0] > heights[1] - 0.1
    assert len(own.nodes.laws) <= 9


def _mean_and_sd(evidence):
    mean = evidence.weights @ evidence.nodes.settings
    return mean, np.sqrt(evidence.weights @ (evidence.nodes.settings - mean) ** 2)


def test_a_pair_of_noises_has_no_less_evidence_than_all_its_nodes():
    """AR(1) of correlation .75 whose innovations are sometimes wide: every third node of it was 20 nats too low."""
    n = 300
    found, recording = _found_with(_correlated(WHITE[:n] * WIDE[:n], 0.75))
    effects = {"outliers": outliers(), "correlated_noise": correlated_noise()}
    noises = NoiseModels(recording, effects, PriorOdds())
    assert noises.add_significant_pairs(found, noises.evidence_by_noise(found))
    own = noises.evidence_by_noise(found)["correlated_noise", "outliers"]
    every = laplace_evidence(found, NoiseModel((correlated_noise(), outliers()), recording))
    assert own.log_z > every.log_z - 1.0
    assert _mean_and_sd(own)[0][0] == pytest.approx(0.75, abs=0.05)


def test_rounding_beyond_doubt_keeps_its_step_in_every_pair_of_noises():
    found, recording = _found_with(_correlated(WHITE[:300] * WIDE[:300], 0.75))
    recording = recording.with_readings(np.round(recording.readings))
    found = replace(found, residuals=recording.readings - found.predicted)
    rounded = cast(NoiseEffect, VOCABULARY["quantisation"](EXTENT))
    effects = {"outliers": outliers(), "correlated_noise": correlated_noise(), "quantisation": rounded}
    noises = NoiseModels(recording, effects, PriorOdds())
    assert noises.certain == ("quantisation",)
    assert noises.add_significant_pairs(found, noises.evidence_by_noise(found))
    assert len(noises.models) > len(effects)
    for names, evidence in noises.evidence_by_noise(found).items():
        at = evidence.noise.columns_of_effect("quantisation")
        np.testing.assert_allclose(evidence.nodes.settings[:, at], 1.0, err_msg=str(names))


def test_a_fit_at_the_edge_of_its_formula_is_impossible_under_any_noise():
    """A slope there is no number; neither is it a warning."""
    found, recording = _found_with(WHITE[:100])
    slopes = found.slopes.copy()
    slopes[7, 0] = np.nan
    for effects in ((), (random_walk(),), (outliers(),), (outliers(), random_walk())):
        evidence = laplace_evidence(replace(found, slopes=slopes), NoiseModel(effects, recording))
        assert evidence.log_z == -np.inf
        assert refined(found, evidence) is evidence


N_RUNS, N_EACH = 12, 30
_RUN = np.repeat(np.arange(N_RUNS), N_EACH)


def _readings(values, seed):
    return 3 + values[_RUN] + np.random.default_rng(seed).standard_normal(len(_RUN))


def _fitted(readings):
    """Return the recording, the fit of a mean alone, and those with one offset per run by each variant of its prior."""
    simulator = Simulator("y", "V", {"mean": (-50, 50)}, simulate=lambda p, u: p["mean"] + 0 * u["x"], run="run")
    table = table_for(simulator, {"x": _RUN % 7 * 1.0, "run": _RUN * 1.0, "y": readings})
    prepared = prepare_system(simulator, table)
    law, system = white_noise_of_recording(prepared.recording), prepared.null
    form = prepared.effects["offset_per_run"]
    means = np.array([readings[k == _RUN].mean() for k in range(N_RUNS)])
    null = fit(Model(system, (), prepared.recording.plan), prepared.recording, system.first, law)
    found = [
        fit(
            Model(system, (one,), prepared.recording.plan),
            prepared.recording,
            np.append(system.first, effect_coordinates(one, (means - means.mean())[None, :])[0]),
            law,
            max_steps=60,
        )
        for one in form.variants()
    ]
    return prepared.recording, null, found


def _summed_gain_in_evidence(readings, prior, sds, *, shared):
    """Route two: the log evidence of the offsets over none, by sums over the mean, the noise sd and the prior's sds."""
    means = np.array([readings[k == _RUN].mean() for k in range(N_RUNS)])[:, None]
    within = np.array([np.sum((readings[k == _RUN] - m) ** 2) for k, m in enumerate(means[:, 0])])[:, None]
    at = np.linspace(readings.mean() - 3 * readings.std(), readings.mean() + 3 * readings.std(), 801)
    with_offsets, without = [], []

    def of_runs(sd, spread):
        both = sd**2 + N_EACH * spread**2
        return -(N_EACH - 1) * np.log(sd) - 0.5 * (np.log(both) + within / sd**2 + N_EACH * (means - at) ** 2 / both)

    for sd in np.exp(np.linspace(np.log(readings.std() / 6), np.log(readings.std() * 1.6), 120)):
        each = np.stack([of_runs(sd, spread) for spread in prior.typical * sds]) - np.log(1 if shared else len(sds))
        one = logsumexp(each.sum(axis=1), axis=0) - np.log(len(sds)) if shared else logsumexp(each, axis=0).sum(axis=0)
        with_offsets.append(logsumexp(one))
        without.append(logsumexp(of_runs(sd, 0.0).sum(axis=0)))
    return logsumexp(with_offsets) - logsumexp(without)


@pytest.mark.parametrize("case", ["all differ", "one differs"])
def test_the_evidence_of_one_offset_per_run_is_that_of_sums(case):
    rng = np.random.default_rng(5)
    values = rng.standard_normal(N_RUNS) if case == "all differ" else np.where(np.arange(N_RUNS) == 2, 4.0, 0.0)
    readings = _readings(values, 6)
    recording, null, (shared, own) = _fitted(readings)
    noise = NoiseModel((), recording)
    gains = [laplace_evidence(each, noise).log_z - laplace_evidence(null, noise).log_z for each in (shared, own)]
    prior = shared.model.effects[0].prior.each
    exact = [
        _summed_gain_in_evidence(readings, prior, np.geomspace(0.05, 25, n), shared=together)
        for n, together in ((60, True), (9, False))
    ]
    assert gains[0] == pytest.approx(exact[0], abs=0.7)
    assert gains[1] == pytest.approx(exact[1], abs=3.0)
    assert (exact[0] > exact[1] + 3) == (case == "all differ")


PAPER = Recording(paper_plan(), np.zeros(len(paper_plan())))


def test_many_scans_side_by_side_are_kept_back_by_pattern_and_orientation():
    """Sixteen scans: eight lines over each of two orientations."""
    plan = PAPER.plan
    rows = np.flatnonzero(plan.scan < 2)
    scan = np.concatenate([8 * plan.scan[rows] + (np.arange(len(rows)) // 12) % 8])
    taken = plan.take(rows)
    many = type(taken)(
        **{
            **{name: getattr(taken, name) for name in taken.__dataclass_fields__},
            "scan": np.sort(scan),
            "scan_names": tuple(f"line_{k}" for k in range(16)),
        }
    )
    parts, names = LightSensorApparatus().held_out_parts(Recording(many, np.zeros(len(many))))
    assert len(names) == 2
    assert names[0].endswith("0 degrees")
    np.testing.assert_array_equal(parts, np.round(many.orientation_rad / (np.pi / 2)).astype(int) - int(parts[0] != 0))
    a_turn_more = replace(many, orientation_rad=many.orientation_rad + 2 * np.pi * (many.scan % 2))
    again, names_again = LightSensorApparatus().held_out_parts(Recording(a_turn_more, np.zeros(len(many))))
    np.testing.assert_array_equal(again, parts)
    assert names_again == names
    held = mean_gain_over_parts(parts, lambda out: np.where(parts[out] == 0, 1.0, -1.0), names)
    assert dict(held.by_scan) == {names[0]: 1.0, names[1]: -1.0}


def _covariance(kind, sd):
    """Return a noise law of 60 readings and its covariance, in units of sigma^2."""
    n, at, nothing = len(sd), np.arange(len(sd)), np.zeros(len(sd))
    if kind == "walk":
        return NoiseLaw(sd, nothing, nothing > 0, walk=np.full(n, 0.3)), 0.3 * (1 + np.minimum.outer(at, at)) + np.diag(
            sd**2
        )
    carry = np.where(at > 0, 0.9, 0.0)
    return NoiseLaw(sd, carry, nothing > 0), 0.9 ** np.abs(np.subtract.outer(at, at)) * np.outer(sd, sd)


@pytest.mark.parametrize("kind", ["walk", "ar"])
@pytest.mark.parametrize("block", [(0, 12), (24, 36), (48, 60)])
def test_a_part_held_out_of_noise_with_memory_has_its_density_given_the_rest(kind, block):
    """Route two: the multivariate normal of all readings over that of those kept, coordinates integrated out."""
    rng, n, sigma = np.random.default_rng(8), 60, 0.4
    law, covariance = _covariance(kind, rng.uniform(0.5, 1.5, n))
    slopes = np.stack([np.ones(n), np.linspace(-3, 3, n), np.sin(np.arange(n))], axis=1)
    every = slopes @ slopes.T + sigma**2 * covariance
    readings = rng.multivariate_normal(np.zeros(n), every)
    out = (np.arange(n) >= block[0]) & (np.arange(n) < block[1])
    rest = np.linalg.inv(sigma**2 * covariance[np.ix_(~out, ~out)])
    spread = np.linalg.inv(slopes[~out].T @ rest @ slopes[~out] + np.eye(3))
    mean = spread @ slopes[~out].T @ rest @ readings[~out]
    found = predictive_log_densities(law, out, readings, slopes, mean, spread, sigma**2)
    kept = multivariate_normal(np.zeros(n - 12), every[np.ix_(~out, ~out)])
    assert found.sum() == pytest.approx(
        multivariate_normal(np.zeros(n), every).logpdf(readings) - kept.logpdf(readings[~out])
    )
    told = every[np.ix_(out, ~out)] @ np.linalg.inv(every[np.ix_(~out, ~out)])
    left, variance = (
        readings[out] - told @ readings[~out],
        np.diag(every[np.ix_(out, out)] - told @ every[~out][:, out]),
    )
    alone = predictive_log_densities(law, out, readings, slopes, mean, spread, sigma**2, sequential=False)
    np.testing.assert_allclose(alone, -0.5 * (np.log(2 * np.pi * variance) + left**2 / variance), rtol=1e-6)
