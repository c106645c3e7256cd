"""Evidence of one value per run, against sums over scales, means and noise sds; and its gain on runs held out."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import laplace_evidence
from probewise.diagnosis.fit import Model, effect_coordinates, fit
from probewise.diagnosis.held_out import held_out_gain
from probewise.diagnosis.noise_law import white_noise_of_recording
from probewise.diagnosis.noise_models import NoiseModel
from probewise.effects.priors import SharedScalePrior
from probewise.systems import Simulator, table_for

N_RUNS, N_EACH = 12, 30
_X = 0
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


def test_a_run_held_out_is_expected_to_differ_as_much_as_the_others():
    """Route two: normal values with the sd of the other runs' means, each run's readings together."""
    rng = np.random.default_rng(7)
    readings = _readings(rng.standard_normal(N_RUNS), 8)
    recording, null, (shared, own) = _fitted(readings)
    law, parts = white_noise_of_recording(recording), (_RUN, tuple(map(str, range(N_RUNS))))
    found, apart = (held_out_gain(null, each, recording, law, parts, law_of_null=law) for each in (shared, own))
    means = np.array([readings[k == _RUN].mean() for k in range(N_RUNS)])
    exact = []
    for name, _ in found.by_scan:
        held, rest = readings[int(name) == _RUN], readings[int(name) != _RUN]
        others = np.delete(means, int(name))
        covariance = np.eye(N_EACH) + others.var(ddof=1) * (1 + 1 / len(others))
        exact.append(multivariate_normal.logpdf(held, np.full(N_EACH, others.mean()), covariance))
        exact[-1] -= norm.logpdf(held, rest.mean(), rest.std()).sum()
    assert found.per_reading * found.n_readings == pytest.approx(sum(exact), abs=10)
    assert found.per_reading > apart.per_reading


def test_many_runs_keep_priors_of_their_own():
    simulator = Simulator("y", "V", {"mean": (-50, 50)}, simulate=lambda p, u: p["mean"] + 0 * u["x"], run="run")
    run = np.repeat(np.arange(40.0), 3)
    readings = np.random.default_rng(0).standard_normal(len(run))
    prepared = prepare_system(simulator, table_for(simulator, {"x": run % 7, "run": run, "y": readings}))
    (form,) = prepared.effects["offset_per_run"].variants()
    assert not isinstance(form.prior, SharedScalePrior)
