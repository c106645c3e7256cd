"""The loop of a run: measure, infer, inquire, until the target precision is reached (paper, machine learning system).

`step` processes one reading; `explore` is the loop around it, a generator, so that the command line, notebooks and
reports see the same steps; `run` collects them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import warnings
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from probewise._arrays import own_arithmetic
from probewise._kinds import checked_path, checked_whole, require_callable, require_kind, require_rng
from probewise.arm.instrument import Instrument, Reading
from probewise.arm.own import Measures, as_instrument, require_measures
from probewise.errors import DoubtfulResultWarning, FileError, LinkError, ParameterError, shown
from probewise.experiment.acquisition import ArmReachAndTravel, next_poses, predict_readings_and_utilities
from probewise.experiment.aligned_angles import with_aligned_angles
from probewise.experiment.arm_abilities import require_turns_and_lifts
from probewise.experiment.arm_error import arm_error_in_posterior, draw_shape_shifts_from_arm_error
from probewise.experiment.configuration import Experiment, largest_sd_mm
from probewise.experiment.hidden import HiddenShape
from probewise.experiment.journal import (
    Journal,
    JournalWriter,
    PosteriorSummary,
    read_journal,
    require_same_settings,
)
from probewise.experiment.missing_readings import MOST_MISSING, n_missing_at_end
from probewise.experiment.pace import Pace
from probewise.experiment.posterior import Posterior, prior_posterior
from probewise.experiment.reading_height import doubt_about_height, height_of_reading_mm
from probewise.experiment.state import ArmError, Exploration, ExplorationState, Step
from probewise.experiment.stopping_rule import (
    OFF_SDS,
    doubt_message,
    information_nats,
    p_value_and_worst_reading,
    probability_of_length_off,
    sensor_moments,
    shape_moments_and_probabilities,
    stop_reason,
)
from probewise.experiment.utility_near_end import utility_map_and_must_continue
from probewise.inquiry import Goal, bits_gained, prior_entropy
from probewise.nested import Weighted
from probewise.sensor.commanded import require_possible_commands


@own_arithmetic
def begin(experiment: Experiment, field: ArmReachAndTravel, *, rng: np.random.Generator) -> ExplorationState:
    """Return the state before the first reading: draws from the prior, and the pose with the largest utility.

    Parameters
    ----------
    experiment
        The experiment.
    field
        Reach of the arm, and travel times.
    rng
        Source of randomness.

    Raises
    ------
    ReachError
        If no place is reachable.
    ParameterError
        If the prior has no mass, or no place is more informative than others.
    """
    posterior = prior_posterior(experiment.kinds, experiment.n_particles, rng=rng)
    joined = posterior.joined(rng=rng)
    drawn = joined.samples(experiment.n_samples, rng=rng)
    utility_input, utilities = predict_readings_and_utilities(experiment, joined, drawn, field, at=None)
    if utilities.is_flat:
        raise ParameterError(
            "utility",
            f"{utilities.highest_utility:g} everywhere",
            "one that differs between places: as it is, no reading within reach is expected to tell anything; "
            "does the field hold the shape's prior, and can the sensor tell the shape from its surroundings?",
        )
    pose, *planned = next_poses(experiment, utility_input, utilities, rng=rng)
    return ExplorationState((), posterior, pose, tuple(planned))


@own_arithmetic
def step(
    state: ExplorationState,
    reading: Reading,
    experiment: Experiment,
    field: ArmReachAndTravel,
    *,
    prior_bits: float,
    rng: np.random.Generator,
    max_readings: int | None = None,
    max_missing: int | None = MOST_MISSING,
) -> tuple[ExplorationState, Step]:
    """Update the posterior with one reading, and choose the next.

    Parameters
    ----------
    state
        The readings so far and the posterior given them.
    reading
        The new reading.
    experiment, field
        See `begin`.
    prior_bits
        Differential entropy of the prior, see `inquiry.prior_entropy`.
    rng
        Random generator of this step.
    max_readings
        Number of readings at which the run ends; None: no limit.
    max_missing
        Number of missing readings (NaN) in a row at which the run ends; None: no limit.

    Returns
    -------
    The state after the reading, with the next pose; and the result of this step.

    Raises
    ------
    ParameterError
        If the reading is outside the sensor's range.
    NotConvergedError
        If no hypothesis could have given these readings.
    """
    experiment.readout.require_in_range(reading.value)
    readings = (*state.readings, reading)
    problem = experiment.problem(readings)
    with warnings.catch_warnings():
        # Each step keeps its own notes; a warning per reading would hide them.
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        carried = experiment.inference_method.updated(state.posterior, problem.recording, rng=rng)
    wary, joined, posterior = _wary_kinds_and_posterior(experiment, carried, rng)
    if _may_stop_and_chance_off(experiment, posterior, None, "", rng)[0]:
        carried = experiment.inference_method.reconsidered(carried, problem.recording, rng=rng)
        wary, joined, posterior = _wary_kinds_and_posterior(experiment, carried, rng)
    mean, sd, shapes = shape_moments_and_probabilities(experiment, posterior)
    leader = carried.kinds[carried.most_probable_kind_index]
    p_value, notes = None, () if posterior.run is None else posterior.run.warnings
    if leader.likelihood is experiment.likelihood:  # chi-square is of this noise
        p_value, worst = p_value_and_worst_reading(
            experiment, carried.particles[carried.most_probable_kind_index].weighted, leader.problem(problem.recording)
        )
        if experiment.fit_is_doubtful(p_value):
            notes = (*notes, doubt_message(p_value, worst, readings))
    drawn = experiment.inference_method.drawn(carried, posterior, problem.recording, experiment.n_samples, rng=rng)
    likely = max(shapes, key=shapes.__getitem__, default="")

    def error_of_arm() -> ArmError | None:
        if experiment.fitted_arm is None:
            return None
        of = (experiment, experiment.fitted_arm, readings, posterior, wary)
        return arm_error_in_posterior(*of, mean=mean, sd=sd, likely_shape=likely, rng=rng)

    arm = error_of_arm() if largest_sd_mm(experiment.shape.prior.names, sd) < experiment.stop_sd_mm else None
    known, off = _may_stop_and_chance_off(experiment, posterior, arm, likely, rng)
    utility_input, utilities = predict_readings_and_utilities(
        experiment, posterior, drawn, field, at=reading, goal=_goal_less_arm_error(experiment, arm)
    )
    asks = False
    if experiment.trust < 1:
        utilities, asks = utility_map_and_must_continue(
            experiment, wary, utility_input, utilities, readings, rng=rng, known=known
        )
        asks = asks and (max_readings is None or len(readings) < max_readings)
    n_missing = n_missing_at_end(readings)
    all_missing = max_missing is not None and n_missing >= max_missing
    all_taken = max_readings is not None and len(readings) >= max_readings
    if arm is None and (utilities.is_flat or all_missing or all_taken):
        arm = error_of_arm()
        known, off = _may_stop_and_chance_off(experiment, posterior, arm, likely, rng)
    arm_sd = None if arm is None else arm.sd
    reason = stop_reason(
        experiment,
        sd,
        known=known and not asks,
        p_value=p_value,
        utilities=utilities,
        n_readings=len(readings),
        max_readings=max_readings,
        arm_sd=arm_sd,
        n_missing=n_missing if all_missing else 0,
    )
    # A reading for which the run goes on, though the shape is known, is not one of those planned before. Nor is one
    # after a missing reading, since those planned may be at the same place.
    planned_before = () if asks or n_missing else state.planned
    pose, *planned = planned_before or next_poses(experiment, utility_input, utilities, readings, rng=rng)
    info = Step(
        number=len(readings),
        reading=reading,
        names=experiment.shape.prior.names,
        mean=mean,
        sd=sd,
        shapes=shapes,
        samples=utility_input.drawn[:, experiment.shape_columns],
        map=utilities,
        next_pose=None if reason else pose,
        bits=bits_gained(information_nats(joined), problem.prior.log_prob(joined.theta), joined.weight, prior_bits),
        p_value=p_value,
        posterior=posterior,
        sensor=sensor_moments(experiment, posterior),
        left_out=carried.left_out,
        kinds=carried,
        chance_off=off,
        stop_reason=reason,
        notes=notes,
        pace=Pace.from_readings(readings),
        arm_error=arm,
        checks_sensor=known and asks,
    )
    return ExplorationState(readings, carried, pose, tuple(planned)), info


def _wary_kinds_and_posterior(
    experiment: Experiment, carried: Posterior, rng: np.random.Generator
) -> tuple[Posterior, Weighted, Weighted]:
    """Return the kinds with raised fault odds, their samples as one posterior, and the latter with aligned angles."""
    wary = carried.with_raised_fault_odds
    joined = wary.joined(rng=rng)
    return wary, joined, with_aligned_angles(experiment, joined)


def _goal_less_arm_error(experiment: Experiment, arm: ArmError | None) -> Goal | None:
    """Return the goal for the readings alone, the target variance less the arm's; None stands for the usual goal."""
    goal = experiment.goal
    if arm is None or goal is None:
        return None
    lengths = np.array(goal.columns) - experiment.shape_columns[0]
    left = goal.sd**2 - float(arm.sd[lengths].max()) ** 2
    return dataclasses.replace(goal, sd=math.sqrt(left)) if left > 0 else None


def _may_stop_and_chance_off(
    experiment: Experiment, posterior: Weighted, arm: ArmError | None, likely: str, rng: np.random.Generator
) -> tuple[bool, float]:
    """Return whether a posterior with the arm's error meets the stopping rule, and its `probability_of_length_off`."""
    _, sd, shapes = shape_moments_and_probabilities(experiment, posterior)
    if arm is not None:
        sd = np.hypot(sd, arm.sd)
        theta = posterior.theta.copy()
        own = theta[:, experiment.shape_columns]
        theta[:, experiment.shape_columns] = own + draw_shape_shifts_from_arm_error(
            experiment, arm.slopes, own, likely, rng=rng
        )
        posterior = dataclasses.replace(posterior, theta=theta)
    off = probability_of_length_off(experiment, posterior, OFF_SDS * experiment.stop_sd_mm)
    return experiment.may_stop(sd, shapes, off), off


def explore(
    instrument: Instrument | Measures,
    experiment: Experiment,
    *,
    rng: np.random.Generator,
    max_readings: int = 100,
    journal: str | Path | Journal | None = None,
    about: Mapping[str, Any] | None = None,
) -> Generator[Step, None, None]:
    """Let the robot find the shape: yield one `Step` per reading until the target precision (paper, section 2).

    A generator that is not exhausted keeps its journal locked until the generator is closed.

    Parameters
    ----------
    instrument
        The instrument, already entered (`with arm:`), or your own object with `measure(pose)`, see
        `probewise.arm.as_instrument`.
    experiment
        The experiment: shape, sensor model, stopping rule.
    rng
        Generator whose seed sequence gives the run's seed, as a child; each reading's seed is a child of that. So one
        seed determines the whole run, and a resumed run continues bit for bit as if it had not been interrupted.
    max_readings
        Largest number of readings.
    journal
        File with one JSON line per measurement. If it exists, the run resumes: its readings are taken from the journal
        instead of the instrument, and their steps are yielded again with `replayed` set. A simulated instrument must be
        in the state after the last of them: read the journal, place the instrument, and pass the journal as read.
        Missing folders are created.
    about
        Further entries of the journal's first line, such as the sensor and the hidden shape of a simulated field; a
        resumed run must agree with them (except for names of arm and file, see `require_same_settings`).

    Raises
    ------
    ReachError
        If no place of the grid is reachable.
    FileError
        If the journal is damaged, belongs to a run with other settings, or is written to by another process.
    ParameterError
        If the journal holds more than `max_readings` readings, no place is more informative than others, or the
        instrument does not declare that it can turn or lift its sensor as the experiment may choose.
    NotConvergedError
        If no hypothesis could have given the readings.
    LinkError
        If the instrument fails, or returns a reading out of range, or with an impossible `led` or `height_mm`.

    Warns
    -----
    DoubtfulResultWarning
        Once, if the arm reads at another height than that of the sensor's calibration, without `heights_mm`; the notes
        of every step after that say so too.
    """
    require_measures("instrument", instrument)
    require_kind("experiment", experiment, Experiment, "an Experiment, such as experiment_for(...) poses")
    require_rng(rng)
    checked_whole("max_readings", max_readings)
    seed = _run_seed(rng)
    path = None if journal is None else checked_path("journal", getattr(journal, "path", journal))
    before = journal if isinstance(journal, Journal) else None
    if before is None and path is not None and path.exists():
        before = read_journal(path)
    settings = {} if path is None else experiment.settings(seed) | dict(about or {})  # settings may lack a name
    if before is not None:
        require_same_settings(before, settings)
        seed = _seed_of_journal(before, seed)
        if len(before.entries) > max_readings:
            raise ParameterError(
                "max_readings", max_readings, f"the {len(before.entries)} readings the journal holds, or more"
            )
    start_s = before.readings[-1].time_s if before is not None and before.entries else 0.0
    instrument = as_instrument(instrument, start_s=start_s)
    return _yield_steps(
        instrument, experiment, seed=seed, max_readings=max_readings, path=path, before=before, settings=settings
    )


@own_arithmetic
def run(
    instrument: Instrument | Measures,
    experiment: Experiment,
    *,
    rng: np.random.Generator,
    max_readings: int = 100,
    journal: str | Path | Journal | None = None,
    progress: Callable[[Step], None] | None = None,
    hidden: HiddenShape | None = None,
    about: Mapping[str, Any] | None = None,
) -> Exploration:
    """Run `explore` to its end and collect the steps; `progress` is called with each step.

    `hidden` is the true shape of a simulated field, for reports and the journal; the inference does not use that shape.
    """
    if progress is not None:
        require_callable("progress", progress, "a function that is called with every Step, or None")
    if hidden is not None:
        require_kind("hidden", hidden, HiddenShape, "a HiddenShape: what a simulated field holds; or None")
        about = {**(about or {}), "hidden": hidden.journal_entry}
    steps = []
    for info in explore(instrument, experiment, rng=rng, max_readings=max_readings, journal=journal, about=about):
        if progress is not None:
            progress(info)
        steps.append(info)
    return Exploration(experiment, tuple(steps), hidden)


def _yield_steps(
    instrument: Instrument,
    experiment: Experiment,
    seed: np.random.SeedSequence,
    max_readings: int,
    path: Path | None,
    before: Journal | None,
    settings: Mapping[str, Any],
) -> Generator[Step, None, None]:
    """Yield the steps: those of the journal `before`, then those of new readings, which are written to `path`."""
    require_turns_and_lifts(instrument, experiment)
    replayed, notes = ((), ()) if before is None else (before.entries, before.notes)
    field = ArmReachAndTravel.from_instrument(instrument, experiment.grid)
    first = _rng_of_reading(seed, 0)
    prior_bits = prior_entropy(experiment.prior, rng=first)
    state = begin(experiment, field, rng=first)  # before the journal is created: a run that cannot begin leaves none
    doubt = doubt_about_height(experiment, getattr(instrument, "read_height_mm", None))
    if doubt is not None:
        warnings.warn(doubt, DoubtfulResultWarning, stacklevel=2)
    with _journal_writer(path, before, settings) as writer:
        stopped = False
        while not stopped:
            number = len(state.readings) + 1
            entry = replayed[number - 1] if number <= len(replayed) else None
            reading = instrument.measure(state.next_pose) if entry is None else entry.reading
            _require_possible_reading(experiment, reading)  # before it is written, or a resumed run fails again
            if writer is not None and entry is None:
                writer.write_reading(number, reading)
            if doubt is None and (doubt := doubt_about_height(experiment, height_of_reading_mm(reading))) is not None:
                warnings.warn(doubt, DoubtfulResultWarning, stacklevel=2)
            state, info = step(
                state,
                reading,
                experiment,
                field,
                prior_bits=prior_bits,
                rng=_rng_of_reading(seed, number),
                max_readings=max_readings,
                # A run that ended for want of values goes on when it is resumed, with the instrument mended.
                max_missing=MOST_MISSING if entry is None else None,
            )
            if writer is not None and (entry is None or entry.summary is None):
                writer.write_summary(_posterior_summary(info, state))
            if entry is not None:
                info = dataclasses.replace(info, replayed=True)
                # The journal's pose is used, even if another machine's arithmetic would choose another.
                if entry.summary is not None:
                    state = dataclasses.replace(state, next_pose=entry.summary.next_pose)
            if number == 1 and notes:
                info = dataclasses.replace(info, notes=(*info.notes, *notes))
            if doubt is not None:
                info = dataclasses.replace(info, notes=(*info.notes, doubt))
            stopped = info.stop_reason is not None
            yield info


def _require_possible_reading(experiment: Experiment, reading: Reading) -> None:
    """Raise LinkError for a value, LED or height out of range: the instrument is at fault; the run can be resumed."""
    try:
        experiment.readout.require_in_range(reading.value)
        require_possible_commands(experiment.problem([reading]).recording.plan)
    except ParameterError as error:
        raise LinkError(f"what the instrument returned is beyond the sensor: {error}") from error


def _journal_writer(
    path: Path | None, before: Journal | None, settings: Mapping[str, Any]
) -> contextlib.AbstractContextManager[JournalWriter | None]:
    if before is not None:
        return JournalWriter.resume(before)
    return contextlib.nullcontext() if path is None else JournalWriter.begin(path, settings)


def _run_seed(rng: np.random.Generator) -> np.random.SeedSequence:
    """Spawn a run's seed from the generator's seed sequence: another at each call, whatever was drawn in between."""
    seed = rng.bit_generator.seed_seq
    if not isinstance(seed, np.random.SeedSequence):
        seed = np.random.SeedSequence([int(word) for word in rng.integers(2**32, size=4)])
    return seed.spawn(1)[0]


def _seed_of_journal(journal: Journal, seed: np.random.SeedSequence) -> np.random.SeedSequence:
    """Return the seed of a journal's run, a child of the same parent as `seed`; FileError if the journal has none."""
    key = journal.settings.get("spawn_key")
    if not isinstance(key, list) or not all(isinstance(word, int) and word >= 0 for word in key):
        allowed = "a list of whole numbers, as explore writes it"
        raise FileError(journal.path, f"spawn_key is {shown(key)}", allowed, row=1)
    return np.random.SeedSequence(seed.entropy, spawn_key=tuple(key))


def _rng_of_reading(seed: np.random.SeedSequence, number: int) -> np.random.Generator:
    """Return the random generator for reading `number`, from 1 (0: before the first)."""
    return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, number)))


def _posterior_summary(info: Step, state: ExplorationState) -> PosteriorSummary:
    known = [(n, float(m), float(s)) for n, m, s in zip(info.names, info.mean, info.sd, strict=True) if np.isfinite(m)]
    known += [(name, mean, sd) for name, (mean, sd) in info.sensor.items()]
    return PosteriorSummary({n: m for n, m, _ in known}, {n: s for n, _, s in known}, info.bits, state.next_pose)
