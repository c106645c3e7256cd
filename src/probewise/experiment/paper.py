"""The paper's experiment: a nested sampling run after every reading, fifty samples, entropy of their predictions.

Paper, "The Machine Learning System" and "Models Describing a Light Sensor". Ambiguities and errors of the paper are
resolved as in the rest of the package (docs/explanation/errata.md): the Student-t's sigma has proper bounds, the SSF is
the mean of the sampled fields, as a mixture of Gaussians in closed form rather than a sum over pixels of 1 mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import get_args

import numpy as np

from probewise._arrays import FloatArray, own_arithmetic
from probewise.arm import ReadingScale
from probewise.calibration import FittedSensor
from probewise.calibration.sensor_file import require_fitted_sensor
from probewise.errors import NotConvergedError, ParameterError
from probewise.experiment.configuration import Experiment, OneScan
from probewise.experiment.kinds import HypothesisKind
from probewise.experiment.particles import Particles
from probewise.experiment.posterior import Posterior
from probewise.experiment.simulation import (
    Model,
    entropy_bin_width_of,
    experiment_without_inference,
    mean_levels_of,
    scale_of,
    sensor_chain_at_means,
)
from probewise.inference import Naive
from probewise.inquiry import ReadingEntropy
from probewise.nested import (
    NESTED_STOP,
    EvidenceChange,
    KernelMove,
    Move,
    NestedResult,
    NestedStop,
    StopRule,
    Weighted,
    diversify,
    run,
)
from probewise.nested.weights import resampled_rows
from probewise.recordings import Recording
from probewise.recordings import Uniform as UniformPattern
from probewise.recordings.plan import require_patterns_described, require_recording
from probewise.scene import Field, HypothesisScene, KnownScene, Shape
from probewise.sensor import FAST_NODES, Chain, FixedLevels, NaiveSensor
from probewise.world import World

N_LIVE = 300
"""Live points of nested sampling in the paper."""

_N_SAMPLES = 50
_N_STEPS = 1000
_N_GAUSSIANS = 32  # of the mean of the sampled fields
_N_EACH = 20  # number of readings over black and over white
_LEAST_SHARE = 1e-3  # of the levels' difference: least noise sd, and tolerance for uniform black or white


@dataclass(frozen=True)
class NestedSampling:
    """Nested sampling on all readings after each one, with diversified samples (paper, machine learning system).

    Parameters
    ----------
    n_live
        Live points; the paper has 300.
    stop
        Stopping rule of nested sampling; in the paper a change of ln Z below 1e-8.
    n_steps
        Metropolis-Hastings steps of each drawn sample; the paper takes about 1000.
    move
        Move that draws new points.
    """

    n_live: int = N_LIVE
    stop: StopRule = field(default_factory=EvidenceChange)
    n_steps: int = _N_STEPS
    move: Move = field(default_factory=KernelMove)

    @property
    def label(self) -> str:
        """Short name for reports."""
        return f"the paper's: nested sampling anew after each reading, {self.n_live} live points"

    def updated(self, previous: Posterior, recording: Recording, *, rng: np.random.Generator) -> Posterior:
        """Infer from all readings by a new nested sampling run for each kind of hypotheses."""
        found = tuple(
            self._sample_by_nested_sampling(had, kind, recording, rng)
            for kind, had in zip(previous.kinds, previous.particles, strict=True)
        )
        now = replace(previous, particles=found)
        if not np.isfinite(now.log_odds).any():
            raise NotConvergedError("no hypothesis of any kind could have given these readings")
        return now

    def reconsidered(self, posterior: Posterior, recording: Recording, *, rng: np.random.Generator) -> Posterior:
        """Return the posterior as it is: nested sampling starts anew at every reading, so no samples lose a mode."""
        return posterior

    def drawn(
        self, posterior: Posterior, joined: Weighted, recording: Recording, n: int, *, rng: np.random.Generator
    ) -> FloatArray:
        """Draw `n` hypotheses, (n, n_params), each moved by `n_steps` steps, since a run's samples may be copies."""
        which = resampled_rows(posterior.probability, n, rng)
        drawn = []
        for k, (kind, particles) in enumerate(zip(posterior.kinds, posterior.particles, strict=True)):
            if n_own := int((which == k).sum()):
                start = particles.weighted.samples(n_own, rng=rng)
                moved, _ = diversify(start, kind.problem(recording), rng=rng, n_steps=self.n_steps)
                drawn.append(kind.to_whole_theta(moved, rng))
        return np.concatenate(drawn)

    def _sample_by_nested_sampling(
        self, had: Particles, kind: HypothesisKind, recording: Recording, rng: np.random.Generator
    ) -> Particles:
        """Sample one kind by nested sampling; its evidence is zero if none of its hypotheses is possible."""
        try:
            result = run(
                kind.problem(recording),
                rng=rng,
                n_live=self.n_live,
                stop=self.stop,
                move=self.move,
                max_cost=1.0,  # the robot waits
                return_interrupted=False,
            )
        except NotConvergedError:  # no hypothesis of this kind could have given the readings
            return replace(had, weighted=replace(had.weighted, log_z=-math.inf, log_z_error=math.inf))
        found = _weighted_samples_of(result, had.weighted.n_calls + result.n_calls)
        return Particles(found, np.arange(len(found.theta)))


def _weighted_samples_of(result: NestedResult, n_calls: int) -> Weighted:
    """Return the weighted samples of a run, with `n_calls` evaluations so far."""
    return Weighted(
        result.names,
        result.theta,
        log_likelihood=result.log_likelihood,
        log_weight=result.log_weight,
        log_z=result.log_z,
        log_z_error=result.log_z_error,
        n_eff=result.n_eff,
        n_calls=n_calls,
        pareto_k=-math.inf,
        run=result,
    )


def paper_experiment(
    sensor: FittedSensor,
    shape: Shape,
    field: Field,
    *,
    model: Model = "ssf",
    nested_stop: NestedStop = "change",
    naive: Naive | None = None,
    orientations_rad: tuple[float, ...] = (0.0,),
    repeats: tuple[int, ...] = (1,),
    heights_mm: tuple[float, ...] = (),
) -> Experiment:
    """Build the paper's experiment: its method of inference, utility and likelihood.

    Parameters
    ----------
    sensor, shape, field
        As for `experiment_for`.
    model
        "ssf": Student-t likelihood with unknown sd. "naive": two levels, each with its own sd.
    nested_stop
        "change": nested sampling ends at a change of ln Z below 1e-8, as in the paper; "remaining": when ln Z can rise
        by at most 0.05.
    naive
        Levels and sds of the naive model, from repeated readings over black and over white; see
        `naive_levels_from_recording` and `naive_levels_from_world`.
    orientations_rad, repeats, heights_mm
        As for `experiment_for`.

    Raises
    ------
    ParameterError
        If a name is unknown, the naive model has no levels, or an option does not go with the model.
    """
    require_fitted_sensor(sensor, "in the order paper_experiment(sensor, shape, field)")
    for name, value, allowed in (("model", model, get_args(Model)), ("nested_stop", nested_stop, tuple(NESTED_STOP))):
        if value not in allowed:
            raise ParameterError(name, value, " or ".join(map(repr, allowed)))
    sensor = sensor.with_leading_effects()
    scale, scene = scale_of(sensor.instrumentation), HypothesisScene(shape)
    if naive is not None and model != "naive":
        raise ParameterError("naive", naive, 'None, but with the model "naive"')
    pose = partial(
        experiment_without_inference(
            sensor, shape, field, model, orientations_rad=orientations_rad, repeats=repeats, heights_mm=heights_mm
        ),
        utility=ReadingEntropy(entropy_bin_width_of(sensor)),
        n_samples=_N_SAMPLES,
        n_live=N_LIVE,
        method=NestedSampling(stop=NESTED_STOP[nested_stop]),
    )
    if model != "naive":
        chain = replace(sensor_chain_at_means(sensor, scene), ssf=sensor.mean_mixture(_N_GAUSSIANS))
        return pose(chain, student_t_likelihood(mean_levels_of(sensor), scale.step))
    if naive is None:
        raise ParameterError(
            "naive", None, 'levels and sds with the model "naive", from repeated readings over black and white'
        )
    # The naive model has no partial coverage, so readings on edges never fit: its fit is not tested.
    return pose(NaiveSensor(FixedLevels(naive.mu_black, naive.mu_white), scene), naive, doubt_p=0.0)


def student_t_likelihood(levels: FixedLevels, step: float | None) -> OneScan:
    """Return the Student-t likelihood with its noise sd bounded for these levels.

    The sd is at least that of rounding or 0.001 of the levels' difference, whichever is larger; at most that
    difference, or ten times the least sd if that is larger.
    """
    span = abs(levels.i_max - levels.i_min)
    floor = _least_sd(span, step)
    return OneScan(floor, max(span, 10.0 * floor))


@own_arithmetic
def naive_levels_from_recording(recording: Recording, sensor: FittedSensor) -> Naive:
    """Estimate the naive model's levels and sds from a recording's readings over black and over white.

    Readings count if at most a thousandth of the footprint is on the other colour: over uniform sheets, and at the far
    ends of scans across an edge.

    Raises
    ------
    ParameterError
        If there are fewer than two readings over either colour.
    """
    require_recording(recording)
    require_fitted_sensor(sensor)
    require_patterns_described(recording.plan)
    mixture, patterns = sensor.with_leading_effects().mean_mixture(), KnownScene(recording.plan.patterns)
    share = Chain(mixture, FixedLevels(0.0, 1.0), patterns, n_nodes=FAST_NODES)
    seen = share.predict(np.empty((1, 0)), recording.plan)[0]
    black, white = (
        recording.readings[recording.usable & (np.abs(seen - albedo) <= _LEAST_SHARE)] for albedo in (0.0, 1.0)
    )
    if min(black.size, white.size) < 2:
        raise ParameterError(
            recording.source or "recording",
            f"{black.size} readings over black and {white.size} over white",
            "two or more of each, far from any edge: repeated readings over a black and over a white sheet",
        )
    return _naive_from_readings(black, white, scale_of(sensor.instrumentation).step)


@own_arithmetic
def naive_levels_from_world(
    world: World, scale: ReadingScale, *, rng: np.random.Generator, n_each: int = _N_EACH
) -> Naive:
    """Simulate `n_each` readings over a black and a white sheet, for the naive model's levels and sds."""
    black, white = (
        np.array(
            [
                scale.clip_and_round(world.read(UniformPattern(albedo), 0.0, 0.0, time_s=float(k), rng=rng))
                for k in range(n_each)
            ]
        )
        for albedo in (0.0, 1.0)
    )
    return _naive_from_readings(black, white, scale.step)


def _naive_from_readings(black: FloatArray, white: FloatArray, step: float | None) -> Naive:
    """Estimate the naive model from readings over black and over white."""
    return Naive.estimated(black, white, sd_floor=_least_sd(abs(float(white.mean() - black.mean())), step))


def _least_sd(span: float, step: float | None) -> float:
    """Return the least plausible sd: that of rounding or a thousandth of `span`, whichever is larger."""
    return max((step or 0.0) / math.sqrt(12.0), _LEAST_SHARE * span)
