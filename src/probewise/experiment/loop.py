"""Measure, infer, inquire, until every length is known well enough (paper, the machine learning system).

`step` takes one reading by hand; `explore` is the plain loop around it, a generator, so that
the command line, notebooks and reports see the same steps; `run` collects them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from probewise._arrays import BoolArray, FloatArray
from probewise.arm.instrument import Instrument, Pose, Reading
from probewise.errors import DoubtfulResultWarning, ParameterError
from probewise.experiment.journal import (
    PATTERN,
    Belief,
    Journal,
    JournalWriter,
    read_journal,
    require_same_settings,
)
from probewise.experiment.values import Experiment, Exploration, State, Step, widest_mm
from probewise.inference.problem import SensorProblem
from probewise.inquiry import EntropyMap, bits_gained, entropy_map, prior_entropy
from probewise.nested.kernels import KernelMove, diversify_by_kernels
from probewise.nested.result import NestedResult
from probewise.nested.sampler import run as run_nested
from probewise.nested.stop import RemainingEvidence
from probewise.scene.shapes import AnyOf

__all__ = ["begin", "explore", "run", "step"]

NO_FIT = 1e-6  # below this probability of the best hypothesis a step says that none explains the readings

DLOGZ = 0.5  # the last live points are posterior samples too: letting them die one by one would only refine log Z
N_KERNELS = 100  # posterior samples that proposals stand about


def begin(experiment: Experiment, reachable: BoolArray, *, rng: np.random.Generator) -> State:
    """Choose the first place: the map of hypotheses drawn from the prior.

    Parameters
    ----------
    experiment
        What is asked.
    reachable
        Places of the grid that the arm can take, (n_places,).
    rng
        Source of randomness.
    """
    prior = experiment.prior
    theta = prior.from_unit_cube(rng.random((experiment.n_samples, len(prior.names))))
    outlook = _inquire(experiment, theta, reachable, time_s=0.0)
    return State((), Pose(*outlook.choose(rng=rng)))


def step(
    state: State,
    reading: Reading,
    experiment: Experiment,
    reachable: BoolArray,
    *,
    prior_bits: float,
    rng: np.random.Generator,
    max_readings: int | None = None,
) -> tuple[State, Step]:
    """Infer from one more reading and ask where the next would tell most.

    Parameters
    ----------
    state
        The readings so far.
    reading
        The new one.
    experiment, reachable
        See `begin`.
    prior_bits
        Differential entropy of the prior, see `inquiry.prior_entropy`.
    rng
        Source of randomness of this step.
    max_readings
        Say that the run is over at this many readings, if not before.

    Raises
    ------
    NotConvergedError
        If no hypothesis could have given these readings.
    """
    readings = (*state.readings, reading)
    problem = experiment.problem(readings)
    with warnings.catch_warnings():
        # Each step keeps its own doubts; a warning a reading would bury them.
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        posterior = run_nested(
            problem,
            rng=rng,
            n_live=experiment.n_live,
            move=KernelMove(),
            stop=RemainingEvidence(DLOGZ),
            return_interrupted=False,
        )
    drawn = posterior.samples(experiment.n_samples, rng=rng)
    cloud = posterior.samples(N_KERNELS, rng=rng)
    samples, _ = diversify_by_kernels(drawn, cloud, problem, rng=rng, n_steps=experiment.n_diversify)
    samples.flags.writeable = False
    mean, sd, shapes = _moments(experiment, posterior)
    p_value, worst = _fit(experiment, posterior, problem)
    notes = posterior.warnings
    if p_value < NO_FIT:
        notes = (
            *notes,
            f"no hypothesis explains the readings: the best has p = {p_value:.1g} and is worst at reading {worst + 1} "
            f"({readings[worst].value:g}); the hypothesis space excludes what lies there, or the sensor model "
            "leaves something out",
        )
    stop_reason = None
    if experiment.is_known(sd, shapes):
        stop_reason = f"every length is known to better than {experiment.stop_sd_mm:g} mm"
    elif max_readings is not None and len(readings) >= max_readings:
        widest = widest_mm(experiment.names, sd)
        stop_reason = f"max_readings = {max_readings} is reached; the widest length is known to {widest:.1f} mm"
    outlook = _inquire(experiment, samples, reachable, time_s=reading.time_s)
    next_pose = Pose(*outlook.choose(rng=rng))
    log_prior = problem.prior.log_prob(posterior.theta)
    info = Step(
        number=len(readings),
        reading=reading,
        names=experiment.names,
        mean=mean,
        sd=sd,
        shapes=shapes,
        samples=samples,
        map=outlook,
        next_pose=None if stop_reason else next_pose,
        bits=bits_gained(posterior.information, log_prior, posterior.weight, prior_bits),
        p_value=p_value,
        posterior=posterior,
        stop_reason=stop_reason,
        notes=notes,
    )
    return State(readings, next_pose), info


def explore(
    instrument: Instrument,
    experiment: Experiment,
    *,
    rng: np.random.Generator,
    max_readings: int = 100,
    journal: str | Path | None = None,
) -> Iterator[Step]:
    """Let the robot find the shape: yield one step a reading until its lengths are known (paper, section 2).

    Parameters
    ----------
    instrument
        What takes the readings, entered already (`with arm:`).
    experiment
        What is asked, of which sensor, how long.
    rng
        Gives the run its seed: a child of its seed sequence, from which each reading has a
        child of its own. So one seed gives the whole run, and a resumed run goes on bit for bit
        as if it had never been interrupted.
    max_readings
        End here if the lengths are not known by then.
    journal
        File that gets one JSON line a measurement. Where it exists already the run resumes: the
        readings it holds are taken from it, not from the instrument, and their steps are
        yielded again with `replayed` set.

    Raises
    ------
    ReachError
        If the arm can reach no place of the grid.
    FileError
        If the journal is damaged, or belongs to a run with other settings.
    NotConvergedError
        If no hypothesis could have given the readings.
    """
    if max_readings < 1:
        raise ParameterError("max_readings", max_readings, "1 or more")
    seed = _child(rng)
    before = None if journal is None or not Path(journal).exists() else read_journal(journal)
    if before is not None:
        require_same_settings(before, experiment.settings(seed))
        seed = np.random.SeedSequence(seed.entropy, spawn_key=tuple(before.settings["spawn_key"]))
        if len(before.entries) > max_readings:
            raise ParameterError(
                "max_readings", max_readings, f"the {len(before.entries)} readings the journal holds, or more"
            )
    return _steps(instrument, experiment, seed, max_readings, None if journal is None else Path(journal), before)


def run(
    instrument: Instrument,
    experiment: Experiment,
    *,
    rng: np.random.Generator,
    max_readings: int = 100,
    journal: str | Path | None = None,
    progress: Callable[[Step], None] | None = None,
) -> Exploration:
    """Run `explore` to its end and collect the steps; `progress` is called with each as it comes."""
    steps = []
    for info in explore(instrument, experiment, rng=rng, max_readings=max_readings, journal=journal):
        if progress is not None:
            progress(info)
        steps.append(info)
    return Exploration(experiment, tuple(steps))


def _steps(
    instrument: Instrument,
    experiment: Experiment,
    seed: np.random.SeedSequence,
    max_readings: int,
    path: Path | None,
    before: Journal | None,
) -> Iterator[Step]:
    replayed, notes = ((), ()) if before is None else (before.entries, before.notes)
    with _writer(path, before, experiment, seed) as writer:
        reachable = np.asarray(instrument.reachable(experiment.grid.places_mm), dtype=np.bool_)
        first = _rng_of(seed, 0)
        prior_bits = prior_entropy(experiment.prior, rng=first)
        state = begin(experiment, reachable, rng=first)
        stopped = False
        while not stopped:
            number = len(state.readings) + 1
            entry = replayed[number - 1] if number <= len(replayed) else None
            reading = instrument.measure(state.next_pose) if entry is None else entry.reading
            if writer is not None and (entry is None or entry.belief is None):
                writer.reading(number, reading)
            state, info = step(
                state,
                reading,
                experiment,
                reachable,
                prior_bits=prior_bits,
                rng=_rng_of(seed, number),
                max_readings=max_readings,
            )
            if writer is not None and (entry is None or entry.belief is None):
                writer.belief(_belief(info, state.next_pose))
            if entry is not None:
                info = dataclasses.replace(info, replayed=True)
                # The journal decides, also where another machine's arithmetic would choose another place.
                if entry.belief is not None:
                    state = dataclasses.replace(state, next_pose=entry.belief.next_pose)
            if number == 1 and notes:
                info = dataclasses.replace(info, notes=(*info.notes, *notes))
            stopped = info.stop_reason is not None
            yield info


def _writer(
    path: Path | None, before: Journal | None, experiment: Experiment, seed: np.random.SeedSequence
) -> contextlib.AbstractContextManager[JournalWriter | None]:
    if before is not None:
        return JournalWriter.resume(before)
    return contextlib.nullcontext() if path is None else JournalWriter.begin(path, experiment.settings(seed))


def _child(rng: np.random.Generator) -> np.random.SeedSequence:
    """Derive a run's seed: runs that share a generator differ, and do not depend on what else was drawn from it."""
    seed = rng.bit_generator.seed_seq
    if not isinstance(seed, np.random.SeedSequence):
        seed = np.random.SeedSequence([int(word) for word in rng.integers(2**32, size=4)])
    return seed.spawn(1)[0]


def _rng_of(seed: np.random.SeedSequence, number: int) -> np.random.Generator:
    """Seed the generator of one reading, the same whatever was drawn for the readings before."""
    return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, number)))


def _inquire(experiment: Experiment, theta: FloatArray, reachable: BoolArray, *, time_s: float) -> EntropyMap:
    return entropy_map(
        experiment.model,
        theta,
        experiment.grid,
        experiment.grid.plan(PATTERN, time_s=time_s),
        reachable=reachable,
        noise_sd=experiment.noise_sd,
        utility=experiment.utility,
    )


def _moments(experiment: Experiment, posterior: NestedResult) -> tuple[FloatArray, FloatArray, dict[str, float]]:
    """Posterior mean and sd, (n_params,) both, and shape probabilities; of a set: given its most probable shape."""
    if not isinstance(experiment.shape, AnyOf):
        return posterior.mean(), posterior.sd(), {}
    which, weight = experiment.shape.which(posterior.theta), posterior.weight
    share = np.bincount(which, weights=weight, minlength=len(experiment.shape.labels))
    likely = int(share.argmax())
    columns = experiment.shape.prior.columns[likely]
    theta = posterior.theta[np.ix_(which == likely, columns)]
    given = weight[which == likely] / share[likely]
    mean, sd = np.full((2, len(experiment.names)), np.nan)
    mean[columns] = given @ theta
    sd[columns] = np.sqrt(given @ (theta - mean[columns]) ** 2)
    return mean, sd, dict(zip(experiment.shape.labels, (float(p) for p in share / share.sum()), strict=True))


def _fit(experiment: Experiment, posterior: NestedResult, problem: SensorProblem) -> tuple[float, int]:
    """How well the best hypothesis fits: upper tail of chi-square, and the reading it explains worst."""
    recording = problem.recording
    best = posterior.best()[None, :]
    z = (recording.readings - problem.model.predict(best, recording.plan)[0]) / experiment.noise_sd
    z = np.where(recording.usable, z, 0.0)
    return float(chi2.sf(float(z @ z), max(int(recording.usable.sum()), 1))), int(np.argmax(np.abs(z)))


def _belief(info: Step, next_pose: Pose) -> Belief:
    known = [(n, float(m), float(s)) for n, m, s in zip(info.names, info.mean, info.sd, strict=True) if np.isfinite(m)]
    return Belief({n: m for n, m, _ in known}, {n: s for n, _, s in known}, info.bits, next_pose)
