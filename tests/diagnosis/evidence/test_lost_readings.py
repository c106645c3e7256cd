"""Lost readings carry no information: nothing changes where they are taken out of the recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import Linearised, OrthonormalBlocks, block_log_bayes_factors
from probewise.diagnosis.fit import Fit, Model, fit
from probewise.diagnosis.held_out import held_out_gain
from probewise.diagnosis.locate import Covariate, significant_places
from probewise.diagnosis.noise_law import NoiseLaw, white_noise
from probewise.diagnosis.templates import TemplateBank
from probewise.systems import Simulator, table_for

N = 60
TIME = np.arange(float(N))
LOST = np.arange(N) % 4 == 1
LAW = NoiseLaw(np.ones(N), np.zeros(N), LOST)
WITHOUT = white_noise(int((~LOST).sum()))


def fit_of_noise() -> tuple[Fit, Fit]:
    """Make a fit of two coordinates to noise with a bump, and the same without the lost readings."""
    rng = np.random.default_rng(3)
    residuals = rng.standard_normal(N) + 2.0 * ((TIME >= 20) & (TIME < 32))
    slopes = np.stack([np.full(N, 10.0), 0.1 * TIME], axis=1)
    found = Fit(cast(Any, None), np.array([0.3, -0.2]), np.zeros(N), residuals, slopes, 1.0, 0.0)
    kept = replace(found, predicted=found.predicted[~LOST], residuals=residuals[~LOST], slopes=slopes[~LOST])
    return found, kept


def test_lost_readings_change_no_bayes_factor():
    templates = [np.cos(np.pi * TIME[:, None] / N * np.arange(1, k + 1)) for k in (1, 3, 8, 24)]
    both = []
    for found, law, rows in zip(fit_of_noise(), (LAW, WITHOUT), (np.full(N, True), ~LOST), strict=True):
        problem, columns = Linearised.of(found, law), [t[rows] for t in templates]
        bank = TemplateBank.of(columns, ["a"] * len(columns), len(problem.law.sd))
        blocks = OrthonormalBlocks.of(problem, columns)
        by_blocks = block_log_bayes_factors(blocks, problem.residual[:, None], problem.n_kept)
        np.testing.assert_allclose(bank.log_bayes_factors(problem), by_blocks)
        both.append(by_blocks)
    np.testing.assert_allclose(*both)


def test_lost_readings_change_neither_the_noise_sd_nor_the_significance_of_a_window():
    found, kept = fit_of_noise()
    problem, shorter = Linearised.of(found, LAW), Linearised.of(kept, WITHOUT)
    assert problem.sd == pytest.approx(shorter.sd)
    read = np.flatnonzero(~LOST)
    (place,), (again,) = (
        significant_places(
            one,
            [Covariate("time", TIME[read], rows)],
            (),
            fitted.residuals,
            one.draw_null_residuals(400, rng=np.random.default_rng(0)),
        )
        for one, rows, fitted in ((problem, read, found), (shorter, np.arange(len(read)), kept))
    )
    assert (place.start, place.end) == (again.start, again.end)
    assert place.z == pytest.approx(again.z)


def test_lost_readings_change_no_density_of_held_out_readings():
    """A line predicts more than a constant, and as much more where lost readings are missing in the table instead."""
    x = np.sin(0.7 * TIME)
    y = 1.0 + 0.1 * x + 0.1 * np.random.default_rng(5).standard_normal(N)
    simulators = (
        Simulator("y", "V", {"a": (-5, 5)}, simulate=lambda p, u: p["a"] + 0 * u["x"]),
        Simulator("y", "V", {"a": (-5, 5), "b": (-5, 5)}, simulate=lambda p, u: p["a"] + p["b"] * u["x"]),
    )
    gains = []
    for readings, law in ((np.where(LOST, -20.0, y), LAW), (np.where(LOST, np.nan, y), WITHOUT)):
        fits = []
        for simulator in simulators:
            prepared = prepare_system(simulator, table_for(simulator, {"x": x, "y": readings}), with_effects=False)
            model = Model(prepared.null, (), prepared.recording.plan)
            fits.append(fit(model, prepared.recording, np.zeros(model.n_params), law))
        parts = (TIME[prepared.recording.usable] // 20).astype(int), ("1", "2", "3")
        gain = held_out_gain(*fits, prepared.recording, law, parts, law_of_null=law)
        gains.append(gain.per_reading * gain.n_readings)
    assert gains[1] > 1
    assert gains[0] == pytest.approx(gains[1], rel=1e-3)
