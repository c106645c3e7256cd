"""The loop of a run: measure, infer, judge, inquire, until the target sd is reached (paper, sections 2.2, 2.3).

`step` processes one reading; `explore` is the loop around it, a generator, so that the command line, notebooks and
reports see the same steps. `run_from_place` and `shadow_run` are the same loop from a given first place, and on the
readings of another run.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, own_arithmetic
from probewise._kinds import checked_path, checked_whole, require_kind, require_rng
from probewise.arm.carry_out import covariates_with_height
from probewise.arm.instrument import Instrument, Pose, Reading
from probewise.arm.own import Measures, as_instrument, require_measures
from probewise.errors import DoubtfulResultWarning, FileError, LinkError, ParameterError, require, shown, warn
from probewise.experiment.inquire import (
    ArmReachAndTravel,
    inquire,
    leaves_far_side,
    must_continue,
    next_poses,
    predict_readings_and_utilities,
)
from probewise.experiment.journal import (
    Journal,
    JournalWriter,
    PosteriorSummary,
    read_journal,
    require_same_settings,
)
from probewise.experiment.judgement import (
    MOST_MISSING,
    information_nats,
    judge,
    n_missing_at_end,
    sensor_moments,
    stop_reason,
    target_reached_and_chance_off,
    with_aligned_angles,
    with_arm_error,
)
from probewise.experiment.kinds import PosteriorByKind, prior_posterior
from probewise.experiment.result import Exploration, Step
from probewise.experiment.rivals import Pace
from probewise.experiment.setup import Experiment
from probewise.inquiry import bits_gained, prior_entropy
from probewise.nested import Weighted
from probewise.recordings.plan import Recording
from probewise.sensor.commanded import height_ratio, led_state

_HEIGHT_TOLERANCE = 0.01  # share of the calibrated height, which changes the signal by 2 %


@dataclass(frozen=True, eq=False)
class ExplorationState:
    """The current state of a run.

    `readings` so far, their posterior `by_kind`, the next pose, and the poses `planned` after it in a batch; the arm's
    reach, and the differential entropy of the prior in bits.
    """

    readings: tuple[Reading, ...]
    by_kind: PosteriorByKind
    next_pose: Pose
    planned: tuple[Pose, ...]
    reach: ArmReachAndTravel
    prior_bits: float


@own_arithmetic
def begin(experiment: Experiment, instrument: Instrument, *, rng: np.random.Generator) -> ExplorationState:
    """Return the state before the first reading: draws from the prior, and the pose with the largest utility.

    ReachError if the instrument, already entered, reaches no place; ParameterError if the prior has no mass, or no
    place is more informative than others.
    """
    reach = ArmReachAndTravel.from_instrument(instrument, experiment.grid)
    prior_bits = prior_entropy(experiment.prior, rng=rng)
    by_kind = prior_posterior(experiment.kinds, experiment.n_particles, rng=rng)
    joined = by_kind.joined(rng=rng)
    drawn = joined.samples(experiment.n_samples, rng=rng)
    inputs, utilities = predict_readings_and_utilities(experiment, joined, drawn, reach, at=None, goal=experiment.goal)
    allowed = (
        "one that differs between places: as it is, no reading within reach is expected to tell anything; "
        "does the field hold the shape's prior, and can the sensor tell the shape from its surroundings?"
    )
    require(not utilities.is_flat, "utility", f"{utilities.highest_utility:g} everywhere", allowed)
    pose, *planned = next_poses(experiment, inputs, utilities, rng=rng)
    return ExplorationState((), by_kind, pose, tuple(planned), reach, prior_bits)


@own_arithmetic
def step(
    state: ExplorationState,
    reading: Reading,
    experiment: Experiment,
    *,
    rng: np.random.Generator,
    max_readings: int | None = None,
    max_missing: int | None = MOST_MISSING,
) -> tuple[ExplorationState, Step]:
    """Update the posterior with one reading, and choose the next.

    The run ends at `max_readings` readings, or `max_missing` missing ones (NaN) in a row; None: no limit.
    ParameterError if the reading is outside the sensor's range; NotConvergedError if no hypothesis could have given it.
    """
    experiment.readout.require_in_range(reading.value)
    readings = (*state.readings, reading)
    n_readings, n_missing = len(readings), n_missing_at_end(readings)
    recording = experiment.problem(readings).recording
    by_kind, joined, posterior, drawn = infer(experiment, state, recording, readings, rng=rng)
    judged = judge(experiment, by_kind, posterior, readings, rng=rng)
    inputs, utilities = inquire(experiment, by_kind, posterior, drawn, judged, state.reach, readings, rng=rng)
    all_missing = max_missing is not None and n_missing >= max_missing
    all_taken = max_readings is not None and n_readings >= max_readings
    checks = must_continue(utilities, by_kind) and not all_taken
    if judged.arm_error is None and (utilities.is_flat or all_missing or all_taken):
        judged = with_arm_error(judged, experiment, by_kind, posterior, readings, rng=rng)
    reason = stop_reason(
        experiment,
        judged,
        utilities,
        must_continue=checks,
        n_readings=n_readings,
        max_readings=max_readings,
        n_missing=n_missing if all_missing else 0,
    )
    # A reading for which the run goes on, though the shape is known, is not one of those planned before. Nor is one
    # after a missing reading, since those planned may be at the same place.
    planned_before = () if checks or n_missing else state.planned
    pose, *planned = planned_before or next_poses(experiment, inputs, utilities, readings, rng=rng)
    log_prior = experiment.prior.log_prob(joined.theta)
    info = Step(
        **vars(judged),
        number=n_readings,
        reading=reading,
        names=experiment.shape.prior.names,
        samples=inputs.drawn[:, experiment.shape_columns],
        map=utilities,
        next_pose=None if reason else pose,
        bits=bits_gained(information_nats(joined), log_prior, joined.weight, state.prior_bits),
        posterior=posterior,
        sensor=sensor_moments(experiment, posterior),
        by_kind=by_kind,
        stop_reason=reason,
        pace=Pace.from_readings(readings),
        checks_sensor=judged.target_reached and checks,
    )
    return replace(state, readings=readings, by_kind=by_kind, next_pose=pose, planned=tuple(planned)), info


def infer(
    experiment: Experiment,
    state: ExplorationState,
    recording: Recording,
    readings: tuple[Reading, ...],
    *,
    rng: np.random.Generator,
) -> tuple[PosteriorByKind, Weighted, Weighted, FloatArray]:
    """Update the posterior with the last of the readings; before the run may end, reconsider it.

    Returns
    -------
    The posterior by kind; its samples joined, with raised odds of left-out effects; the same with aligned angles; and a
    few hypotheses drawn from it, (n_samples, n_params).
    """
    method = experiment.inference_method
    with warnings.catch_warnings():
        # Each step keeps its own notes; a warning per reading would hide them.
        warnings.simplefilter("ignore", DoubtfulResultWarning)
        by_kind = method.updated(state.by_kind, recording, rng=rng)
    joined = by_kind.with_raised_left_out_odds().joined(rng=rng)
    posterior = with_aligned_angles(experiment, joined)
    # A few kinds at a time: as soon as the target is missed, the others can wait.
    while target_reached_and_chance_off(experiment, posterior)[0] and not leaves_far_side(
        experiment, posterior, state.reach, readings
    ):
        before, by_kind = by_kind, method.reconsidered(by_kind, recording, rng=rng)
        if by_kind is before:
            break
        joined = by_kind.with_raised_left_out_odds().joined(rng=rng)
        posterior = with_aligned_angles(experiment, joined)
    return by_kind, joined, posterior, method.drawn(by_kind, posterior, recording, experiment.n_samples, rng=rng)


def explore(
    instrument: Instrument | Measures,
    experiment: Experiment,
    *,
    rng: np.random.Generator,
    max_readings: int = 100,
    journal: str | Path | Journal | None = None,
    about: Mapping[str, Any] | None = None,
) -> Generator[Step, None, None]:
    """Let the robot find the shape: yield one `Step` per reading until the target sd is reached (paper, section 2.3).

    `Exploration(experiment, tuple(explore(...)))` is the whole run. A generator that is not exhausted keeps its journal
    locked until the generator is closed. A `DoubtfulResultWarning` says once, and the notes of every step after that
    too, if the arm reads at another height than that of the sensor's calibration, without `heights_mm`.

    Parameters
    ----------
    instrument
        The instrument, already entered (`with arm:`), or your own object with `measure(pose)`, see
        `probewise.arm.as_instrument`.
    rng
        Generator whose seed sequence gives the run's seed, as a child; each reading's seed is a child of that. So one
        seed determines the whole run, and a resumed run continues bit for bit as if it had not been interrupted.
    journal
        File with one JSON line per measurement. If it exists, the run resumes: its readings are taken from the journal
        instead of the instrument, and their steps are yielded again with `replayed` set. A simulated instrument must be
        in the state after the last of them: read the journal, place the instrument, and pass the journal as read.
    about
        Further entries of the journal's first line, such as the sensor and the hidden shape of a simulated field; a
        resumed run must agree with them (except for names of arm and file, see `require_same_settings`).

    Raises
    ------
    ReachError, NotConvergedError
        If no place of the grid is reachable; if no hypothesis could have given the readings.
    FileError
        If the journal is damaged, belongs to a run with other settings, or is written to by another process.
    ParameterError
        If the journal holds more than `max_readings` readings, no place is more informative than others, or the
        instrument does not declare that it can turn or lift its sensor as the experiment may choose.
    LinkError
        If the instrument fails, or returns a reading out of range, or with an impossible `led` or `height_mm`.
    """
    require_measures("instrument", instrument)
    require_kind("experiment", experiment, Experiment, "an Experiment, such as experiment_for(...) poses")
    require_rng(rng)
    checked_whole("max_readings", max_readings)
    # Another seed at each call, whatever was drawn in between.
    seed = rng.bit_generator.seed_seq
    if not isinstance(seed, np.random.SeedSequence):
        seed = np.random.SeedSequence([int(word) for word in rng.integers(2**32, size=4)])
    seed = seed.spawn(1)[0]
    path = None if journal is None else checked_path("journal", getattr(journal, "path", journal))
    before = journal if isinstance(journal, Journal) else None
    if before is None and path is not None and path.exists():
        before = read_journal(path)
    settings = {} if path is None else experiment.settings(seed) | dict(about or {})  # settings may lack a name
    start_s = 0.0
    if before is not None:
        require_same_settings(before, settings)
        key = before.settings.get("spawn_key")
        if not isinstance(key, list) or not all(isinstance(word, int) and word >= 0 for word in key):
            allowed = "a list of whole numbers, as explore writes it"
            raise FileError(before.path, f"spawn_key is {shown(key)}", allowed, row=1)
        seed = np.random.SeedSequence(seed.entropy, spawn_key=tuple(key))
        n = len(before.entries)
        require(n <= max_readings, "max_readings", max_readings, f"the {n} readings the journal holds, or more")
        start_s = before.readings[-1].time_s if before.entries else 0.0
    instrument = as_instrument(instrument, start_s=start_s)
    return _yield_steps(instrument, experiment, seed, max_readings, path=path, before=before, settings=settings)


def _yield_steps(
    instrument: Instrument,
    experiment: Experiment,
    seed: np.random.SeedSequence,
    max_readings: int,
    *,
    path: Path | None,
    before: Journal | None,
    settings: Mapping[str, Any],
) -> Generator[Step, None, None]:
    """Yield the steps: those of the journal `before`, then those of new readings, which are written to `path`."""
    _require_turns_and_lifts(instrument, experiment)
    replayed, notes = ((), ()) if before is None else (before.entries, before.notes)
    # Before the journal is created: a run that cannot begin leaves none.
    state = begin(experiment, instrument, rng=_rng_of_reading(seed, 0))
    doubt = _doubt_about_height(experiment, getattr(instrument, "read_height_mm", None))
    if doubt is not None:
        warn(doubt, DoubtfulResultWarning)
    opened: contextlib.AbstractContextManager[JournalWriter | None] = contextlib.nullcontext()
    if before is not None:
        opened = JournalWriter.resume(before)
    elif path is not None:
        opened = JournalWriter.begin(path, settings)
    with opened as writer:
        stopped = False
        while not stopped:
            number = len(state.readings) + 1
            entry = replayed[number - 1] if number <= len(replayed) else None
            reading = instrument.measure(state.next_pose) if entry is None else entry.reading
            journal = None if entry is None else before
            _require_possible_reading(experiment, reading, journal, number)  # before it is written, or resuming fails
            if writer is not None and entry is None:
                writer.write_reading(number, reading)
            height_mm = covariates_with_height(reading).get("height_mm")  # NaN: missing
            if doubt is None and (doubt := _doubt_about_height(experiment, height_mm)) is not None:
                warn(doubt, DoubtfulResultWarning)
            state, info = step(
                state,
                reading,
                experiment,
                rng=_rng_of_reading(seed, number),
                max_readings=max_readings,
                # A run that ended for want of values goes on when it is resumed, with the instrument mended.
                max_missing=MOST_MISSING if entry is None else None,
            )
            if writer is not None and (entry is None or entry.summary is None):
                writer.write_summary(_posterior_summary(info, state))
            if entry is not None and entry.summary is not None:
                # The journal's pose is used, even if another machine's arithmetic would choose another.
                state = replace(state, next_pose=entry.summary.next_pose)
            of_run = (*(notes if number == 1 else ()), *(() if doubt is None else (doubt,)))
            stopped = info.stop_reason is not None
            yield replace(info, replayed=entry is not None, notes=(*info.notes, *of_run))


def _require_turns_and_lifts(instrument: Instrument, experiment: Experiment) -> None:
    """Check that an instrument, already entered, can take the orientations and heights that may be chosen.

    An instrument that takes a pose's orientation and height without following it would record readings wrongly; so it
    has to declare `turns` and `lifts`. A single height needs no `lifts` if the instrument reads at that height.
    """
    undeclared = "none with an instrument that does not declare that it can {} = True"
    turns_rad, heights_mm = experiment.orientations_rad, experiment.heights_mm
    if turns_rad != (0.0,) and not getattr(instrument, "turns", False):
        allowed = undeclared.format("turn its sensor to pose.orientation_rad: turns")
        raise ParameterError("orientations_rad (--orientations)", turns_rad, allowed)
    own_mm = getattr(instrument, "read_height_mm", None)
    if set(heights_mm) - {own_mm} and not getattr(instrument, "lifts", False):
        allowed = undeclared.format("read at pose.height_mm: lifts")
        raise ParameterError("heights_mm (--heights)", heights_mm, allowed)


def _doubt_about_height(experiment: Experiment, height_mm: float | None) -> str | None:
    """Describe why a run with readings at this height is doubtful; None if it is not, or either height is not known.

    Readings at heights that may be chosen (`Experiment.heights_mm`) count as what they are. Without them, every reading
    counts as one at the calibrated height: at another, the footprint is wider or narrower and the signal weaker or
    stronger than modelled, and the shape wrong.
    """
    calibrated_mm = experiment.calibrated_height_mm
    if experiment.heights_mm or calibrated_mm is None or height_mm is None:
        return None
    if not abs(height_mm - calibrated_mm) > _HEIGHT_TOLERANCE * calibrated_mm:  # NaN: the height is not known
        return None
    return (
        f"the arm reads {height_mm:g} mm above the surface, and the sensor was calibrated at {calibrated_mm:g} mm: "
        f"every reading counts as one at {calibrated_mm:g} mm, so the shape may be wrong by more than its sds; "
        f"calibrate the sensor at {height_mm:g} mm, or name the height (heights_mm, --heights {height_mm:g})"
    )


def _require_possible_reading(experiment: Experiment, reading: Reading, journal: Journal | None, number: int) -> None:
    """Raise LinkError for a value, LED or height out of range: the instrument is at fault, and the run can be resumed.

    FileError for one that the `journal` holds: it was changed.
    """
    try:
        experiment.readout.require_in_range(reading.value)
        plan = experiment.problem([reading]).recording.plan
        led_state(plan)  # these two refuse what is out of range
        height_ratio(plan)
    except ParameterError as error:
        if journal is not None:
            raise FileError(journal.path, f"{error.name} is {error.value}", error.allowed, row=number + 1) from error
        raise LinkError(f"what the instrument returned is beyond the sensor: {error}") from error


def _rng_of_reading(seed: np.random.SeedSequence, number: int) -> np.random.Generator:
    """Return the random generator for reading `number`, from 1 (0: before the first)."""
    return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, number)))


def _posterior_summary(info: Step, state: ExplorationState) -> PosteriorSummary:
    known = {n: (float(m), float(s)) for n, m, s in zip(info.names, info.mean, info.sd, strict=True) if np.isfinite(m)}
    known |= info.sensor
    mean, sd = ({name: both[k] for name, both in known.items()} for k in (0, 1))
    return PosteriorSummary(mean, sd, info.bits, state.next_pose)


def run_from_place(
    first: Pose, instrument: Instrument, experiment: Experiment, *, rng: np.random.Generator, max_readings: int
) -> Exploration:
    """Run the loop from a given first place, so that two robots with the same first reading can be compared.

    The instrument, already entered, has to reach that place; `rng` is the generator of the whole run. Errors are those
    of `explore`.
    """
    state = replace(begin(experiment, instrument, rng=rng), next_pose=first, planned=())
    steps: list[Step] = []
    while not steps or steps[-1].stop_reason is None:
        reading = instrument.measure(state.next_pose)
        state, info = step(state, reading, experiment, rng=rng, max_readings=max_readings)
        steps.append(info)
    return Exploration(experiment, tuple(steps))


def shadow_run(
    steps: Iterable[Step], other: Experiment, instrument: Instrument, *, rng: np.random.Generator
) -> Iterator[tuple[Step, Step]]:
    """Yield each step of a run, as it arrives, with another experiment's step from the same reading.

    `other` is the same experiment with another sensor model; its own choices of readings are not carried out. `rng` is
    the generator of its inference; the run has its own.
    """
    state = begin(other, instrument, rng=rng)
    for own in steps:
        state, info = step(replace(state, planned=()), own.reading, other, rng=rng)
        yield own, info
