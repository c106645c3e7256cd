"""An effect: physics that a model may leave out, one function at one stage, with its priors, bank and words."""

from __future__ import annotations

import math
import pkgutil
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from itertools import combinations, pairwise
from typing import Any, ClassVar, Literal, Self, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from probewise._arrays import BoolArray, FloatArray, distinct_values
from probewise._kinds import require_kind, require_mapping
from probewise._words import unit_after_number, value_with_sd
from probewise.effects.noise_distribution import FittedReadings
from probewise.effects.reference import ZERO, Extent, Origin
from probewise.errors import require
from probewise.priors import HeavyTailedPrior, LogUniform, Marginal, Prior, Product, Uniform
from probewise.recordings.plan import Plan
from probewise.sensor import stages
from probewise.sensor.stages import Stage

_BOTH_SIGNS = 0.05  # least share of samples of either sign
_NEAR_ZERO, _FEW_NEAR_ZERO = 0.1, 0.01  # in medians of their sizes; of a normal distribution about 0, .054 are so near
_MOST_CHANGE_POINTS, _FEW = 512, 48  # intervals of a change point; so many that are enough to detect one

AGAIN = "~again"
"""Suffix of an effect's second copy: the same physics twice, as two waves."""

PHASE = Uniform(-2 * np.pi, 2 * np.pi)
"""Prior of a phase, two full turns: every phase has an equivalent far from both ends."""

ROWS_OF_A_SIDE = 5  # least number of rows on which an effect rests, on either side where it is switched

LEAST_VISIBLE = 4.0
"""Least size (lambda) of a detectable effect: there the test at level .01 has a power above one half."""

MOST_FREQUENCIES = 1024  # largest number of trial frequencies of a wave

Act: TypeAlias = Callable[[Any, FloatArray, Any], Any]
"""Function of the stage's value, parameters (n_samples, n_params) and the plan or table; returns the value with the
effect."""

Declared: TypeAlias = Mapping[str, tuple[Marginal, str]]
"""Prior and unit of each parameter, by name."""

AMPLITUDE, POSITIVE = HeavyTailedPrior(1.0), HeavyTailedPrior(1.0, positive=True)
"""Priors of amplitudes, of either sign or positive, until `Effect.of_typical_size` gives them their size."""


def acting(formula: Callable[..., Any]) -> Act:
    """Return the act of a formula: a function of the value, the plan or table, and each parameter, (n_samples, 1)."""
    return lambda value, theta, plan: formula(value, plan, *(theta[:, k : k + 1] for k in range(theta.shape[1])))


Say: TypeAlias = Callable[[FloatArray, FloatArray], str]
"""Function of the parameters' mean and sd, (n_params,) each; returns a sentence."""


VariantMasks: TypeAlias = tuple[FloatArray, BoolArray]
"""Of variants that differ only in the readings they act on, which one prediction serves: a bank entry that acts on all
readings, (n_columns, n_params), and masks of the readings that each variant acts on, (n_variants, n_points)."""


@dataclass(frozen=True)
class Fixed(Uniform):
    """Prior of a parameter that a variant fixes, to within rounding; `odds` are the variant's against the first."""

    odds: float = 1.0


@dataclass(frozen=True)
class Where:
    """Origin from which a light sensor's effect counts; names of the scans or patterns it is restricted to, () all."""

    origin: Origin = ZERO
    scans: tuple[str, ...] = ()
    patterns: tuple[str, ...] = ()


@dataclass(frozen=True)
class Binding:
    """How an effect is bound to a recording.

    `counted_from`: from where it counts a time, a place or a column, in words; "" for 0, or if it does not count.
    `source`: a function that builds an effect with the same `apply` and `sentence`, by which a pickled effect finds
    them again. Of a light sensor's effect: `where` it acts, and which of several formulas it has (`form`).
    """

    counted_from: str = ""
    where: Where = Where()
    form: str = ""
    source: Callable[[], Effect] | None = None


@dataclass(frozen=True, eq=False)
class Effect:
    """An effect, bound to a recording and perhaps to a target.

    Parameters
    ----------
    name, stage
        `name` or `name:target`; stage of the chain at which it acts.
    parameters, units
        Prior of each parameter, by name, or of all together; and unit of each.
    covariates
        Names of the covariates along which the residual shows if the effect is left out.
    apply, sentence
        What it does to its stage's value, and a sentence that describes it; see `Act` and `Say`.
    entries
        Template bank: trial settings, (n_entries, n_columns, n_params). The columns of an entry span the change of the
        readings to first order; entries differ in the nonlinear parameters.
    amplitudes
        Indices of the parameters that are amplitudes: the readings change in proportion to first order.
    absent
        Parameter values, by index, at which it has no effect, if these are not zero amplitudes.
    alternatives
        Mutually exclusive variants of it, with other priors and entries; it itself is another variant.
    expression
        Formula of a proposal, which has no name in the vocabulary; otherwise empty.
    needs_rising_time
        Whether it looks back to earlier times of a run, which time must then not fall within.
    binding
        From where it counts, and of a light sensor's effect where it acts and how it is built.
    """

    name: str
    stage: Stage
    parameters: Mapping[str, Marginal] | Prior
    units: tuple[str, ...]
    covariates: tuple[str, ...]
    apply: Act
    entries: FloatArray
    sentence: Say
    amplitudes: tuple[int, ...] = (0,)
    absent: Mapping[int, float] = field(default_factory=dict)
    alternatives: tuple[Effect, ...] = ()
    expression: str = ""
    needs_rising_time: bool = False
    binding: Binding = Binding()

    has_change_point: ClassVar[bool] = False
    """Whether its variants are the intervals of a change point."""

    @classmethod
    def declared(
        cls,
        name: str,
        stage: Stage,
        parameters: Declared,
        covariates: tuple[str, ...],
        act: Act,
        says: Say,
        entries: FloatArray | None = None,
        **more: Any,
    ) -> Self:
        """Return the effect of these parameters, priors and units; amplitudes are those declared as such, of size 1.

        Without `entries` each parameter is an amplitude, and a column of the one entry.
        """
        priors, units = {own: prior for own, (prior, _) in parameters.items()}, tuple(u for _, u in parameters.values())
        amplitudes = tuple(k for k, prior in enumerate(priors.values()) if prior is AMPLITUDE or prior is POSITIVE)
        bank = np.eye(len(priors))[None] if entries is None else entries
        return cls(name, stage, priors, units, covariates, act, bank, says, **{"amplitudes": amplitudes, **more})

    def of_typical_size(self, typical: ArrayLike, *, misfit: float = 1.0) -> Self:
        """Return the effect with amplitudes of this typical size, one for all or each; a misfit widens their tails."""
        entries, priors = self.entries.copy(), dict(self.marginals)
        entries[..., list(self.amplitudes)] *= np.asarray(typical, dtype=np.float64)
        for k, size in zip(self.amplitudes, np.broadcast_to(typical, len(self.amplitudes)).tolist(), strict=True):
            plain = cast(HeavyTailedPrior, priors[name := self.prior.names[k]])
            priors[name] = replace(plain, typical=size, largest=plain.largest * max(misfit, 1.0))
        return replace(self, parameters=priors, entries=entries)

    def __reduce__(self) -> tuple[Callable[..., Effect], tuple[Any, ...]]:
        state = {each.name: getattr(self, each.name) for each in fields(self)}
        if self.binding.source is not None:
            del state["apply"], state["sentence"]
        return _restored_effect, (type(self), state)

    @cached_property
    def prior(self) -> Prior:
        """Prior of its parameters."""
        return Product(self.parameters) if isinstance(self.parameters, Mapping) else self.parameters

    @property
    def nothing(self) -> Mapping[int, float] | None:
        """Values of parameters, by index, at which it has no effect; None without amplitudes."""
        return dict(self.absent) or dict.fromkeys(self.amplitudes, 0.0) or None

    @property
    def scans(self) -> tuple[str, ...]:
        """Names of the scans that it is restricted to; () for all."""
        return self.binding.where.scans

    @property
    def patterns(self) -> tuple[str, ...]:
        """Names of the patterns that it is restricted to; () for all."""
        return self.binding.where.patterns

    @property
    def fixed(self) -> tuple[str, ...]:
        """Names of the parameters that this one of several variants fixes; reports leave them out."""
        return tuple(name for name, prior in self.marginals.items() if isinstance(prior, Fixed))

    @property
    def relative_odds(self) -> float:
        """Prior odds of this variant against the first one."""
        return math.prod((prior.odds for prior in self.marginals.values() if isinstance(prior, Fixed)), start=1.0)

    @property
    def marginals(self) -> Mapping[str, Marginal]:
        """Prior of each parameter, by name; none where all have one together."""
        return self.parameters if isinstance(self.parameters, Mapping) else {}

    @property
    def n_peaks(self) -> int:
        """Number of equivalent posterior modes within the prior; a fit finds one of them."""
        # A phase spans two turns, which doubles it; a second copy or time constant may be exchanged with the first.
        exchangeable = self.name.endswith(AGAIN) or "tau2" in self.prior.names
        return (2 if exchangeable else 1) * (2 if "phase" in self.prior.names else 1)

    def variants(self) -> tuple[Effect, ...]:
        """List the effect with each of its discrete choices made, of prior odds `relative_odds`; the same at each call.

        A choice is a scan, a mounting or an interval between readings, which no gradient-based fit can find. Variants
        differ in their `scans` or `patterns`, or only in their priors.
        """
        return self._variants

    @cached_property
    def _variants(self) -> tuple[Effect, ...]:
        return (replace(self, alternatives=()), *self.alternatives) if self.alternatives else (self,)

    def variant_masks(self, plan: Any) -> VariantMasks | None:
        """Return the masks of variants that differ only in the readings they act on; None, the default, for others."""
        return None

    def with_fewer_variants(self) -> Self:
        """Return the effect with fewer variants, as many as detection needs; by default with all of them."""
        return self

    def redraw_by_variant(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        """Redraw the parameter that variants of these `weights`, (n_variants,), divide among them; by default none."""
        return theta

    def start(self, entry: FloatArray, amounts: FloatArray) -> FloatArray:
        """Turn a bank entry (n_columns, n_params) and its columns' fitted amounts into a starting point (n_params,).

        Amplitudes scale with the amounts; other parameters (a level, an exponent) keep the entry's values.
        """
        setting = entry[0].copy()
        for k in self.amplitudes:
            setting[k] = amounts @ entry[:, k]
        return np.asarray(setting)


def _restored_effect(kind: type[Effect], state: dict[str, Any]) -> Effect:
    source = state["binding"].source
    made = None if source is None else source()
    return kind(**state) if made is None else kind(**state, apply=made.apply, sentence=made.sentence)


TWICE = 0.1
"""Odds of a second wave, given one, and of a step that goes back: machines and climates that have a cycle often have
another one."""

_BLOCK_ENDS, _FEW_BLOCK_ENDS = 64, 12  # intervals of an end: all, and as many as detection needs


@dataclass(frozen=True, eq=False, kw_only=True)
class StepEffect(Effect):
    """An effect with a change point, its last parameter: a variant for each interval in which that may lie.

    With `is_thinned` False, all intervals are needed to detect it: its moment is what identifies it. If it may go back,
    its end is the parameter before, of prior `never` where it stays. In `most_ends` intervals a block of rows may begin
    or end; all blocks have a tenth of the odds of all steps.
    """

    change_points: ChangePoints
    is_thinned: bool = True
    never: Fixed | None = None
    most_ends: int = _BLOCK_ENDS
    has_change_point: ClassVar[bool] = True

    @cached_property
    def places(self) -> Sequence[tuple[Uniform, ...]]:
        """The priors of the last parameters, those that are a place, in each variant."""
        begins = self.change_points.intervals
        if self.never is None:
            return [(Uniform(*begin),) for begin in begins]
        thinner = replace(self.change_points, at=thinned(np.array(self.change_points.at), self.most_ends))
        blocks = list(combinations(thinner.intervals, 2))
        never = replace(self.never, odds=max(len(blocks), 1) / (TWICE * len(begins)))
        steps = [(never, Uniform(*begin)) for begin in begins]
        return [*steps, *((Uniform(*end), Uniform(*begin)) for begin, end in blocks)]

    @cached_property
    def _variants(self) -> tuple[Effect, ...]:
        out = []
        for last in self.places:
            entries, n = self.entries.copy(), len(last)
            entries[:, :, -n:] = [0.5 * (prior.low + prior.high) for prior in last]
            priors = {**self.marginals, **dict(zip(list(self.marginals)[-n:], last, strict=True))}
            out.append(replace(self, parameters=priors, entries=entries))
        return tuple(out)

    def with_fewer_variants(self) -> Self:
        fewer = self.change_points.fewer()
        return replace(self, change_points=fewer, most_ends=_FEW_BLOCK_ENDS) if self.is_thinned else self

    def variant_masks(self, plan: Any) -> VariantMasks | None:
        """Return the masks of the rows from each candidate change point on, or to its end; None where a law goes on.

        What is added to readings or poses, or to the gain, is nothing before it and the same everywhere after it.
        """
        if self.stage not in _ROW_BY_ROW:
            return None
        middles = np.array([[0.5 * (prior.low + prior.high) for prior in last] for last in self.places])
        always, along = self.entries[0].copy(), self.change_points.variable_at_rows(plan)
        always[:, -middles.shape[1] :] = -np.inf
        end, begin = middles[:, :1], middles[:, -1:]
        return always, (along > begin) & ((along < end) | (end <= begin))

    def redraw_by_variant(self, theta: FloatArray, weights: FloatArray, *, rng: np.random.Generator) -> FloatArray:
        low, high = np.array([[(prior.low, prior.high) for prior in last] for last in self.places]).transpose(2, 0, 1)
        chosen = rng.choice(len(weights), len(theta), p=weights)
        drawn = low[chosen] + (high - low)[chosen] * rng.random((len(theta), low.shape[1]))
        return np.concatenate([theta[:, : -low.shape[1]], drawn], axis=1)


_ROW_BY_ROW = (Stage.OFFSET, Stage.GAIN, Stage.POSE)


@dataclass(frozen=True, eq=False, kw_only=True)
class WaveEffect(Effect):
    """A wave: its entries are a sine and a cosine each, its amplitude is the first parameter, its phase the last.

    The last `n_suggested` are of frequencies that the readings suggest: refits may start there. A test of the readings
    leaves them out, for other readings would have suggested others.
    """

    n_suggested: int = 0

    def start(self, entry: FloatArray, amounts: FloatArray) -> FloatArray:
        """Return the wave that is the sum of an entry's sine and cosine, in their fitted amounts, (n_params,)."""
        setting = entry[0].copy()
        sine, cosine = amounts * setting[0]
        setting[0], setting[-1] = np.hypot(sine, cosine), np.arctan2(cosine, sine)
        return np.asarray(setting)

    def with_fewer_variants(self) -> Self:
        return self._without_suggested if self.n_suggested else self

    @cached_property
    def _without_suggested(self) -> Self:  # one object at each call, as `variants` returns
        return replace(self, entries=self.entries[: -self.n_suggested], n_suggested=0)


@dataclass(frozen=True, eq=False)
class LightEffect:
    """A light sensor's effect before it is bound to a recording; declared by `light_effect`.

    `words` follow "the model leaves out"; `build` is a function of this and the extent of a recording, and returns the
    effect at the recording's scales, None where the recording cannot show it. `counts` tells whether its formula holds
    the "time" or the "place" itself, which count from the recording's origin; `reads` are the plan's columns that it
    reads besides place, time and scan; `is_absorbed_by_ssf` tells of a plan whether a free SSF hides the effect.
    """

    name: str
    stage: Stage
    words: str
    covariates: tuple[str, ...]
    build: Callable[[LightEffect, Extent], Effect | None]
    counts: Literal["", "time", "place"] = ""
    reads: tuple[str, ...] = ()
    is_absorbed_by_ssf: Callable[[Plan], bool] = lambda plan: False

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return pkgutil.resolve_name, (f"{self.build.__module__}:{self.build.__name__}",)

    def for_extent(self, extent: Extent) -> Effect | None:
        """Bind the effect to a recording, with a prior at its scales; None where the recording cannot show it."""
        return self.build(self, extent)

    def __call__(self, origin: Origin = ZERO) -> Effect:
        """Return the effect of a stored model, of which the function alone counts, whatever the prior's scales."""
        found = self.for_extent(Extent.usual(origin))
        assert found is not None
        return found

    def bind(
        self,
        of: Extent,
        parameters: Declared,
        act: Act,
        says: Say,
        entries: FloatArray | None = None,
        *,
        typical: ArrayLike | None = None,
        kind: type[Effect] = Effect,
        scans: tuple[str, ...] = (),
        patterns: tuple[str, ...] = (),
        source: Callable[[], Effect] | None = None,
        **more: Any,
    ) -> Effect:
        """Return `Effect.declared` of amplitudes of a typical size, counting from the origin if it counts."""
        counted_from, at = "", of.origin if self.counts else ZERO
        if self.counts == "time" and at.time_s:
            counted_from = f"time counts from {at.time_s:.12g} s"
        elif self.counts == "place" and (at.x_mm or at.y_mm):
            counted_from = f"X and Y count from ({at.x_mm:g}, {at.y_mm:g}) mm"
        source = source or partial(_effect_there, self, of, scans)
        more["binding"] = Binding(counted_from, Where(at, scans, patterns), source=source)
        effect = kind.declared(self.name, self.stage, parameters, self.covariates, act, says, entries, **more)
        return effect if typical is None else effect.of_typical_size(typical)

    def step(
        self, of: Extent, sizes: Mapping[str, tuple[float, str]], act: Act, says: Say, *, is_thinned: bool = True
    ) -> Effect | None:
        """Return the effect that begins between two readings; `sizes` are typical size and unit of each amplitude.

        `act` gets the mask of the readings after each sample's change point, (n_samples, n_points), for the plan. None
        for a recording of one time.
        """
        if len(distinct_values(of.plan.time_s)) < 2:
            return None
        points, n = ChangePoints.of(of.plan.time_s), len(sizes)
        low, high = points.at[0], points.at[-1]
        amplitudes: Declared = {name: (AMPLITUDE, unit) for name, (_, unit) in sizes.items()}
        return self.bind(
            of,
            {**amplitudes, "at_s": (Uniform(low, high), "s")},
            lambda value, theta, plan: act(value, theta, plan.time_s > theta[:, -1:]),
            says,
            np.column_stack([np.eye(n), np.full(n, (low + high) / 2)])[None],
            typical=[size for size, _ in sizes.values()],
            kind=StepEffect,
            change_points=points,
            is_thinned=is_thinned,
        )


def _effect_there(kind: LightEffect, of: Extent, scans: tuple[str, ...]) -> Effect:
    """Return that of an effect's variants which is restricted to the same scans."""
    found = kind.for_extent(of)
    assert found is not None
    return next(variant for variant in found.variants() if variant.scans == scans)


def light_effect(
    name: str, stage: Stage, words: str, covariates: tuple[str, ...], **more: Any
) -> Callable[[Callable[[LightEffect, Extent], Effect | None]], LightEffect]:
    """Declare a light sensor's effect: decorate the function that builds it; see `LightEffect`."""
    return lambda build: LightEffect(name, stage, words, covariates, build, **more)


def one_of(choices: Sequence[Effect]) -> Effect | None:
    """Return the first of an effect's mutually exclusive choices, with the others as alternatives; None for none."""
    return replace(choices[0], alternatives=tuple(choices[1:])) if choices else None


def require_effect_kinds(effects: object) -> None:
    """Raise ParameterError unless `effects` maps each name to an effect of that name, as `light_effect` makes them."""
    allowed = "effects by name, such as {**VOCABULARY, 'overflow': overflow}, of probewise.effects"
    require_mapping("effects", effects, allowed)
    assert isinstance(effects, Mapping)
    decorated = "a function decorated with probewise.effects.light_effect"
    for name, kind in effects.items():
        require_kind(f"effects[{name!r}]", kind, LightEffect, decorated)
        require(kind.name == name, "effects", name, f"{kind.name!r}, the name of that effect")


@dataclass(frozen=True, eq=False, kw_only=True)
class NoiseEffect(Effect):
    """An effect on the noise; its entries are equally weighted nodes of its prior, (n_nodes, 1, n_params).

    Parameters
    ----------
    nodes_per_parameter
        Numbers of nodes along each parameter, whose product they are; () if the nodes are not of the prior. Where a fit
        determines a parameter better than its nodes lie apart, they are refined.
    nodes_about
        Function of a fit's residuals, (n_points,), in noise sds, and its readings, that returns nodes, (n_nodes,
        n_params), none where the fit excludes the effect, and their log weights, (n_nodes,).
    draws_about
        Function that draws parameters about sampled nodes, (n_samples, n_params) both, where nodes are not dense.
    known
        Parameters, (n_params,), if the readings alone determine them, without a fit.
    change_of_readings
        If it is physics of the mean, seen in the readings alone: function of readings that were predicted without it,
        of any shape, that returns their change.
    distance
        Norm, in noise sds, of the residuals of the readings that it lost and that the recording leaves out.
    """

    nodes_per_parameter: tuple[int, ...] = ()
    nodes_about: Callable[[FloatArray, FittedReadings], tuple[FloatArray, FloatArray]] | None = None
    draws_about: Callable[[FloatArray, np.random.Generator], FloatArray] | None = None
    known: FloatArray | None = None
    change_of_readings: Callable[[FloatArray], FloatArray] | None = None
    distance: float = 0.0

    def weighed_nodes(self, residuals: FloatArray, rows: FittedReadings) -> tuple[FloatArray, FloatArray]:
        """Return nodes given a fit, (n_nodes, n_params), and log weights, (n_nodes,): by default those of the prior."""
        if self.nodes_about is not None:
            return self.nodes_about(residuals, rows)
        nodes = self.entries[:, 0, :]
        return nodes, np.full(len(nodes), -np.log(len(nodes)))


def sentence_from_samples(effect: Effect, samples: FloatArray) -> str:
    """Describe an effect by samples of its parameters, (n_samples, n_params), and its origin, if that is not 0.

    Of an amplitude with samples on both sides of 0, but hardly any near it, it says between what values it lies. Values
    of runs are told from their median.
    """
    said = samples
    if effect.covariates == ("run",) and effect.stage is not Stage.NOISE:  # a parameter may take up what all share
        said = samples - np.median(samples, axis=1, keepdims=True)
    sentence = effect.sentence(*mean_and_sd_of_samples(said))
    for k in effect.amplitudes:
        positive, sizes = np.mean(samples[:, k] > 0), np.abs(samples[:, k])
        near = np.mean(sizes < _NEAR_ZERO * np.median(sizes))
        if _BOTH_SIGNS < positive < 1 - _BOTH_SIGNS and near < _FEW_NEAR_ZERO:
            low, high = np.quantile(samples[:, k], [0.025, 0.975])
            between = f"between {low:.2g} and {high:.2g} {unit_after_number(effect.units[k])}".rstrip()
            name = "size" if effect.prior.names[k] == "a" else f"size {effect.prior.names[k]}"
            sentence += f"; its {name} may have either sign, {between} (95 %)"
    counted_from = effect.binding.counted_from
    return f"{sentence} ({counted_from})" if counted_from else sentence


def in_words(text: str, *units: str, factors: Sequence[float] = ()) -> Say:
    """Return a sentence with {0}, {1} ... in place of the parameters' values with their sds, in these units.

    Values are given times `factors`, by default 1; {|0|} is an absolute value, and of {rises/falls} the first words
    are those of a first parameter above 0.
    """

    def says(mean: FloatArray, sd: FloatArray) -> str:
        out = re.sub(r"\{([^{}]*)/([^{}]*)\}", r"\1" if mean[0] > 0 else r"\2", text)
        for k, (m, s) in enumerate(zip(mean, sd, strict=True)):
            unit, factor = units[k] if k < len(units) else "", factors[k] if k < len(factors) else 1.0
            out = out.replace(f"{{{k}}}", value_with_sd(m, s, unit, factor=factor))
            out = out.replace(f"{{|{k}|}}", value_with_sd(abs(m), s, unit, factor=factor))
        return out

    return says


def mean_and_sd_of_samples(samples: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and sd of samples (n_samples, n_params); exact, without rounding, where all samples are equal."""
    equal = np.all(samples == samples[0], axis=0)
    return np.where(equal, samples[0], samples.mean(axis=0)), np.where(equal, 0.0, samples.std(axis=0))


def sizes_inside(prior: LogUniform, n: int, by: float = 1.5) -> FloatArray:
    """Return trial sizes of a prior for a template bank, (n,), by a factor inside its ends."""
    return np.geomspace(prior.low * by, prior.high / by, n)


def single_column_bank(*parameters: ArrayLike) -> FloatArray:
    """Return bank entries of one column from the parameters' values, numbers or (n_bank,): (n_bank, 1, n_params)."""
    return np.stack(np.broadcast_arrays(*map(np.atleast_1d, parameters)), axis=-1)[:, None, :].astype(np.float64)


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
    It does not lie between the two runs at whose `border`: what begins there is what differs from run to run.
    """

    at: tuple[float, ...]
    by_row: bool = False
    column: str = ""
    border: float = math.inf

    @property
    def intervals(self) -> list[tuple[float, float]]:
        """The intervals in which the change point may lie."""
        return [(low, high) for low, high in pairwise(self.at) if not low <= self.border < high]

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


def sine_and_cosine_entries(*parameters: ArrayLike) -> FloatArray:
    """Return bank entries of waves, sine and cosine, (n_bank, 2, n_params), from the parameters before the phase."""
    return np.concatenate([single_column_bank(*parameters, phase) for phase in (0.0, 0.5 * np.pi)], axis=1)


V = TypeVar("V")


@dataclass(frozen=True)
class Known(stages.Effect[V]):
    """An effect with fixed parameters, none of them free; `values` are in the order of `effect.prior.names`.

    Where they are estimates, `marginals` are their distributions, in the same order: a run that trusts its sensor uses
    the values, one that doubts it infers the parameters along with the shape (`informed`).
    """

    effect: stages.Effect[V]
    values: tuple[float, ...]
    marginals: tuple[Marginal, ...] = ()

    def __post_init__(self) -> None:
        names = self.effect.prior.names
        require(len(self.values) == len(names), "values", self.values, f"one number for each of {names}")
        require(len(self.marginals) in (0, len(names)), "marginals", self.marginals, f"a prior for each of {names}")

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def stage(self) -> Stage:
        return self.effect.stage

    @property
    def prior(self) -> Product:
        return Product({})

    def apply(self, value: V, theta: FloatArray, plan: Plan) -> V:
        """Apply the effect with the fixed values; theta is (n_samples, 0)."""
        return self.effect.apply(value, np.array([self.values]), plan)

    @property
    def informed(self) -> Effect:
        """The effect with free parameters again, and `marginals` as its prior."""
        own = cast(Effect, self.effect)
        return replace(own, parameters=dict(zip(own.prior.names, self.marginals, strict=True)))
