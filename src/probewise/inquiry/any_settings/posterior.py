"""The posterior after some readings: weighted samples and evidence, reweighted, redrawn, or sampled anew."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import chdtrc, logsumexp, ndtri

from probewise._arrays import FloatArray, IntArray
from probewise.errors import ParameterError
from probewise.inquiry.any_settings.noise import ReadingNoise
from probewise.inquiry.any_settings.settings import Column, Settings
from probewise.nested import NestedResult, Weighted, pareto_k, run, update
from probewise.nested.weights import n_effective
from probewise.priors import Joint, Prior, Product
from probewise.systems.calls import Caller

NOISE_SD = "noise.sd"
"""Name of the parameter that an unknown sd of the noise is."""

_KEEP = 0.25  # share of the draws that must count, else they are drawn anew
_N_PROBED = 3
_BLOCK = 2_000_000  # readings predicted at a time


@dataclass(frozen=True, eq=False)
class InstrumentModel:
    """Prior, predictions and noise of one instrument."""

    caller: Caller
    own_prior: Prior
    noise: ReadingNoise

    @classmethod
    def from_function(
        cls, function: Callable[..., Any], prior: Prior, noise: ReadingNoise, settings: Settings
    ) -> InstrumentModel:
        """Make the model of a user's function; find out if it takes arrays, one sample, or one reading at a time."""

        def call_with_arrays(parameters: Mapping[str, Any], columns: Mapping[str, Column]) -> Any:
            return function(dict(parameters), settings.in_model_form(columns))

        def call_for_one_sample(parameters: Mapping[str, Any], columns: Mapping[str, Column]) -> Any:
            rows = Settings(columns, settings.form)
            return np.array([function(dict(parameters), rows[k]) for k in range(len(rows))])

        u = np.linspace(0.2, 0.8, _N_PROBED)[:, None] * np.ones(len(prior.names))
        theta = prior.from_unit_cube(u)
        samples = {name: theta[:, [k]] for k, name in enumerate(prior.names)}
        some = settings.take(np.unique(np.linspace(0, len(settings) - 1, _N_PROBED).astype(int))).columns
        try:
            caller = Caller.from_trial_calls(
                call_with_arrays, samples, some, per_run=(), broadcasts=False, name="model"
            )
        except Exception:
            caller = Caller.from_trial_calls(
                call_for_one_sample, samples, some, per_run=(), broadcasts=False, name="model"
            )
        return cls(caller, prior, noise)

    @cached_property
    def prior(self) -> Prior:
        """The prior of the parameters, and at its end that of the noise sd if it is unknown."""
        if not self.noise.is_sd_inferred:
            return self.own_prior
        return Joint((self.own_prior, Product({NOISE_SD: self.noise.sd})))  # type: ignore[dict-item]

    def predict(self, theta: FloatArray, settings: Settings) -> FloatArray:
        """Predict readings, theta (n_samples, n_params) -> (n_samples, n_settings).

        Raises
        ------
        ParameterError
            If a prediction is not finite. What the function itself raises is passed on.
        """
        names, n = self.own_prior.names, len(settings)
        at_once = max(_BLOCK // n, 1)
        if len(theta) > at_once:
            return np.concatenate(
                [self.predict(theta[k : k + at_once], settings) for k in range(0, len(theta), at_once)]
            )
        samples = {name: theta[:, [k]] for k, name in enumerate(names)}
        out = self.caller(samples, settings.columns, strict=True)
        if not np.isfinite(out).all():
            self._raise_own_error(theta, settings, out)
        return out

    def _raise_own_error(self, theta: FloatArray, settings: Settings, out: FloatArray) -> None:
        """Raise the function's own error at the first sample without a finite prediction, else ParameterError."""
        sample, row = (int(k) for k in np.argwhere(~np.isfinite(out))[0])
        own = {name: theta[[sample], k : k + 1] for k, name in enumerate(self.own_prior.names)}
        self.caller(own, settings.columns, strict=True)
        at = ", ".join(f"{name} = {theta[sample, k]:.10g}" for k, name in enumerate(self.own_prior.names))
        raise ParameterError(f"the model at {at}, setting {settings[row]}", float(out[sample, row]), "finite readings")

    def scale(self, theta: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the sd of the noise of each prediction, (n_samples, n_settings)."""
        return self.noise.scale(predicted, theta[:, -1] if self.noise.is_sd_inferred else None)

    def log_density(self, theta: FloatArray, settings: Settings, readings: FloatArray) -> FloatArray:
        """Return the log density of readings, one per setting, (n_settings,), under theta: (n_samples, n_settings)."""
        predicted = self.predict(theta, settings)
        return self.noise.log_density(readings, predicted, self.scale(theta, predicted))


@dataclass(frozen=True, eq=False)
class ReadingsProblem:
    """Readings with their settings, as a problem for nested sampling.

    `settings` holds each distinct setting once; `row`, the setting's index, and `values` are of each reading,
    (n_readings,).
    """

    model: InstrumentModel
    settings: Settings
    row: IntArray
    values: FloatArray

    @property
    def prior(self) -> Prior:
        """Prior of the model's parameters."""
        return self.model.prior

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Return the log likelihood of all readings, (n_samples, n_params) -> (n_samples,)."""
        out = np.empty(len(theta))
        at_once = max(_BLOCK // len(self.values), 1)
        for k in range(0, len(theta), at_once):
            own = theta[k : k + at_once]
            predicted = self.model.predict(own, self.settings)
            scale = self.model.scale(own, predicted)
            density = self.model.noise.log_density(self.values, predicted[:, self.row], scale[:, self.row])
            out[k : k + at_once] = density.sum(axis=1)
        return out

    def p_value_and_worst_reading(self, theta: FloatArray) -> tuple[float, int]:
        """Return the chi-square p-value of one hypothesis (1, n_params), and the index of its worst-fitting reading.

        It has one degree of freedom per reading, regardless of fitted parameters, so that it is conservative.
        """
        predicted = self.model.predict(theta, self.settings)
        scale = self.model.scale(theta, predicted)
        tail = self.model.noise.smaller_tail(self.values, predicted[0, self.row], scale[0, self.row])
        z = np.abs(ndtri(np.clip(tail, 1e-300, 0.5)))
        return float(chdtrc(len(z), float(z @ z))), int(np.argmax(z))


def prior_samples(prior: Prior, n: int, *, rng: np.random.Generator) -> Weighted:
    """Draw `n` equally weighted samples of the prior, as the posterior without readings: its evidence is one."""
    theta = prior.from_unit_cube(rng.random((n, len(prior.names))))
    return Weighted(
        prior.names,
        theta,
        log_likelihood=np.zeros(n),
        log_weight=np.full(n, -math.log(n)),
        log_z=0.0,
        log_z_error=0.0,
        n_eff=float(n),
        n_calls=0,
        pareto_k=-math.inf,
    )


def updated_posterior(
    previous: Weighted,
    readings: ReadingsProblem,
    log_density: FloatArray,
    n: int,
    n_live: int,
    *,
    rng: np.random.Generator,
) -> Weighted:
    """Update the posterior by the last of the readings.

    Samples are reweighted. If too few keep weight, `nested.update` draws `n` from a density fitted to the samples,
    against all readings; if its draws are not reliable either, nested sampling with `n_live` points starts from the
    prior. `previous`: posterior given the readings before. `log_density`: of the last reading given each sample,
    (n_samples,).
    """

    def nested_run() -> NestedResult:
        return run(readings, rng=rng, n_live=n_live)

    reweighed = previous.log_weight + log_density
    gained = float(logsumexp(reweighed))
    if not math.isfinite(gained):
        found = nested_run()
        return update(found, readings, rng=rng, n_draws=n, fall_back=lambda: found)
    n_eff = n_effective(reweighed)
    now = replace(
        previous,
        log_likelihood=previous.log_likelihood + log_density,
        log_weight=reweighed - gained,
        log_z=previous.log_z + gained,
        log_z_error=math.sqrt(previous.log_z_error**2 + max(1 / max(n_eff, 1e-9) - 1 / previous.n_eff, 0.0)),
        n_eff=n_eff,
        pareto_k=pareto_k(reweighed),
        run=None,
    )
    if n_eff >= _KEEP * n and now.pareto_k < 0.7:
        return now

    return update(now, readings, rng=rng, n_draws=n, fall_back=nested_run)
