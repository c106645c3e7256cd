"""The experiment of a fitted sensor over an unknown shape: where method, sensor model and options meet."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, cast, get_args

import numpy as np

from probewise._arrays import FloatArray, own_arithmetic
from probewise._kinds import require_kind, require_like, require_one_of
from probewise.arm import ReadingScale
from probewise.calibration import FittedSensor
from probewise.calibration.sensor_file import require_fitted_sensor
from probewise.effects import Effect, Known
from probewise.errors import require
from probewise.experiment.method import NestedSampling
from probewise.experiment.paper import least_sd, student_t_likelihood
from probewise.experiment.rivals import OF_MOTION, from_rest
from probewise.experiment.setup import Experiment
from probewise.experiment.simulated import ModelName, scale_of
from probewise.inference import Naive, Rounded
from probewise.inference.problem import Likelihood
from probewise.inquiry import Finishing, Grid, ReadingEntropy, Utility, utility_named
from probewise.inquiry.utilities import UTILITY_NAMES
from probewise.nested import NESTED_STOP, NestedStop
from probewise.priors import LogNormal, Marginal, Normal, Product
from probewise.recordings import Recording
from probewise.recordings import Uniform as UniformPattern
from probewise.recordings.plan import require_patterns_described, require_recording
from probewise.scene import AnyOf, Card, CardedScene, Field, HypothesisScene, KnownScene, Shape
from probewise.sensor import (
    FAST_NODES,
    Chain,
    FixedLevels,
    FixedMixture,
    Footprint,
    FreeLevels,
    NaiveSensor,
    Stage,
    footprint_of,
)
from probewise.sensor.stages import AnyEffect, SensorModel, require_theta_columns
from probewise.world import World

MethodName: TypeAlias = Literal["particles", "paper"]

TRUST = 0.9
"""Default prior probability that a sensor model is complete."""

_METHODS, _MODELS = get_args(MethodName), get_args(ModelName)
_NO_HEIGHT = "none with this sensor: its description does not say at which height_mm it was calibrated"
_CELLS_PER_SD = 8.0  # cells per noise sd for unrounded readings
_PAPER_GAUSSIANS = 32  # of the mean of the sampled fields
_N_EACH = 20  # simulated readings over black and over white
_UNIFORM = 1e-3  # share of the footprint on the other colour up to which a reading is over uniform black or white

# Prior sds of a sensor's changes since its calibration.
_CHANGE_OF_LOG_SIZE = 0.3  # of the footprint along each axis: a factor of 1.35 either way
_CHANGE_OF_PLACE_MM = 1.0
_CHANGE_OF_LEVEL = 0.03  # share of the difference of the levels


@own_arithmetic
def experiment_for(
    sensor: FittedSensor,
    shape: Shape,
    field: Field,
    *,
    method: MethodName = "particles",
    model: ModelName = "ssf",
    utility: str | Utility | None = None,
    learn_sensor: bool = False,
    batch: int = 1,
    trust: float | None = None,
    n_live: int = 200,
    nested_stop: NestedStop | None = None,
    naive: Naive | None = None,
    orientations_rad: tuple[float, ...] = (0.0,),
    repeats: tuple[int, ...] = (1,),
    heights_mm: tuple[float, ...] = (),
    cards: tuple[Card, ...] = (),
) -> Experiment:
    """Build the experiment of a fitted sensor over an unknown shape, with readings on the sensor's scale.

    Parameters
    ----------
    sensor
        The fitted sensor; if it averages several hypotheses, the most probable one is used. The SSF model takes the
        mixture with the mean and covariance of the sensor's mean field, for closed forms instead of sums over pixels,
        and effects on the mean at their posterior means; with `trust` below 1 these effects are inferred along with the
        shape. Effects on the noise are left out. The naive model takes the sensor's two levels.
    shape
        The possible shape on the field.
    field
        The playing field, mm; the places are a grid of 131 x 65 over it, as in the paper.
    method
        "particles": sequential Monte Carlo. "paper": nested sampling again after each reading, the entropy of 50
        predictions, a Student-t likelihood with unknown sd or the naive one, and a complete sensor model.
    model
        "ssf" or "naive".
    utility
        Utility, or its name (see `inquiry.utility_named`); by default `Finishing()`, with the paper's, entropy.
    learn_sensor
        Infer the SSF's size and place and the two levels jointly with the shape, with a prior from the calibration.
    batch
        Readings chosen together.
    trust
        Prior probability that the sensor model is complete; below 1 only for the SSF model of a known sensor. By
        default 0.9 (`TRUST`), or 1 where no rival is considered: for the paper's method, the naive model, a sensor that
        is learnt, several shapes, or any utility but `Finishing()`.
    n_live
        Live points of nested sampling, if no sample predicts a reading; the paper's method has 300.
    nested_stop
        With the paper's method, "change": nested sampling ends at a change of ln Z below 1e-8, the default;
        "remaining": when ln Z can rise by at most 0.05.
    naive
        Levels and sds of the paper's naive model, from repeated readings over black and over white; see
        `naive_levels_from_recording` and `naive_levels_from_world`.
    orientations_rad, repeats, heights_mm
        Possible orientations, numbers of repeated readings and heights, for an arm that supports them; heights only for
        the SSF model of a sensor with a known height of calibration.
    cards
        Cards of known place and albedo on the field; for the SSF model.

    Raises
    ------
    ParameterError
        If a name is unknown, or an option does not go with the method, the model or the sensor.
    """
    require_fitted_sensor(sensor, "in the order experiment_for(sensor, shape, field)")
    require_one_of("method", method, _METHODS)
    require_one_of("model", model, _MODELS)
    if nested_stop is not None:
        require_one_of("nested_stop", nested_stop, tuple(NESTED_STOP))
    if utility is not None and not isinstance(utility, str):
        require_like("utility", utility, ("label", "__call__"), f"one of {', '.join(UTILITY_NAMES)}, or a utility")
    for card in cards:
        require_kind("cards", card, Card, "Cards, of probewise.scene")
    scale, paper = scale_of(sensor.instrumentation), method == "paper"
    bin_width = scale.step or float(sensor.noise_sd.mean())
    chosen = utility_named(utility, bin_width=bin_width) if isinstance(utility, str) else utility
    for_paper, for_naive = "with the paper's method", 'with the model "naive"'
    from_sheets = "from repeated readings over black and white"
    complete = "1, since the sensor model is taken for complete,"
    paper_utility = chosen is None or isinstance(chosen, ReadingEntropy)
    refused = (
        ("nested_stop", nested_stop, not paper and nested_stop is not None, f"None, but {for_paper}"),
        ("naive", naive, not paper and naive is not None, f"None, but {for_paper}"),
        ("naive", naive, model != "naive" and naive is not None, f"None, but {for_naive}"),
        ("naive", None, paper and model == "naive" and naive is None, f"levels and sds {for_naive}, {from_sheets}"),
        ("utility", utility, paper and not paper_utility, f"entropy, which is the paper's, {for_paper}"),
        ("learn_sensor", learn_sensor, paper and learn_sensor, f"False, since the sensor is known, {for_paper}"),
        ("batch", batch, paper and batch != 1, f"1, since each reading is chosen by all before it, {for_paper}"),
        ("cards", cards, paper and bool(cards), f"none, since its scene is the shape alone, {for_paper}"),
        ("trust", trust, paper and trust not in (None, 1), f"{complete} {for_paper}"),
        ("cards", cards, model == "naive" and bool(cards), f"none {for_naive}, which knows two levels alone"),
        ("learn_sensor", learn_sensor, model == "naive" and learn_sensor, f"False {for_naive}, which has no SSF"),
        ("heights_mm", heights_mm, model == "naive" and bool(heights_mm), f"none {for_naive}, which knows no height"),
        ("heights_mm", heights_mm, bool(heights_mm) and sensor.instrumentation.height_mm is None, _NO_HEIGHT),
    )
    for name, value, wrong, allowed in refused:
        require(not wrong, name, value, allowed)
    sensor = sensor.with_leading_effects()  # a mean over several hypotheses describes none of them
    noise_sd = float(sensor.noise_sd.mean())
    scene = CardedScene(shape, cards) if cards else HypothesisScene(shape)
    if trust is None:
        unrivalled = paper or model == "naive" or learn_sensor or isinstance(shape, AnyOf)
        trust = 1.0 if unrivalled or chosen not in (None, Finishing()) else TRUST
    acting, likelihood = _model_and_likelihood(
        sensor, scene, scale, naive, model=model, paper=paper, learn_sensor=learn_sensor, doubted=trust < 1
    )
    return Experiment(
        shape,
        acting,
        likelihood,
        noise_sd=noise_sd,
        grid=Grid(field.width_mm, field.height_mm),
        utility=ReadingEntropy(scale.step or noise_sd) if paper else chosen or Finishing(),
        sensor_prior=_prior_of_changed_sensor(sensor) if learn_sensor else None,
        step=scale.step,
        reading_range=(scale.low, scale.high),
        orientations_rad=orientations_rad,
        repeats=repeats,
        heights_mm=heights_mm,
        calibrated_height_mm=sensor.instrumentation.height_mm,
        batch=batch,
        # A reading on the edge fits neither level, and the naive model has no partial coverage.
        doubt_p=0.0 if model == "naive" else Experiment.doubt_p,
        trust=trust,
        n_live=NestedSampling.n_live if paper else n_live,
        method=NestedSampling(stop=NESTED_STOP[nested_stop or "change"]) if paper else None,
    )


def _model_and_likelihood(
    sensor: FittedSensor,
    scene: HypothesisScene,
    scale: ReadingScale,
    naive: Naive | None,
    *,
    model: ModelName,
    paper: bool,
    learn_sensor: bool,
    doubted: bool,
) -> tuple[SensorModel, Likelihood]:
    """Return the sensor model over the scene, with parameters at their means or free, and the likelihood."""
    means, noise_sd = sensor.mean(), float(sensor.noise_sd.mean())
    levels = FixedLevels(means["I_min"], means["I_max"])
    if model == "naive":
        sd = math.hypot(noise_sd, (scale.step or 0.0) / math.sqrt(12))
        naive = naive or Naive(levels.i_min, sd, levels.i_max, sd)
        return NaiveSensor(FixedLevels(naive.mu_black, naive.mu_white), scene), naive
    mixture = sensor.mean_mixture(_PAPER_GAUSSIANS) if paper else sensor.mean_mixture()
    effects = _effects_of_sensor(sensor, estimated=doubted and not learn_sensor)
    chain = Chain(mixture, levels, scene, effects, n_nodes=FAST_NODES)
    if paper:
        return chain, student_t_likelihood(levels, scale.step)
    # Unrounded readings get cells scaled to the noise; the end cells are open.
    step = scale.step or noise_sd / _CELLS_PER_SD
    likelihood = Rounded(noise_sd, step, scale.low, scale.high, whole_steps=scale.step is not None)
    return replace(chain, ssf=AdjustedMixture(mixture), levels=FreeLevels()) if learn_sensor else chain, likelihood


def _effects_of_sensor(sensor: FittedSensor, *, estimated: bool) -> tuple[AnyEffect, ...]:
    """Return the sensor's effects on the mean at their posterior means.

    With `estimated`, they carry priors fitted to their samples, so that a run can infer their parameters too; effects
    of the arm's direction of motion then leave out a run's first reading.
    """
    means, effects = sensor.mean(), list[AnyEffect]()
    # A run has a clock and a frame of its own, not those of the recording that was diagnosed.
    for effect in replace(sensor, origins={}).effects_on_new_scans:
        if effect.stage is Stage.NOISE:  # noise of readings far apart in place and time is independent
            continue
        names = [f"{effect.name}.{name}" for name in effect.prior.names]
        values = tuple(means[name] for name in names)
        samples = [sensor.samples[:, sensor.names.index(name)] for name in names]
        if estimated and all(own.std() > 0 for own in samples):
            acting = from_rest(cast(Effect, effect)) if effect.name in OF_MOTION else effect
            effects.append(Known(acting, values, tuple(map(_marginal_fitted_to, samples))))
        else:
            effects.append(Known(effect, values))
    return tuple(effects)


def _marginal_fitted_to(samples: FloatArray) -> Marginal:
    """Return a prior fitted to samples, (n_samples,): by mean and sd of their logs if all are positive, else normal."""
    if (samples > 0).all():
        log = np.log(samples)
        return LogNormal(float(np.exp(log.mean())), float(log.std()))
    return Normal(float(samples.mean()), float(samples.std()))


@dataclass(frozen=True, eq=False)
class AdjustedMixture:
    """A known mixture, scaled about its mean along the sensor's axes and shifted: four parameters.

    Paper, Conclusion: "calibration on the fly". The calibrated SSF keeps its form.
    """

    mixture: FixedMixture

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters: log_size_u, log_size_v, shift_u_mm, shift_v_mm."""
        return ("log_size_u", "log_size_v", "shift_u_mm", "shift_v_mm")

    def footprint(self, theta: FloatArray) -> Footprint:
        """Return the mixture of each hypothesis, theta (n_samples, 4)."""
        require_theta_columns(theta, self.names)
        size_u, size_v = np.exp(theta[:, None, 0:1]), np.exp(theta[:, None, 1:2])
        whole = self.mixture.footprint(np.empty((1, 0)))
        mean_u, mean_v = self.mixture.mean_mm
        return Footprint(
            whole.weight,
            mean_u + size_u * (whole.u_mm - mean_u) + theta[:, None, 2:3],
            mean_v + size_v * (whole.v_mm - mean_v) + theta[:, None, 3:4],
            size_u**2 * whole.var_u,
            size_v**2 * whole.var_v,
            size_u * size_v * whole.cov_uv,
        )


def sensor_change_prior(
    levels: tuple[float, float],
    *,
    level_sds: tuple[float, float] = (0.0, 0.0),
    footprint_sds: Mapping[str, float] | None = None,
) -> Product:
    """Return the prior of `AdjustedMixture` and the levels: changes since the calibration, and its uncertainties.

    `levels` are the readings over black and over white, `footprint_sds` the sds of the footprint by parameter.
    """
    change = _CHANGE_OF_LEVEL * abs(levels[1] - levels[0])
    changes = {name: _CHANGE_OF_LOG_SIZE for name in ("log_size_u", "log_size_v")}
    changes |= {name: _CHANGE_OF_PLACE_MM for name in ("shift_u_mm", "shift_v_mm")}
    known = footprint_sds or {}
    footprint = {name: Normal(0.0, math.hypot(sd, known.get(name, 0.0))) for name, sd in changes.items()}
    ends = zip(("I_min", "I_max"), levels, level_sds, strict=True)
    return Product({**footprint, **{name: Normal(level, math.hypot(change, sd)) for name, level, sd in ends}})


def _prior_of_changed_sensor(sensor: FittedSensor) -> Product:
    """Return the prior of a sensor that may have changed: the calibration's posterior, widened."""
    n, mean, sd = sensor.n_gaussians, sensor.mean(), sensor.sd()
    footprint = footprint_of(sensor.samples[:, : 6 * n], n)
    sds = {}
    for axis, place, variance in (("u", footprint.u_mm, footprint.var_u), ("v", footprint.v_mm, footprint.var_v)):
        weight, at = footprint.weight[:, 0], place[:, 0]
        centre = (weight * at).sum(axis=1)
        spread = (weight * (variance[:, 0] + at**2)).sum(axis=1) - centre**2
        sds[f"log_size_{axis}"] = float(np.log(np.sqrt(spread)).std())
        sds[f"shift_{axis}_mm"] = float(centre.std())
    levels, level_sds = ((of["I_min"], of["I_max"]) for of in (mean, sd))
    return sensor_change_prior(levels, level_sds=level_sds, footprint_sds=sds)


@own_arithmetic
def naive_levels_from_recording(recording: Recording, sensor: FittedSensor) -> Naive:
    """Estimate the naive model's levels and sds from a recording's readings over black and over white.

    Readings count if at most a thousandth of the footprint is on the other colour: over uniform sheets, and at the far
    ends of scans across an edge. ParameterError if there are fewer than two over either colour.
    """
    require_recording(recording)
    require_fitted_sensor(sensor)
    require_patterns_described(recording.plan)
    mixture, patterns = sensor.with_leading_effects().mean_mixture(), KnownScene(recording.plan.patterns)
    share = Chain(mixture, FixedLevels(0.0, 1.0), patterns, n_nodes=FAST_NODES)
    seen = share.predict(np.empty((1, 0)), recording.plan)[0]
    black, white = (recording.readings[recording.usable & (np.abs(seen - albedo) <= _UNIFORM)] for albedo in (0.0, 1.0))
    found = f"{black.size} readings over black and {white.size} over white"
    allowed = "two or more of each, far from any edge: repeated readings over a black and over a white sheet"
    require(min(black.size, white.size) >= 2, recording.source or "recording", found, allowed)
    return _naive_from_readings(black, white, scale_of(sensor.instrumentation).step)


@own_arithmetic
def naive_levels_from_world(world: World, scale: ReadingScale, *, rng: np.random.Generator) -> Naive:
    """Simulate 20 readings each over a black and a white sheet, for the naive model's levels and sds."""

    def read(albedo: float) -> FloatArray:
        signals = [world.read(UniformPattern(albedo), 0.0, 0.0, time_s=float(k), rng=rng) for k in range(_N_EACH)]
        return np.array([scale.clip_and_round(signal) for signal in signals])

    black, white = read(0.0), read(1.0)
    return _naive_from_readings(black, white, scale.step)


def _naive_from_readings(black: FloatArray, white: FloatArray, step: float | None) -> Naive:
    return Naive.estimated(black, white, sd_floor=least_sd(abs(float(white.mean() - black.mean())), step))
