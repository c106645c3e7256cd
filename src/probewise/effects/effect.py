"""What the diagnosis needs of an effect besides its formula; bases of effects that are linear, change, or oscillate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Self, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import BoolArray, FloatArray, distinct_values
from probewise._kinds import require_mapping
from probewise._words import unit_after_number
from probewise.effects.noise_distribution import FittedReadings
from probewise.effects.priors import HeavyTailedPrior
from probewise.effects.reference import Extent
from probewise.errors import ParameterError
from probewise.priors import Prior, Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor.stages import NoiseParameters, Stage

_BOTH_SIGNS = 0.05  # least share of samples of either sign
_NEAR_ZERO, _FEW_NEAR_ZERO = 0.1, 0.01  # in medians of their sizes; of a normal distribution about 0, .054 are so near
_OWN = ("name", "stage", "units", "covariates", "prior", "apply", "bank", "sentence")
_MOST_CHANGE_POINTS, _FEW = 512, 48  # intervals of a change point; so many that are enough to detect one


V = TypeVar("V")


@dataclass(frozen=True, eq=False)
class VariantMasks:
    """Masks of variants that differ only in the readings they act on: one prediction serves all of them.

    `always` is a bank entry that acts on all readings, (n_columns, n_params); `opened`
    (n_variants, n_points) marks the readings that each variant acts on.
    """

    always: FloatArray
    opened: BoolArray


class NamedEffect(Generic[V]):
    """An effect as the diagnosis needs it: formula, prior, template bank, and a sentence for the verdict.

    A new effect is one class of this kind, passed as ``effects={**VOCABULARY, name: class}``. What its methods return
    is said here.
    """

    words: ClassVar[str] = ""
    """A noun phrase that follows "the model leaves out"; without one the name itself is written."""

    if TYPE_CHECKING:  # each effect has these, besides `name`, `stage`, `prior` and `apply` of `sensor.stages.Effect`

        @property
        def name(self) -> str: ...
        @property
        def stage(self) -> Stage: ...
        @property
        def prior(self) -> Prior: ...
        def apply(self, value: V, theta: FloatArray, plan: Plan) -> V: ...

        @property
        def units(self) -> tuple[str, ...]:
            """Unit of each parameter, in the order of `prior.names`."""

        @property
        def covariates(self) -> tuple[str, ...]:
            """Names of covariates against which the residuals show a trend where the effect is left out."""

        def bank(self) -> FloatArray:
            """Return the template bank, parameter vectors of shape (n_bank, n_columns, n_params).

            The columns of an entry span the change of the readings to first order; entries differ in
            the nonlinear parameters. Effects on the noise: equally weighted nodes of the prior.
            """

        def sentence(self, mean: FloatArray, sd: FloatArray) -> str:
            """Describe the effect in plain words; posterior mean and sd of the parameters, (n_params,) each."""

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the plan's columns that it reads besides place, time and scan; by default none."""
        return ()

    @property
    def counted_from(self) -> str:
        """From where it counts a time, a place or a column, in words; "" for 0, or if it does not count: the default.

        The recording that is diagnosed sets this origin, so that the effect means the same in any other plan.
        """
        return ""

    @property
    def amplitudes(self) -> tuple[int, ...]:
        """Indices of the amplitudes: the readings change in proportion to first order, and 0 means no effect.

        By default the first parameter alone.
        """
        return (0,)

    @property
    def nothing(self) -> Mapping[int, float] | None:
        """Values of parameters, by index, at which it has no effect; None if there are no such values.

        By default all amplitudes are 0.
        """
        return dict.fromkeys(self.amplitudes, 0.0) or None

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        """Build the effect with a prior at the recording's scales; None where the recording cannot show it.

        An effect of the battery needs its voltage, one of the direction of motion needs a scan that turns back.
        By default the scales do not depend on the recording: its parameters are pure numbers.
        """
        return cls()

    def is_absorbed_by_ssf(self, plan: Plan) -> bool:
        """Return whether a free SSF absorbs the effect under this plan, which hides it; by default False."""
        return False

    @property
    def n_peaks(self) -> int:
        """Number of equivalent posterior modes within the prior; a fit finds one of them."""
        return 1

    @property
    def scans(self) -> tuple[str, ...]:
        """Names of the scans it is restricted to; () for all."""
        return ()

    @property
    def patterns(self) -> tuple[str, ...]:
        """Names of the patterns it is restricted to; () for all."""
        return ()

    def variants(self) -> tuple[Self, ...]:
        """List the effect with each of its discrete choices made, of prior odds `relative_odds`.

        A choice is a scan, a mounting or an interval between readings, which no gradient-based fit can find.
        Variants differ in their `scans` or `patterns`, or only in their priors.
        """
        return (self,)

    @property
    def has_change_point(self) -> bool:
        """Whether its variants are the intervals of a change point; by default not."""
        return False

    @property
    def relative_odds(self) -> float:
        """Prior odds of this variant against the first one; by default all are equally probable."""
        return 1.0

    def variant_masks(self, plan: Plan) -> VariantMasks | None:
        """Return the masks of variants that differ only in the readings they act on; None, the default, for others."""
        return None

    def with_fewer_variants(self) -> Self:
        """Return the effect with fewer variants, as many as detection needs; by default with all of them."""
        return self

    def redraw_by_variant(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Redraw the parameter that the variants divide among them: draw a variant for each sample, then its value.

        Returns theta, (n_samples, n_params) as given, with that parameter replaced; by default unchanged. `weights`
        (n_variants,) are the probabilities of the variants.
        """
        return theta

    def start(self, entry: FloatArray, amounts: FloatArray) -> FloatArray:
        """Turn a bank entry (n_columns, n_params) and its columns' fitted amounts into a starting point (n_params,).

        Amplitudes scale with the amounts; other parameters (a level, an exponent) keep the entry's values.
        """
        setting = entry[0].copy()
        for k in self.amplitudes:
            setting[k] = amounts @ entry[:, k]
        return np.asarray(setting)


def require_effect_classes(effects: object) -> None:
    """Raise ParameterError unless `effects` maps each name to a class of that name with all required members."""
    allowed = "classes of effects by name, such as {**VOCABULARY, 'overflow': Overflow}, of probewise.effects"
    require_mapping("effects", effects, allowed)
    assert isinstance(effects, Mapping)
    for name, kind in effects.items():
        if not isinstance(kind, type) or not hasattr(kind, "for_extent"):
            raise ParameterError(f"effects[{name!r}]", kind, "a class that follows probewise.effects.NamedEffect")
        lacking = [each for each in _OWN if getattr(kind, each, None) in (None, getattr(NamedEffect, each, None))]
        if lacking:
            raise ParameterError(
                f"effects[{name!r}]", kind, f"a class of an effect with {', '.join(_OWN)}; {lacking[0]} is missing"
            )
        own = cast(type[NamedEffect[Any]], kind).name
        if own != name:
            raise ParameterError("effects", name, f"{own!r}, the name of the class {kind.__name__}")


class NoiseEffect(NamedEffect[NoiseParameters]):
    """An effect on the noise; it changes the mean of the readings only where `changes_the_mean` is True."""

    n_nodes: ClassVar[int] = 10
    """Number of nodes of its prior, for an effect of one parameter."""

    changes_the_mean: ClassVar[bool] = False
    """Whether it is physics of the mean, seen in the readings alone."""

    @property
    def parameters_known_before_fit(self) -> FloatArray | None:
        """Parameters, (n_params,), that the readings alone determine; None, by default, where they need a fit."""
        return None

    def change_of_readings(self, predicted: FloatArray) -> FloatArray:
        """Return the change of readings that were predicted without it, same shape; 0 unless it `changes_the_mean`."""
        return np.zeros_like(predicted)

    @property
    def nodes_per_parameter(self) -> tuple[int, ...]:
        """Numbers of nodes along each parameter, whose product is the bank; () if the nodes depend on the fit.

        Where a fit determines a parameter better than its nodes lie apart, they are refined.
        """
        return (self.n_nodes,)

    def bank(self) -> FloatArray:
        """Return equally weighted nodes of the prior, (n_nodes, 1, n_params): midpoints along each parameter."""
        axes = [(np.arange(n) + 0.5) / n for n in self.nodes_per_parameter or (self.n_nodes,)]
        u = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, len(axes))
        return self.prior.from_unit_cube(u)[:, None, :]

    def nodes(self, residuals: FloatArray, rows: FittedReadings) -> FloatArray:
        """Return equally weighted nodes of the prior given a fit, (n_nodes, n_params); none where the fit excludes it.

        `residuals` (n_points,) are in units of the noise sd.
        """
        return self.bank()[:, 0, :]

    def weighed_nodes(self, residuals: FloatArray, rows: FittedReadings) -> tuple[FloatArray, FloatArray]:
        """Return nodes given a fit, (n_nodes, n_params), and log weights, (n_nodes,): by default those of the prior."""
        nodes = self.nodes(residuals, rows)
        return nodes, np.full(len(nodes), -np.log(max(len(nodes), 1)))

    def draws_about(self, nodes: FloatArray, *, rng: np.random.Generator) -> FloatArray | None:
        """Draw parameters about sampled nodes, both (n_samples, n_params); None, the default, if nodes are dense."""
        return None


def sentence_from_samples(effect: NamedEffect[Any], samples: FloatArray) -> str:
    """Describe an effect by samples of its parameters, (n_samples, n_params), and its origin, if that is not 0.

    Of an amplitude that is not 0, but of either sign, it says so and between what values it lies.
    """
    sentence = effect.sentence(*mean_and_sd_of_samples(samples))
    for k in effect.amplitudes:
        if _is_of_either_sign(samples[:, k]):
            low, high = np.quantile(samples[:, k], [0.025, 0.975])
            between = f"between {low:.2g} and {high:.2g} {unit_after_number(effect.units[k])}".rstrip()
            name = "size" if effect.prior.names[k] == "a" else f"size {effect.prior.names[k]}"
            sentence += f"; its {name} may have either sign, {between} (95 %)"
    return f"{sentence} ({effect.counted_from})" if effect.counted_from else sentence


def _is_of_either_sign(values: FloatArray) -> bool:
    """Return whether samples, (n_samples,), are on both sides of 0, but hardly any near it."""
    positive = np.mean(values > 0)
    near = np.mean(np.abs(values) < _NEAR_ZERO * np.median(np.abs(values)))
    return bool(_BOTH_SIGNS < positive < 1 - _BOTH_SIGNS and near < _FEW_NEAR_ZERO)


def mean_and_sd_of_samples(samples: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and sd of samples (n_samples, n_params), (n_params,) each: exact for a value that all samples have.

    The mean of equal numbers may differ from them in the last digit, and their sd from 0.
    """
    equal = np.all(samples == samples[0], axis=0)
    return np.where(equal, samples[0], samples.mean(axis=0)), np.where(equal, 0.0, samples.std(axis=0))


def single_column_bank(*parameters: ArrayLike) -> FloatArray:
    """Return bank entries of one column from the parameters' values, numbers or (n_bank,): (n_bank, 1, n_params)."""
    return np.stack(np.broadcast_arrays(*parameters), axis=-1)[:, None, :].astype(np.float64)


class LinearEffect(NamedEffect[V]):
    """Base of effects whose readings change in proportion to each parameter, to first order.

    A subclass is a frozen dataclass with one field that begins with `typical`: the typical size of every parameter.
    """

    parameters: ClassVar[tuple[str, ...]]
    """Names of the parameters."""
    positive = False
    """Whether the parameters are never negative."""

    @cached_property
    def _typical_size(self) -> float:
        (name,) = (each.name for each in fields(self) if each.name.startswith("typical"))  # type: ignore[arg-type]
        return float(getattr(self, name))

    @property
    def amplitudes(self) -> tuple[int, ...]:
        return tuple(range(len(self.parameters)))

    @cached_property
    def prior(self) -> Product:
        size = HeavyTailedPrior(self._typical_size, positive=self.positive)
        return Product(dict.fromkeys(self.parameters, size))

    def bank(self) -> FloatArray:
        return self._typical_size * np.eye(len(self.parameters))[None, :, :]


@dataclass(frozen=True)
class ScanGroupEffect(LinearEffect[V]):
    """Base of linear effects on one scan, or on all scans of one mounting (orientation).

    `scans` are the affected scans, chosen among the groups of scans in `choices`.
    """

    scans: tuple[str, ...] = ()
    choices: tuple[tuple[str, ...], ...] = ()

    def variants(self) -> tuple[Self, ...]:
        return tuple(replace(self, scans=choice) for choice in self.choices)


def scans_in_words(scans: tuple[str, ...]) -> str:
    """Return the names of scans as a phrase: "scan a", or "scans a, b"."""
    return f"scan{'s' if len(scans) > 1 else ''} {', '.join(scans)}"


def thinned(values: FloatArray, most: int) -> tuple[float, ...]:
    """Return rising values, (n_values,), thinned to at most `most` intervals, with the first and the last."""
    stride = -(-(len(values) - 1) // most)
    return tuple(np.append(values[:-1:stride], values[-1]).tolist())


@dataclass(frozen=True)
class ChangePoints:
    """Candidate positions of a change point, rising: times, row numbers (`by_row`) or values of a column.

    Between which two of them it lies is a discrete choice; its position in that interval does not affect any reading.
    """

    at: tuple[float, ...]
    by_row: bool = False
    column: str = ""

    @classmethod
    def of(cls, values: FloatArray, by_row: bool = False) -> Self:
        """Return the distinct values, thinned to at most 512 intervals."""
        return cls(thinned(distinct_values(values), _MOST_CHANGE_POINTS), by_row)

    def fewer(self) -> Self:
        """Return at most 48 intervals, enough to detect that something changed in one of them."""
        return replace(self, at=thinned(np.array(self.at), _FEW))

    def variable_at_rows(self, plan: Any) -> FloatArray:
        """Return the column, row number or time that is compared with the change point, (n_points,)."""
        if self.column:
            return np.asarray(plan.covariates[self.column])
        return np.asarray(plan.row_number if self.by_row else plan.time_s)

    def masks(self, entry: FloatArray, plan: Any) -> VariantMasks:
        """Return the masks of the rows after the middle of each interval, and a bank entry that acts on all rows."""
        always, along = entry.copy(), self.variable_at_rows(plan)
        always[:, -1] = -np.inf
        return VariantMasks(always, np.array([along > 0.5 * (low + high) for low, high in pairwise(self.at)]))

    def redrawn(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Redraw theta's last column: for each sample an interval by `weights`, (n_intervals,), uniform within it."""
        at = np.array(self.at)
        chosen = rng.choice(len(weights), len(theta), p=weights)
        drawn = at[chosen] + np.diff(at)[chosen] * rng.random(len(theta))
        return np.concatenate([theta[:, :-1], drawn[:, None]], axis=1)


@dataclass(frozen=True)
class ChangePointEffect(NamedEffect[V]):
    """Base of effects that act on the readings taken after `at_s`, the last parameter.

    `times_s` are the times of the readings. Between which two of them the change point lies is a discrete choice
    (`between_s`); its position within that interval does not affect any reading.
    """

    times_s: tuple[float, ...] = (0.0, 1e5)
    between_s: tuple[float, float] | None = None

    @property
    def typical_sizes(self) -> Mapping[str, float]:
        """Typical size of each amplitude, by name."""
        raise NotImplementedError

    @property
    def amplitudes(self) -> tuple[int, ...]:
        return tuple(range(len(self.typical_sizes)))

    @cached_property
    def prior(self) -> Product:
        sizes = {name: HeavyTailedPrior(size) for name, size in self.typical_sizes.items()}
        return Product({**sizes, "at_s": Uniform(*self.change_interval_s)})

    def bank(self) -> FloatArray:
        sizes = np.diag(list(self.typical_sizes.values()))
        return np.column_stack([sizes, np.full(len(sizes), sum(self.change_interval_s) / 2)])[None, :, :]

    @property
    def change_interval_s(self) -> tuple[float, float]:
        """Bounds of the interval in which the change point may lie, s: `between_s`, else the whole recording."""
        return self.between_s or (self.times_s[0], self.times_s[-1])

    @staticmethod
    def after_change_mask(theta: FloatArray, plan: Plan) -> BoolArray:
        """Return the mask of the readings taken after each sample's change point, (n_samples, n_points)."""
        return np.asarray(plan.time_s > theta[:, -1:])

    @property
    def has_change_point(self) -> bool:
        return True

    def variants(self) -> tuple[Self, ...]:
        return tuple(replace(self, between_s=pair) for pair in pairwise(self.times_s))

    def with_fewer_variants(self) -> Self:
        return replace(self, times_s=ChangePoints(self.times_s).fewer().at)

    def variant_masks(self, plan: Plan) -> VariantMasks:
        return ChangePoints(self.times_s).masks(self.bank()[0], plan)

    def redraw_by_variant(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        return ChangePoints(self.times_s).redrawn(theta, weights, rng=rng)


def candidate_change_times_s(extent: Extent) -> tuple[float, ...] | None:
    """Return the distinct times of a recording's readings, thinned to at most 512 intervals; None for one time."""
    times = distinct_values(extent.plan.time_s)
    return None if len(times) < 2 else thinned(times, _MOST_CHANGE_POINTS)


PHASE = Uniform(-2 * np.pi, 2 * np.pi)
"""Prior of a phase, two full turns: every phase has an equivalent far from both ends."""


def sine_and_cosine_entries(*parameters: ArrayLike) -> FloatArray:
    """Return bank entries of waves, a sine and a cosine each, (n_bank, 2, n_params).

    `parameters` are those before the phase, which is the last: numbers or (n_bank,); the first is the amplitude.
    """
    return np.concatenate([single_column_bank(*parameters, phase) for phase in (0.0, 0.5 * np.pi)], axis=1)


def starting_point_of_wave(entry: FloatArray, amounts: FloatArray) -> FloatArray:
    """Return the parameters, (n_params,), of the sum of a bank entry's sine and cosine, times the fitted amounts (2,).

    The amplitude is the first, the phase the last; those between are the entry's.
    """
    setting = entry[0].copy()
    sine, cosine = amounts * setting[0]
    setting[0], setting[-1] = np.hypot(sine, cosine), np.arctan2(cosine, sine)
    return np.asarray(setting)


class PeriodicEffect(NamedEffect[V]):
    """Base of effects whose phase has a prior over two turns, which hold every posterior mode twice."""

    @property
    def n_peaks(self) -> int:
        return 2


class WaveEffect(PeriodicEffect[V]):
    """Base of effects with amplitude, frequency or period, and phase; bank entries hold a sine and a cosine."""

    def start(self, entry: FloatArray, amounts: FloatArray) -> FloatArray:
        return starting_point_of_wave(entry, amounts)
