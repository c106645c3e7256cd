"""The choice of the next setting of any instrument, from a model of its readings, a prior, settings and noise.

The paper's machine learning system without a field of shapes: readings update weighted samples of the posterior
(`inquiry.smc`), and the next setting maximises an acquisition function (`Inquiry.utility`): expected information
(Lindley 1956) or, near a goal, the expected decrease of the posterior sds towards the goal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtri

from probewise._arrays import FloatArray, IntArray, floats, nearly_equal, own_arithmetic
from probewise._display import ShowsItself
from probewise._kinds import checked_finite_number, checked_whole, require_callable, require_rng
from probewise.errors import ParameterError, ShapeError, did_you_mean, require
from probewise.inquiry.predictive import (
    AnyNoise,
    ReadingNoise,
    expected_nats_above_goal,
    gaussian_nats_above_goal,
    readings_given_noise,
)
from probewise.inquiry.smc import LIGHT, nested_sampling_from_scratch, particles_from_posterior, prior_particles, update
from probewise.nested import Weighted, make_problem
from probewise.nested.problem import AnyPrior
from probewise.nested.weights import resampled_rows
from probewise.priors import Joint, Prior, Product, require_prior
from probewise.recordings.columns import columns_by_name

Column: TypeAlias = NDArray[Any]

NOISE_SD = "noise.sd"
"""Name of the parameter that an unknown sd of the noise is."""

_ALLOWED = (
    "one knob: numbers or names (n,); several: numbers (n, n_knobs), a row for each setting; or columns (n,) by "
    "name, all of one length: a dict or a data frame"
)
_BLOCK = 2_000_000  # densities held, or readings predicted, at a time
_LOST_NATS = 3.0  # prior samples overrate the evidence by as much in 5 % of cases at most (Markov's inequality)
_N_PROBED = 3
_N_PREDICTED = 500  # samples whose predictions value the settings
_FEWER_PREDICTED = 200  # of a model that is called for one sample at a time
_TIE = 1e-9  # utilities closer than this differ by rounding only
_N_ROUGH = 120  # samples that choose the settings for a closer look, far from a goal
_N_BEST = 32  # settings that get it
_FEW_SETTINGS = 64  # all of which get it
_N_IMAGINED = 8
_DOUBT_P = 1e-6
_NEAR_GOAL = 3.0  # times the target sds
_BITS = "expected information (bits)"
_NEARER = "expected fall of the sum of ln(sd / goal)"


@dataclass(frozen=True, eq=False)
class Settings:
    """Settings as columns (n,) by name; `form` is how the user gave them, and how user and model get them back.

    `form`: "one" knob, an array (n,); "several" knobs, an array (n, n_knobs); or knobs by "name", a dict of columns.
    """

    columns: Mapping[str, Column]
    form: str

    @classmethod
    def of(cls, given: Any) -> Settings:
        """Read settings in any of their forms; ParameterError for anything else."""
        if isinstance(given, Settings):
            return given
        if hasattr(given, "columns"):  # a data frame
            given = columns_by_name(given)
        if isinstance(given, Mapping):
            columns = {str(name): _checked_column(f"settings[{name!r}]", values) for name, values in given.items()}
            if not columns or len({len(column) for column in columns.values()}) != 1:
                sizes = {name: len(column) for name, column in columns.items()}
                raise ParameterError("settings", sizes, _ALLOWED)
            return cls(columns, "name")
        if isinstance(given, np.ma.MaskedArray):
            given = floats(given, "settings")  # what is masked is NaN
        try:
            array = np.asarray(given)
        except ValueError as error:
            raise ParameterError("settings", given, _ALLOWED) from error
        if array.ndim != 2 or not array.size:
            return cls({"setting": _checked_column("settings", given)}, "one")
        knobs = array.T if array.dtype.kind != "U" else np.asarray(given, dtype=object).T
        columns = {str(k): _checked_column("settings", column.tolist()) for k, column in enumerate(knobs)}
        require(len({column.dtype.kind for column in columns.values()}) == 1, "settings", given, _ALLOWED)
        return cls(columns, "several")

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def take(self, rows: IntArray) -> Settings:
        """Return the settings with these indices."""
        return Settings({name: column[rows] for name, column in self.columns.items()}, self.form)

    def joined(self, other: Settings) -> Settings:
        """Return these settings, then `other`."""
        return Settings({n: np.concatenate([c, other.columns[n]]) for n, c in self.columns.items()}, self.form)

    def in_model_form(self) -> Any:
        """Return copies of the columns as the model gets them; several knobs as (n_knobs, n), to be unpacked."""
        if self.form == "one":
            return self.columns["setting"].copy()
        if self.form == "several":
            return np.stack(list(self.columns.values()))
        return {name: column.copy() for name, column in self.columns.items()}

    def __getitem__(self, row: int) -> Any:
        """Return one setting: a number or a name, an array (n_knobs,), or a dict by name."""
        knobs = {n: str(c[row]) if isinstance(c[row], str) else float(c[row]) for n, c in self.columns.items()}
        if self.form == "one":
            return knobs["setting"]
        return np.array(list(knobs.values())) if self.form == "several" else knobs

    def checked_setting(self, setting: Any) -> Settings:
        """Parse one setting given in the form of `self[row]` as Settings of length 1; it need not be one of these.

        ParameterError if it is not of that form.
        """
        by_name = self.form == "name" and isinstance(setting, Mapping)
        try:
            one = Settings.of({name: [value] for name, value in setting.items()} if by_name else [setting])
        except ParameterError:
            one = Settings({}, self.form)
        kinds, here = ({name: column.dtype.kind for name, column in of.columns.items()} for of in (one, self))
        require(one.form == self.form and kinds == here, "setting", setting, f"one like those given, such as {self[0]}")
        return one


def _checked_column(name: str, values: Any) -> Column:
    """Convert the values of one knob to a read-only column of finite numbers or of names, (n,)."""
    array = np.array(floats(values, name) if isinstance(values, np.ma.MaskedArray) else values)
    require(array.ndim == 1 and array.size and array.dtype.kind in "biufU", name, values, _ALLOWED)
    if array.dtype.kind == "U":  # NumPy makes numbers among names texts
        require(all(isinstance(one, str) for one in values), name, values, _ALLOWED)
    else:
        array = array.astype(np.float64)
        if not np.isfinite(array).all():
            raise ParameterError(name, float(array[~np.isfinite(array)][0]), "finite numbers")
    array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False)
class InstrumentModel:
    """Prior, predictions and noise of one instrument.

    `call` predicts readings, theta (n_samples, n_params) at settings -> (n_samples, n_settings); `broadcasts` says if
    the user's function is called for all samples at once.
    """

    call: Callable[[FloatArray, Settings], FloatArray]
    broadcasts: bool
    own_prior: Prior
    noise: ReadingNoise

    @classmethod
    def from_function(
        cls, function: Callable[..., Any], prior: Prior, noise: ReadingNoise, settings: Settings
    ) -> InstrumentModel:
        """Make the model of a user's function; find out if it takes arrays, one sample, or one reading at a time.

        ParameterError if no prediction is finite, or if another call with the same parameters returns other readings.
        """
        names = prior.names
        together, one_sample, one_reading = (
            partial(call, function, names) for call in (_all_readings, _readings_of_sample, _each_reading_of_sample)
        )
        theta = prior.from_unit_cube(np.linspace(0.2, 0.8, _N_PROBED)[:, None] * np.ones(len(names)))
        some = settings.take(np.unique(np.linspace(0, len(settings) - 1, _N_PROBED).astype(int)))
        try:
            alone, one = _repeatable(one_sample, theta, some), one_sample
        except Exception:
            alone, one = _repeatable(one_reading, theta, some), one_reading
        try:
            if nearly_equal(together(theta, some), alone):
                return cls(together, True, prior, noise)
        except Exception:  # it takes no arrays
            pass
        return cls(_OneByOne(one, len(names), max(_BLOCK // len(settings), 1)), False, prior, noise)

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
        at_once = max(_BLOCK // len(settings), 1)
        if len(theta) > at_once:
            parts = (theta[k : k + at_once] for k in range(0, len(theta), at_once))
            return np.concatenate([self.predict(part, settings) for part in parts])
        out = self.call(theta, settings)
        if not np.isfinite(out).all():
            sample, row = (int(k) for k in np.argwhere(~np.isfinite(out))[0])
            at = ", ".join(f"{name} = {theta[sample, k]:.10g}" for k, name in enumerate(self.own_prior.names))
            name = f"the model at {at}, setting {settings[row]}"
            raise ParameterError(name, float(out[sample, row]), "finite readings")
        return out

    def scale(self, theta: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the sd of the noise of each prediction, (n_samples, n_settings)."""
        return self.noise.scale(predicted, theta[:, -1] if self.noise.is_sd_inferred else None)


def _all_readings(function: Callable[..., Any], names: Sequence[str], theta: FloatArray, at: Settings) -> FloatArray:
    parameters = {name: theta[:, [k]] for k, name in enumerate(names)}
    return _called(function, parameters, at.in_model_form(), (len(theta), len(at)))


def _readings_of_sample(function: Callable[..., Any], names: Sequence[str], values: bytes, at: Settings) -> FloatArray:
    parameters = dict(zip(names, np.frombuffer(values).tolist(), strict=True))
    return _called(function, parameters, at.in_model_form(), (len(at),))


def _each_reading_of_sample(
    function: Callable[..., Any], names: Sequence[str], values: bytes, at: Settings
) -> FloatArray:
    parameters = dict(zip(names, np.frombuffer(values).tolist(), strict=True))
    return np.array([_called(function, dict(parameters), at[k], ()) for k in range(len(at))])


class _OneByOne:
    """Calls `one` for one sample after the other and remembers the readings of the last `n_remembered`."""

    def __init__(self, one: Callable[[bytes, Settings], FloatArray], n_params: int, n_remembered: int) -> None:
        self._made_of = (one, n_params, n_remembered)
        self._remembered = lru_cache(n_remembered)(one)

    def __call__(self, theta: FloatArray, at: Settings) -> FloatArray:
        """Return the readings of samples, (n_samples, n_params), at settings, (n_samples, n_settings)."""
        return np.array([self._remembered(sample[: self._made_of[1]].tobytes(), at) for sample in theta])

    def __reduce__(self) -> tuple[type[_OneByOne], tuple[Any, ...]]:
        return _OneByOne, self._made_of


def _called(function: Callable[..., Any], parameters: Any, settings: Any, shape: tuple[int, ...]) -> FloatArray:
    """Call a user's function; ShapeError unless its readings broadcast to `shape`, with as many axes."""
    with np.errstate(all="ignore"):
        out = floats(function(parameters, settings), "what the model returns")
    if out.ndim != len(shape) or any(have not in (1, want) for have, want in zip(out.shape, shape, strict=True)):
        raise ShapeError(f"model returns an array of shape {out.shape}; allowed: {shape}, one number for each setting")
    return np.array(np.broadcast_to(out, shape))  # a function may fill the same array at each call


def _repeatable(one: Callable[[bytes, Settings], FloatArray], theta: FloatArray, at: Settings) -> FloatArray:
    """Return the readings, (n_samples, n_settings), of calls for one sample; ParameterError if they are of no use."""
    alone = np.array([one(sample.tobytes(), at) for sample in theta])
    sound = np.isfinite(alone).any(axis=1)
    if not sound.any():
        found = f"not finite at any of the {sound.size} points of the prior that were tried"
        raise ParameterError("model", found, "finite readings: look for divisions by 0 and priors that are too wide")
    if not nearly_equal(one(theta[np.argmax(sound)].tobytes(), at), alone[np.argmax(sound)]):
        found = "different when it is called again with the same parameters"
        allowed = "the same readings each time: no random numbers, which `noise` stands for, no state between calls"
        raise ParameterError("model", found, allowed)
    return alone


@dataclass(frozen=True, eq=False)
class ReadingsProblem:
    """Readings with their settings, as a problem for nested sampling and, reading by reading, for `inquiry.smc`.

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

    def with_reading(self, last: ReadingsProblem) -> ReadingsProblem:
        """Return the readings with one more; a setting that was read before is not listed again."""
        same = np.all([c == last.settings.columns[n][0] for n, c in self.settings.columns.items()], axis=0)
        row = int(np.argmax(same)) if same.any() else len(same)
        settings = self.settings if same.any() else self.settings.joined(last.settings)
        rows, values = np.append(self.row, row), np.append(self.values, last.values)
        return ReadingsProblem(self.model, settings, rows, values)

    def log_likelihood(self, theta: FloatArray) -> FloatArray:
        """Return the log likelihood of all readings, (n_samples, n_params) -> (n_samples,)."""
        return np.asarray(self.evaluate(theta).sum(axis=1))

    def evaluate(self, theta: FloatArray) -> FloatArray:
        """Return the log density of every reading, (n_samples, n_params) -> (n_samples, n_readings)."""
        predicted = self.model.predict(theta, self.settings)
        scale = self.model.scale(theta, predicted)
        return self.model.noise.log_density(self.values, predicted[:, self.row], scale[:, self.row])

    def log_likelihoods(self, evaluated: FloatArray, power: float) -> tuple[FloatArray, FloatArray]:
        """Return log likelihoods without and with the last reading, (n_samples,) each, from `evaluate`."""
        return evaluated[:, :-1].sum(axis=1), evaluated.sum(axis=1)

    def least_misfit_nats(self, evaluated: FloatArray) -> float:
        """Return by how many nats the best density of the last reading misses its largest; 0 if the sd is unknown."""
        noise, last = self.model.noise, self.values[-1:]
        if noise.is_sd_inferred:  # wide enough, it explains any reading
            return 0.0
        return float(noise.log_density(last, last, noise.scale(last[None], None)[0])[0] - evaluated[:, -1].max())

    def p_value_and_worst_reading(self, theta: FloatArray) -> tuple[float, int]:
        """Return the chi-square p-value of one hypothesis (1, n_params), and the index of its worst-fitting reading.

        It has one degree of freedom per reading, regardless of fitted parameters, so that it is conservative.
        """
        predicted = self.model.predict(theta, self.settings)
        scale = self.model.scale(theta, predicted)
        tail = self.model.noise.smaller_tail(self.values, predicted[0, self.row], scale[0, self.row])
        z = np.abs(ndtri(np.clip(tail, 1e-300, 0.5)))
        return float(chdtrc(len(z), float(z @ z))), int(np.argmax(z))


class Inquiry(ShowsItself):
    """An inquiry: the posterior of a model's parameters, and the setting with the largest acquisition function.

    It can be pickled if its functions can: those that `def` defines in a module, no lambdas, none within a function.
    Of any other keep `readings`.

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
        Live points of nested sampling, which starts again if the samples cannot follow a reading, or have lost a part
        of the posterior.

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
        n_samples: int = 2000,
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
        self._n_samples = checked_whole("n_samples", n_samples, least=400, most=1_000_000)
        self._n_live = checked_whole("n_live", n_live)
        self._particles = prior_particles(self._model.prior, self._n_samples, rng=rng)
        self._prior_theta = self.posterior.theta
        self._prior_log_likelihood, self._lost_nats = np.zeros(self._n_samples), 0.0
        self._taken: list[tuple[Settings, float]] = []
        self._readings: ReadingsProblem | None = None
        self._utility: FloatArray | None = None
        self._next: int | None = None
        self._costs_s(None)

    @property
    def posterior(self) -> Weighted:
        """The posterior as `nested.Weighted` samples: `mean()`, `sd()`, `interval(0.95)`, `samples(n, rng=rng)`."""
        return self._particles.weighted

    @property
    def evidence(self) -> tuple[float, float]:
        """Natural log of the evidence of the readings, and its standard error."""
        return self.posterior.log_z, self._particles.log_z_error

    @property
    def readings(self) -> tuple[tuple[Any, float], ...]:
        """Pairs (setting, reading) so far; to resume, call `tell(reading, setting)` of a new inquiry for each."""
        return tuple((at[0], value) for at, value in self._taken)

    @property
    @own_arithmetic
    def utility(self) -> FloatArray:
        """Acquisition function of each setting, (n_settings,), per second if the costs in seconds are given.

        It is the expected information, bits, until every sd that the goal names is within three times its goal; then
        the expected decrease of the sum of ln(sd / goal), until the goal is reached; and from then on information
        again.
        """
        if self._utility is None:
            everywhere = np.arange(len(self._settings))
            self._utility = self._utility_of(self._hypotheses, everywhere) / self._costs_s(self._last_setting)
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

        Not before there are more readings than parameters: fewer fit any model, and none could be doubted. Raises
        ParameterError if the inquiry has no goal.
        """
        require(self._goal, "goal", None, 'posterior sds by parameter, such as {"centre_hz": 0.5}')
        return len(self._taken) > len(self._model.prior.names) and self._largest_sd_over_goal <= 1.0

    @property
    @own_arithmetic
    def doubt(self) -> str | None:
        """A warning if even the best posterior sample does not explain the readings (chi-square, p < 1e-6); or None.

        It names the reading that fits worst.
        """
        if self._readings is None:
            return None
        best = self.posterior.theta[[int(np.argmax(self.posterior.log_likelihood))]]
        p_value, worst = self._readings.p_value_and_worst_reading(best)
        if p_value >= _DOUBT_P:
            return None
        setting, value = self.readings[worst]
        return (
            f"no hypothesis explains the readings: the best has p = {p_value:.1g} and is worst at reading {worst + 1} "
            f"({value:g} at {setting}); the model leaves something out, the prior excludes the truth, or the noise is "
            "greater than stated"
        )

    @own_arithmetic
    def next(self) -> Any:
        """Return the setting with the largest acquisition function, in the form of `settings`; ties break at random.

        Of more than 64 settings, it is the best of the 32 that a rougher estimate ranks highest.
        """
        if self._next is None:
            self._next = self._best_row()
        return self._settings[self._next]

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
            way_out = "tell(reading, setting); next() has chosen none since the last reading"
            raise ParameterError("setting", None, f"the setting of this reading: {way_out}")
        chosen = self._settings.take(np.array([self._next or 0]))
        at = chosen if setting is None else self._settings.checked_setting(setting)
        last = ReadingsProblem(self._model, at, np.array([0]), np.array([value]))
        readings = last if self._readings is None else self._readings.with_reading(last)
        of_prior = self._prior_log_likelihood + last.evaluate(self._prior_theta)[:, 0]
        by_prior = float(np.logaddexp.reduce(of_prior)) - math.log(self._n_samples)
        search = partial(nested_sampling_from_scratch, readings, n_live=self._n_live, rng=self._rng)
        found = update(self._particles, readings, rng=self._rng, fall_back=search, effort=LIGHT)
        # Samples of the prior that explain the readings better than the posterior does lie in a part that it has lost.
        if found.weighted.run is None and by_prior - found.log_z > _LOST_NATS + self._lost_nats:
            found = particles_from_posterior(search(), self._n_samples, readings, rng=self._rng)
        if found.weighted.run is not None:
            self._lost_nats = max(by_prior - found.log_z, 0.0)
        self._particles, self._prior_log_likelihood = found, of_prior
        self._readings = readings
        self._taken = [*self._taken, (at, value)]  # a copy of this inquiry keeps those it has
        self._utility = self._next = None
        self.__dict__.pop("_hypotheses", None)

    @own_arithmetic
    def several(self, n: int) -> list[Any]:
        """Choose the settings of `n` readings to be taken before any of them is known; best first.

        Greedy: each setting has the largest utility given those before it in the list, averaged over simulated readings
        there. While the utility is information, this is greedy on the joint information (Nemhauser, Wolsey & Fisher
        1978). Costs count from the setting before it. Pass the results one by one to `tell(reading, setting)`.
        ParameterError if `n` is below 1.
        """
        checked_whole("n", n)
        rows = [self._choose(self.utility)]
        everywhere = np.arange(len(self._settings))
        theta, noise = self.posterior.theta, self._model.noise
        weights = [self.posterior.weight] * _N_IMAGINED
        while len(rows) < n:
            predicted = self._model.predict(theta, self._settings.take(np.array(rows[-1:])))
            scale = self._model.scale(theta, predicted)
            for k, weight in enumerate(weights):
                truth = [self._rng.choice(len(weight), p=weight / weight.sum())]
                imagined = noise.draw(predicted[truth], scale[truth], rng=self._rng)
                log_density = noise.log_density(imagined, predicted, scale)[:, 0]
                weights[k] = weight * np.exp(log_density - log_density[weight > 0].max())
            cost_s = self._costs_s(self._settings[rows[-1]])
            each = [self._utility_of(self._draw_hypotheses(weight), everywhere) for weight in weights]
            rows.append(self._choose(np.mean(each, axis=0) / cost_s))
        return [self._settings[row] for row in rows]

    @own_arithmetic
    def summary(self) -> str:
        """Describe the posterior in plain text."""
        posterior = self.posterior
        width = max(9, *(len(name) for name in posterior.names))
        low, high = posterior.interval(0.95)
        lines = [
            f"{len(self._taken)} readings, log Z {posterior.log_z:.2f} ± {posterior.log_z_error:.2f}, "
            f"effective sample size {posterior.n_eff:.0f} of {len(posterior.theta)}",
            f"{'parameter':<{width}}  {'mean':>11}  {'sd':>11}  95 % interval",
        ]
        for name, mean, sd, a, b in zip(posterior.names, posterior.mean(), posterior.sd(), low, high, strict=True):
            goal = f", asked for {self._goal[name]:.3g}" if name in self._goal else ""
            lines.append(f"{name:<{width}}  {mean:>11.5g}  {sd:>11.3g}  {a:.5g} to {b:.5g}{goal}")
        return "\n".join([*lines, *([] if self.doubt is None else [f"doubtful: {self.doubt}"])])

    @property
    def _largest_sd_over_goal(self) -> float:
        sd = dict(zip(self.posterior.names, self.posterior.sd(), strict=True))
        return float(max(sd[name] / goal for name, goal in self._goal.items()))

    @property
    def _is_near_goal(self) -> bool:
        """Whether the goal is not reached yet, but every sd is within three times its goal."""
        return bool(self._goal) and 1.0 < self._largest_sd_over_goal < _NEAR_GOAL

    @cached_property
    def _hypotheses(self) -> FloatArray:
        """Equally weighted posterior samples that value the settings until the next reading, (n, n_params)."""
        return self._draw_hypotheses(self.posterior.weight)

    def _draw_hypotheses(self, weight: FloatArray) -> FloatArray:
        """Draw equally weighted samples from those of the posterior with these weights, copies of one sample apart."""
        n = _N_PREDICTED if self._model.broadcasts else _FEWER_PREDICTED
        rows: IntArray = self._rng.permutation(resampled_rows(weight, n, self._rng))
        return np.asarray(self.posterior.theta[rows])

    def _best_row(self) -> int:
        """Choose the index of the best setting: of many, of those that a rougher estimate ranks highest."""
        theta, settings, cost_s = self._hypotheses, self._settings, self._costs_s(self._last_setting)
        if self._utility is not None or len(settings) <= _FEW_SETTINGS or not self._model.broadcasts:
            return self._choose(self.utility)
        if self._is_near_goal:  # where settings differ little, all hypotheses count
            predicted = self._model.predict(theta, settings)
            values, goal = self._values_and_goals(theta)
            above = gaussian_nats_above_goal(predicted, self._model.scale(theta, predicted), values, goal)
            rough = np.maximum(np.log(values.std(axis=0) / goal), 0.0).sum() - above
        else:
            rough = self._utility_of(theta[:_N_ROUGH], np.arange(len(settings)), n_levels=_N_ROUGH)
        rows = np.sort(np.argpartition(-rough / cost_s, _N_BEST)[:_N_BEST])
        fine = self._utility_of(theta, rows) / np.broadcast_to(cost_s, rough.shape)[rows]
        return int(rows[self._choose(fine)])

    def _values_and_goals(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the columns of theta that have a goal, (n, n_values), and their goals, (n_values,)."""
        return theta[:, [self.posterior.names.index(name) for name in self._goal]], np.array([*self._goal.values()])

    def _utility_of(self, theta: FloatArray, rows: IntArray, **levels: int) -> FloatArray:
        """Compute the acquisition function per reading at the settings `rows`, (n,), for equally weighted samples."""
        predicted = self._model.predict(theta, self._settings.take(rows))
        even = np.full(len(theta), 1.0 / len(theta))
        given = readings_given_noise(predicted, self._model.scale(theta, predicted), even, self._model.noise, **levels)
        if self._is_near_goal:
            values, goal = self._values_and_goals(theta)
            now = np.maximum(np.log(values.std(axis=0) / goal), 0.0).sum()
            fall = np.asarray(now - expected_nats_above_goal(given, values, goal))
            if fall.max() > 0.0:  # else most readings lead to the goal, but a few far away from it
                return fall
        return given.information_bits

    def _choose(self, utility: FloatArray) -> int:
        return int(self._rng.choice(np.flatnonzero(utility >= utility.max() - _TIE)))

    @property
    def _last_setting(self) -> Any:
        return self._taken[-1][0][0] if self._taken else None

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
    require(isinstance(goal, Mapping) and goal, "goal", goal, 'posterior sds by parameter, such as {"centre_hz": 0.5}')
    sds = {name: checked_finite_number(f"goal[{name!r}]", sd) for name, sd in goal.items()}
    for name, sd in sds.items():
        require(name in names, "goal", name, f"parameters among {', '.join(names)}{did_you_mean(name, names)}")
        require(sd > 0, f"goal[{name!r}]", sd, "greater than 0")
    return sds
