"""Inquiry with any instrument: the posterior after each reading, and the setting to read next."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, floats, own_arithmetic
from probewise._display import ShowsItself
from probewise._kinds import checked_finite_number, checked_whole, require_callable, require_rng
from probewise.errors import ParameterError, ShapeError, did_you_mean
from probewise.inquiry.any_settings.acquisition import Predictive
from probewise.inquiry.any_settings.noise import AnyNoise, ReadingNoise
from probewise.inquiry.any_settings.posterior import InstrumentModel, ReadingsProblem, prior_samples, updated_posterior
from probewise.inquiry.any_settings.settings import Settings
from probewise.inquiry.entropy import choose
from probewise.nested import Weighted, make_problem
from probewise.nested.problem import AnyPrior
from probewise.nested.weights import resampled_rows
from probewise.priors import require_prior

_N_ASKED = 1000  # samples whose predictions value the settings
_FEWER_ASKED = 200  # of a model that is called for one sample at a time
_N_IMAGINED = 8
_DOUBT_P = 1e-6
_NEAR_GOAL = 3.0  # times the sds that are asked for
_BITS = "expected information (bits)"
_NEARER = "expected fall of the sum of ln(sd / goal)"


class Inquiry(ShowsItself):
    """An inquiry: the posterior of a model's parameters, and the setting with the largest acquisition function.

    Parameters
    ----------
    model
        Predicts readings: `model(parameters, settings)`, `parameters` a dict by name, `settings` in the form in which
        they are given here. It is called with arrays that broadcast, parameters (n_samples, 1) against settings
        (n_settings,), if that gives the same readings; otherwise sample by sample, and if need be setting by setting.
    prior
        Distributions by name (`probewise.priors` or frozen ones of scipy.stats), or a prior.
    settings
        Every setting that the instrument has: numbers or names (n_settings,) of one knob; numbers (n_settings, n_knobs)
        of several, which the model gets as (n_knobs, n_settings), to be unpacked; or a dict of columns by name.
    noise
        Sd of a reading's noise: a number, a function of the predicted reading, or a prior if it is unknown; or a
        `ReadingNoise`, for heavy tails and outliers.
    rng
        Source of randomness: the same generator and readings give the same choices.
    goal
        Target posterior sd by parameter: `{"centre_hz": 0.5}`. Readings are then chosen to reach it, and `settled`
        turns True. Without it, readings are chosen for the information about all parameters.
    cost_s
        Seconds that a reading takes at each setting, (n_settings,); or a function of the last setting (None at first)
        that returns them. `utility` is then per second.
    n_samples
        Posterior samples, 400 or more.
    n_live
        Live points of nested sampling, which starts anew if the samples cannot follow a surprising reading.

    Raises
    ------
    ParameterError
        If an argument is of the wrong kind.
    ShapeError
        If `cost_s` has not one number per setting.
    """

    @own_arithmetic
    def __init__(
        self,
        model: Callable[..., Any],
        prior: AnyPrior,
        settings: Any,
        noise: AnyNoise,
        *,
        rng: np.random.Generator,
        goal: Mapping[str, float] | None = None,
        cost_s: Sequence[float] | FloatArray | Callable[[Any], Any] | None = None,
        n_samples: int = 4000,
        n_live: int = 300,
    ) -> None:
        require_callable("model", model, "a function model(parameters, settings) that predicts readings")
        require_rng(rng)
        named = make_problem(lambda _: 0.0, prior).prior
        require_prior("prior", named, "to_unit_cube", "log_prob")
        self._settings = Settings.of(settings)
        self._model = InstrumentModel.from_function(model, named, ReadingNoise.of(noise), self._settings)
        self._rng = rng
        self._goal = _checked_goal(goal, self._model.prior.names)
        self._cost_s = cost_s
        self._n_samples, self._n_live = (
            checked_whole("n_samples", n_samples, least=400, most=1_000_000),
            checked_whole("n_live", n_live),
        )
        self._posterior = prior_samples(self._model.prior, self._n_samples, rng=rng)
        self._taken: list[tuple[Any, float]] = []
        self._readings: ReadingsProblem | None = None
        self._utility: FloatArray | None = None
        self._next: Any = None
        self._costs_s(None)

    @property
    def posterior(self) -> Weighted:
        """The posterior as `nested.Weighted` samples: `mean()`, `sd()`, `interval(0.95)`, `samples(n, rng=rng)`."""
        return self._posterior

    @property
    def evidence(self) -> tuple[float, float]:
        """Natural log of the evidence of the readings, and its standard error."""
        return self._posterior.log_z, self._posterior.log_z_error

    @property
    def readings(self) -> tuple[tuple[Any, float], ...]:
        """Pairs (setting, reading) so far; to resume, call `tell(reading, setting)` of a new inquiry for each."""
        return tuple(self._taken)

    @property
    @own_arithmetic
    def utility(self) -> FloatArray:
        """Acquisition function of each setting, (n_settings,), per second if the costs in seconds are given.

        It is the expected information, bits, until every sd that the goal names is within three times its goal; then
        the expected decrease of the sum of ln(sd / goal), until the goal is reached; and from then on information
        again.
        """
        if self._utility is None:
            self._utility = self._utility_for_weights(self._posterior.weight) / self._costs_s(self._last_setting)
            self._utility.flags.writeable = False
        return self._utility

    @property
    def utility_label(self) -> str:
        """Axis label of the acquisition function, with its unit."""
        per_second = "" if self._cost_s is None else " per second"
        return f"{_NEARER if self._is_near_goal else _BITS}{per_second}"

    @property
    @own_arithmetic
    def settled(self) -> bool:
        """Whether the posterior sd of every parameter in the goal is at most its goal.

        Raises ParameterError if the inquiry has no goal.
        """
        if not self._goal:
            raise ParameterError("goal", None, 'posterior sds by parameter, such as {"centre_hz": 0.5}')
        return self._largest_sd_over_goal <= 1.0

    @property
    @own_arithmetic
    def doubt(self) -> str | None:
        """A warning if even the best posterior sample does not explain the readings (chi-square, p < 1e-6); or None.

        It names the reading that fits worst.
        """
        if self._readings is None:
            return None
        best = self._posterior.theta[[int(np.argmax(self._posterior.log_likelihood))]]
        p_value, worst = self._readings.p_value_and_worst_reading(best)
        if p_value >= _DOUBT_P:
            return None
        setting, value = self._taken[worst]
        return (
            f"no hypothesis explains the readings: the best has p = {p_value:.1g} and is worst at reading {worst + 1} "
            f"({value:g} at {setting}); the model leaves something out, the prior excludes the truth, or the noise is "
            "greater than stated"
        )

    @own_arithmetic
    def next(self) -> Any:
        """Return the setting with the largest acquisition function, in the form of `settings`; ties break at random."""
        if self._next is None:
            row = choose(self.utility, np.ones(len(self._settings), dtype=np.bool_), rng=self._rng)
            self._next = self._settings[row]
        return self._next

    @own_arithmetic
    def tell(self, reading: float, setting: Any = None) -> None:
        """Update the posterior by a reading.

        Parameters
        ----------
        reading
            The value read.
        setting
            Its setting, which need not be one of the settings; by default the one that `next()` returned since the
            last reading.

        Raises
        ------
        ParameterError
            If the reading is not a finite number, the setting not of the form of `settings`, or not given though
            `next()` was not called since the last reading. The posterior is unchanged.
        NotConvergedError
            If no hypothesis could have given these readings. The posterior is unchanged.
        """
        value = checked_finite_number("reading", reading, "a finite number; leave out a missing reading")
        if setting is None and self._next is None:
            way_out = (
                "the setting of this reading: tell(reading, setting); next() has chosen none since the last reading"
            )
            raise ParameterError("setting", None, way_out)
        at = self._settings.checked_setting(self._next if setting is None else setting)
        readings = _append_reading(self._readings, self._model, at, value)
        theta = self._posterior.theta
        log_density = self._model.log_density(theta, at, np.array([value]))[:, 0]
        self._posterior = updated_posterior(
            self._posterior, readings, log_density, self._n_samples, self._n_live, rng=self._rng
        )
        self._readings = readings
        self._taken.append((at[0], value))
        self._utility, self._next = None, None

    @own_arithmetic
    def several(self, n: int) -> list[Any]:
        """Choose the settings of `n` readings to be taken before any of them is known; best first.

        Greedy: each setting has the largest utility given those before it in the list, averaged over simulated readings
        there. While the utility is information, this is greedy on the joint information (Nemhauser, Wolsey & Fisher
        1978). Costs count from the setting before it. Pass the results one by one to `tell(reading, setting)`.
        ParameterError if `n` is below 1.
        """
        checked_whole("n", n)
        everywhere = np.ones(len(self._settings), dtype=np.bool_)
        rows = [choose(self.utility, everywhere, rng=self._rng)]
        theta, noise = self._posterior.theta, self._model.noise
        weights = [self._posterior.weight] * _N_IMAGINED
        while len(rows) < n:
            predicted = self._model.predict(theta, self._settings.take(np.array(rows[-1:])))
            scale = self._model.scale(theta, predicted)
            for k, weight in enumerate(weights):
                truth = [self._rng.choice(len(weight), p=weight / weight.sum())]
                imagined = noise.draw(predicted[truth], scale[truth], rng=self._rng)
                log_density = noise.log_density(imagined, predicted, scale)[:, 0]
                weights[k] = weight * np.exp(log_density - log_density[weight > 0].max())
            cost_s = self._costs_s(self._settings[rows[-1]])
            utility = np.mean([self._utility_for_weights(weight) for weight in weights], axis=0) / cost_s
            rows.append(choose(utility, everywhere, rng=self._rng))
        return [self._settings[row] for row in rows]

    @own_arithmetic
    def summary(self) -> str:
        """Describe the posterior in plain text."""
        found = self._posterior
        width = max(9, *(len(name) for name in found.names))
        low, high = found.interval(0.95)
        lines = [
            f"{len(self._taken)} readings, log Z {found.log_z:.2f} ± {found.log_z_error:.2f}, "
            f"effective sample size {found.n_eff:.0f} of {len(found.theta)}",
            f"{'parameter':<{width}}  {'mean':>11}  {'sd':>11}  95 % interval",
        ]
        for name, mean, sd, a, b in zip(found.names, found.mean(), found.sd(), low, high, strict=True):
            goal = f", asked for {self._goal[name]:.3g}" if name in self._goal else ""
            lines.append(f"{name:<{width}}  {mean:>11.5g}  {sd:>11.3g}  {a:.5g} to {b:.5g}{goal}")
        return "\n".join([*lines, *([] if self.doubt is None else [f"doubtful: {self.doubt}"])])

    @property
    def _largest_sd_over_goal(self) -> float:
        """Largest ratio of a posterior sd to its goal."""
        sd = dict(zip(self._posterior.names, self._posterior.sd(), strict=True))
        return float(max(sd[name] / goal for name, goal in self._goal.items()))

    @property
    def _is_near_goal(self) -> bool:
        """Whether the goal is not reached yet, but every sd is within three times its goal."""
        return bool(self._goal) and 1.0 < self._largest_sd_over_goal < _NEAR_GOAL

    def _utility_for_weights(self, weight: FloatArray) -> FloatArray:
        """Compute the acquisition function per reading, (n_settings,), for the posterior samples with these weights."""
        n = _N_ASKED if self._model.caller.broadcasts else _FEWER_ASKED
        theta = self._posterior.theta[resampled_rows(weight, n, self._rng)]
        theta = theta[self._rng.permutation(n)]  # copies of one sample apart
        predicted = self._model.predict(theta, self._settings)
        predictive = Predictive(predicted, self._model.scale(theta, predicted), self._model.noise)
        if not self._is_near_goal:
            return predictive.information()
        values, goal = theta[:, [self._posterior.names.index(name) for name in self._goal]], [*self._goal.values()]
        now = np.maximum(np.log(values.std(axis=0) / goal), 0.0).sum()
        return np.asarray(now - predictive.expected_nats_above_goal(values, np.array(goal)))

    @property
    def _last_setting(self) -> Any:
        """Setting of the last reading; None before the first."""
        return self._taken[-1][0] if self._taken else None

    def _costs_s(self, last: Any) -> FloatArray:
        """Return the seconds of a reading at each setting after one at `last`, (n_settings,) or a number; default 1.

        ShapeError or ParameterError for costs of a wrong shape or not above 0.
        """
        given = self._cost_s
        if given is None:
            return np.ones(len(self._settings))
        if callable(given):
            given = given(last)
        cost_s = floats(given, "cost_s")
        if cost_s.shape not in ((), (len(self._settings),)):
            raise ShapeError(f"cost_s has shape {cost_s.shape}; allowed: ({len(self._settings)},), one per setting")
        if not ((cost_s > 0) & np.isfinite(cost_s)).all():
            raise ParameterError("cost_s", cost_s.tolist(), "seconds greater than 0, finite")
        return cost_s


def _checked_goal(goal: Mapping[str, float] | None, names: tuple[str, ...]) -> dict[str, float]:
    """Return the target sds by parameter, empty if no goal is given; ParameterError for anything else."""
    if goal is None:
        return {}
    if not isinstance(goal, Mapping) or not goal:
        raise ParameterError("goal", goal, 'posterior sds by parameter, such as {"centre_hz": 0.5}')
    for name, sd in goal.items():
        if name not in names:
            raise ParameterError("goal", name, f"parameters among {', '.join(names)}{did_you_mean(name, names)}")
        if not checked_finite_number(f"goal[{name!r}]", sd) > 0:
            raise ParameterError(f"goal[{name!r}]", sd, "greater than 0")
    return dict(goal)


def _append_reading(
    readings: ReadingsProblem | None, model: InstrumentModel, at: Settings, value: float
) -> ReadingsProblem:
    """Return the readings with one more; a setting that was read before is not listed again."""
    if readings is None:
        return ReadingsProblem(model, at, np.array([0]), np.array([value]))
    known = readings.settings
    same = np.ones(len(known), dtype=np.bool_)
    for name, column in known.columns.items():
        same &= column == at.columns[name][0]
    row = int(np.argmax(same)) if same.any() else len(known)
    settings = known if same.any() else known.joined(at)
    return ReadingsProblem(model, settings, np.append(readings.row, row), np.append(readings.values, value))
