"""The main commands of the command line as Python functions, with the same names and defaults.

Everywhere `rng` is the source of randomness: `np.random.default_rng(seed)` gives the result of the command with
`--seed`; and `progress` whether to show a bar in a terminal or notebook, or your own function (`probewise.progress`).
Each function's See Also names the version with every option. Heavy imports happen inside the functions, so that
`import probewise` and `probewise --help` are quick.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast, get_args

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from probewise import scene
    from probewise.arm import Instrument, Measures
    from probewise.calibration import Calibration, FittedSensor
    from probewise.diagnosis import Diagnosis, PlanAudit, SystemFit
    from probewise.experiment import Exploration, MethodName, ModelName, Step, Truth
    from probewise.inference import Naive
    from probewise.inquiry import Utility
    from probewise.nested import NestedStop
    from probewise.progress import Progress
    from probewise.recordings import Plan, Prediction, Recording
    from probewise.scene import Shape
    from probewise.systems import FittedSystem, RunTable, Simulator, SystemPrediction

    Table: TypeAlias = RunTable | Mapping[str, Any]
    AnySimulator: TypeAlias = Simulator | str | Path

__all__ = ["audit", "calibrate", "diagnose", "explore", "fit", "predict"]

# Defaults of the command line and of the functions below.
DEFAULT_SEED = 2013  # year of the paper; printed with every run
ORDERS = (1, 2, 3, 4)
N_LIVE = 300
CalibrationMethod: TypeAlias = Literal["quick", "full", "paper"]
CALIBRATION: CalibrationMethod = "quick"
SHAPE = "circle"
SHAPES = ("circle", "ellipse", "rectangle", "triangle", "hexagon")  # those of `scene.SHAPES`, without its imports
MODEL: ModelName = "ssf"
METHOD: MethodName = "particles"
UTILITY = "finishing"
MAX_READINGS = 100


def calibrate(
    recording: Recording,
    *,
    orders: Sequence[int] = ORDERS,
    n_live: int = N_LIVE,
    method: CalibrationMethod = CALIBRATION,
    nested_stop: NestedStop | None = None,
    rng: np.random.Generator,
    progress: bool | Progress = True,
) -> Calibration:
    """Fit a sensor model to a recording; compare numbers of Gaussians by their evidence.

    Parameters
    ----------
    recording
        Readings over known patterns.
    orders
        Numbers of Gaussians to compare.
    n_live
        Live points of a full nested sampling, at least two per parameter (six parameters per Gaussian, and two levels):
        fewer are faster, but make the evidences less precise.
    method
        "quick" (the default): log-uniform priors of the widths; each number of Gaussians is sampled from the
        peaks of its likelihood, upwards until the evidence has clearly fallen; a note names the numbers not tried.
        Nested sampling of the whole prior with few live points checks the chosen number; where it missed a part, it
        gets nested sampling with `n_live`.
        "full": the same priors; every number is fitted by nested sampling, and its evidence refined by importance
        sampling. Takes several times as long.
        "paper": uniform priors, and the evidence of nested sampling alone. All have the Student-t likelihood.
    nested_stop
        Stopping rule of nested sampling with the method "paper": "change" (of ln Z below 1e-8; the default), or
        "remaining" (ln Z can rise by 0.05 at most).

    Returns
    -------
    Calibration
        Its `sensor` is the fitted sensor of the most probable number of Gaussians.

    Raises
    ------
    ParameterError
        If the recording, an order or the number of live points cannot be used.

    Warns
    -----
    DoubtfulResultWarning
        If there are fewer usable readings than parameters, or the sampler warns of a doubtful run.

    See Also
    --------
    probewise.calibration.calibrate : The same with your own priors, data sets and executor.

    Examples
    --------
    >>> import numpy as np
    >>> import probewise
    >>> from probewise.recordings import shipped
    >>> recording = probewise.read_recording(shipped("paper"))
    >>> sensor = probewise.calibrate(recording, orders=[1], n_live=20, rng=np.random.default_rng(1)).sensor
    >>> len(probewise.predict(sensor, recording))
    408
    >>> run = probewise.explore(sensor, truth=(500, 250, 90), max_readings=2, rng=np.random.default_rng(1))
    >>> len(run.readings)
    2
    """
    from probewise import calibration
    from probewise._kinds import require_one_of
    from probewise._progress import progress_or_bar, sampler_progress
    from probewise.errors import ParameterError
    from probewise.nested import NESTED_STOP

    require_one_of("method", method, ("quick", "full", "paper"))
    paper = method == "paper"
    if nested_stop is not None and not (paper and nested_stop in NESTED_STOP):
        allowed = " or ".join(map(repr, NESTED_STOP)) if paper else "None"
        raise ParameterError("nested_stop", nested_stop, f'{allowed} with the method "{method}"')
    with progress_or_bar(progress) as told:
        return calibration.calibrate(
            recording,
            orders=orders,
            n_live=n_live,
            quick=method == "quick",
            prior=calibration.paper_prior if paper else calibration.default_prior,
            stop=NESTED_STOP[nested_stop or "change"] if paper else None,
            refined=not paper,
            rng=rng,
            progress=sampler_progress(told),
        )


def predict(
    model: FittedSensor | FittedSystem | SystemFit | Diagnosis,
    plan: Plan | Recording | Table,
    *,
    rng: np.random.Generator | None = None,
    progress: bool | Progress = True,
) -> Prediction | SystemPrediction:
    """Predict the readings of a plan, each with its sd; score those of a recording.

    The result has the predictive mean and sd of a reading for each row, (n_points,), in the unit of the readings, and
    the natural log density of each recorded reading, per unit of the reading; NaN where there is none or it is outside
    the declared range.

    Parameters
    ----------
    model
        A fitted sensor; or of a simulator the result of `fit`, that of `diagnose` (the repaired model), or what
        `systems.read_fitted_system` reads.
    plan
        Pose, time and pattern of every reading; or a recording, whose readings are then scored. Of a simulator a table
        of its columns: a dict of arrays, or a DataFrame.
    rng
        Only for a simulator, whose runs outside the recording are drawn.

    Raises
    ------
    ParameterError
        If an argument has the wrong type, a pattern is not described, or `rng` is missing.

    Warns
    -----
    DoubtfulResultWarning
        If the plan's unit is not that of the calibration, or a column that an effect reads is missing.
    """
    from probewise import calibration, diagnosis, systems
    from probewise._progress import progress_or_bar

    if isinstance(model, diagnosis.Diagnosis):
        model = diagnosis.repaired_of(model)
    fitted = model.fitted if isinstance(model, diagnosis.SystemFit) else model
    if not isinstance(fitted, systems.FittedSystem):
        return calibration.predict(fitted, cast("Plan | Recording", plan))
    with progress_or_bar(progress) as told:
        return systems.predict_system(fitted, cast("Table", plan), rng=cast("np.random.Generator", rng), progress=told)


def explore(
    sensor: FittedSensor,
    *,
    shape: str | Sequence[str] | Shape = SHAPE,
    truth: Truth | None = None,
    conceal: str | None = None,
    arm: Instrument | Measures | None = None,
    field: scene.Field | None = None,
    model: ModelName = MODEL,
    method: MethodName = METHOD,
    nested_stop: NestedStop | None = None,
    levels: Recording | None = None,
    utility: str | Utility | None = None,
    learn_sensor: bool = False,
    batch: int = 1,
    orientations_rad: float | Sequence[float] = (0.0,),
    heights_mm: float | Sequence[float] = (),
    repeats: int | Sequence[int] = (1,),
    trust: float | None = None,
    cards: Sequence[scene.Card] = (),
    max_readings: int = MAX_READINGS,
    journal: str | Path | None = None,
    rng: np.random.Generator,
    progress: bool | Progress = True,
) -> Exploration:
    """Let the robot find a shape, choosing each measurement itself.

    Without an `arm` it is simulated: `probewise.world` hides a shape on a field and computes the readings pixel by
    pixel, with the SSF of `sensor` as the truth. What `model`, `method`, `utility`, `learn_sensor`, `batch`,
    `orientations_rad`, `heights_mm`, `repeats`, `trust` and `cards` mean is at `probewise.experiment.experiment_for`.

    Parameters
    ----------
    sensor
        A fitted sensor: `sensor` of a result of `calibrate`, or from `read_sensor`.
    shape
        The hypothesis: "circle", "ellipse", "rectangle", "triangle", "hexagon", several of them, or a shape
        of `probewise.scene`.
    truth
        Hidden parameters of the (first) shape on the simulated field, for a circle (x_mm, y_mm, radius_mm) or
        {"x_mm": 600, "y_mm": 260, "radius_mm": 90}; or {"rectangle": ...}, by name. By default drawn from the shape's
        prior.
    conceal
        Effects of the simulated world that the sensor model leaves out, such as "backlash:8" (mm), or
        "saturation:40+lag:2": kinds of `probewise.world.concealed`, each with its numbers; None: none.
    arm
        The instrument, used as a context manager; by default the simulated arm. Your own needs only a method
        `measure(pose)` that returns a number or a dict; see `probewise.arm.as_instrument`. Of a `LegoArm` whose
        geometry was fitted to marks, the arm's own error is part of the sds, and of the stopping rule.
    field
        Field of this width and height, `probewise.scene.Field(width_mm, height_mm)`; by default the paper's.
    nested_stop
        Stopping rule of nested sampling with the method "paper": see `calibrate`.
    levels
        Recording with readings over black and over white, for the levels and sds of the paper's naive model; the
        simulated arm reads both before it starts.
    max_readings
        Stop after so many readings at the latest.
    journal
        File with one JSON line per measurement; its folder is created if missing. If the file exists, the run
        continues from it, given an `rng` of the same seed, the same sensor and the same truth.

    Returns
    -------
    Exploration
        Its steps; `last.mean` and `last.sd` are the final posterior mean and sd, `hidden` the true shape of a
        simulated field.

    Raises
    ------
    ParameterError
        If an argument has the wrong type, options do not go together, a truth is given together with an arm, no place
        is more informative than others, or the arm does not declare that it turns or lifts its sensor as asked.
    ReachError
        If no place of the field is within reach.
    LinkError
        If the instrument fails, or returns a reading out of range.
    FileError
        If the journal cannot be read or written, or is of another run.
    NotConvergedError
        If no hypothesis could have given the readings.

    Warns
    -----
    DoubtfulResultWarning
        If the arm reads at another height than that of the calibration.

    See Also
    --------
    probewise.experiment.explore : The same for any experiment and any arm, one step at a time.
    """
    from dataclasses import replace

    from probewise import _kinds, experiment, investigation
    from probewise._progress import progress_or_bar
    from probewise.arm import LegoArm, as_instrument
    from probewise.calibration.sensor_file import require_fitted_sensor
    from probewise.errors import ParameterError
    from probewise.scene import Field

    _kinds.require_rng(rng)
    field = Field() if field is None else field
    _kinds.require_kind("field", field, Field, "a Field: Field(width_mm, height_mm)")
    require_fitted_sensor(sensor, "in the order explore(sensor, ...)")
    _kinds.require_flag("learn_sensor", learn_sensor)
    if conceal is not None:
        _kinds.require_text("conceal", conceal, 'effects as a text, such as "backlash:8", or None')
    for name, value, known in (("method", method, experiment.MethodName), ("model", model, experiment.ModelName)):
        _kinds.require_one_of(name, value, get_args(known))
    _kinds.require_kind("cards", cards, (tuple, list), "cards, of probewise.scene, in a list")
    lies = experiment.as_shape(shape, field)
    streams, hidden = experiment.RandomStreams.spawned_from(rng), None
    naive = method == "paper" and model == "naive"
    if (naive and arm is not None and levels is None) or (levels is not None and not naive):
        allowed = "a recording with readings over black and over white" if naive else "None"
        raise ParameterError("levels", levels, f'{allowed} with the method "{method}" and the model "{model}"')
    asked = experiment.experiment_for(
        sensor,
        lies,
        field,
        method=method,
        model=model,
        nested_stop=nested_stop,
        naive=naive_levels(sensor, levels, rng=streams.levels) if naive else None,
        utility=utility,
        learn_sensor=learn_sensor,
        batch=_kinds.checked_whole("batch", batch),
        orientations_rad=_kinds.checked_one_or_several_numbers("orientations_rad", orientations_rad),
        heights_mm=_kinds.checked_one_or_several_numbers("heights_mm", heights_mm),
        repeats=tuple(
            _kinds.checked_whole("repeats", n) for n in _kinds.checked_one_or_several_numbers("repeats", repeats)
        ),
        trust=None if trust is None else _kinds.checked_number("trust", trust, "a number greater than 0, up to 1"),
        cards=tuple(cards),
    )
    geometry = arm.geometry if isinstance(arm, LegoArm) else None
    if geometry is not None and geometry.accuracy is not None:
        asked = replace(asked, fitted_arm=experiment.FittedArm.from_geometry_and_sensor(geometry, sensor))
    path = None if journal is None else _kinds.checked_path("journal", journal)
    before = experiment.read_journal(path) if path is not None and path.exists() else None
    about: dict[str, Any] = {
        **experiment.sensor_entry(sensor),
        **experiment.geometry_entry(geometry),
        "arm": "simulated" if arm is None else type(arm).__name__,
    }
    taken = () if before is None else before.readings
    if arm is None:
        hidden = experiment.HiddenShape.given_or_drawn(truth, asked.shape, field, rng=streams.truth)
        about |= {"hidden": hidden.journal_entry, **({"concealed": conceal} if conceal else {})}
        effects = investigation.parse_concealed(conceal or investigation.NOTHING, "conceal")
        world, scale = experiment.world_like(sensor, effects), experiment.scale_of(sensor.instrumentation)
        surface = experiment.with_cards(hidden.surface, asked.cards)
        arm = experiment.arm_over(world, surface, field, seed=streams.noise, taken=taken, scale=scale)
    elif truth is not None or conceal is not None:
        name, given = ("conceal", conceal) if truth is None else ("truth", truth)
        raise ParameterError(name, given, "none with an arm of your own: what lies there is for it to find")
    instrument = as_instrument(arm, start_s=taken[-1].time_s if taken else 0.0, name="arm")
    steps: list[Step] = []
    with instrument, progress_or_bar(progress) as told:
        told(*("going through the journal", 0, len(taken)) if taken else ("taking the first readings",))
        for step in experiment.explore(
            instrument,
            asked,
            rng=streams.run,
            max_readings=max_readings,
            journal=path if before is None else before,
            about=about,
        ):
            steps.append(step)
            if step.replayed:
                told("going through the journal", step.number, len(taken))
                continue
            believed = f"widest sd {step.largest_sd_mm:.1f} mm, {step.bits:.1f} bits"
            told(f"reading {step.number} of at most {max_readings}", note=believed)
        return experiment.Exploration(asked, tuple(steps), hidden, sensor, conceal or "")


def naive_levels(sensor: FittedSensor, levels: Recording | None, *, rng: np.random.Generator) -> Naive:
    """Return levels and sds of the paper's naive model, from a recording, or read by the simulated sensor (None)."""
    from probewise import experiment

    if levels is not None:
        return experiment.naive_levels_from_recording(levels, sensor)
    world, scale = experiment.world_like(sensor), experiment.scale_of(sensor.instrumentation)
    return experiment.naive_levels_from_world(world, scale, rng=rng)


def audit(
    plan: Plan | Recording | Table,
    *,
    simulator: AnySimulator | None = None,
    sensor: FittedSensor | None = None,
    progress: bool | Progress = True,
) -> PlanAudit:
    """Audit a plan before any data: which effects are undetectable or aliased, and which readings would cure that.

    The result has the detectability and aliases of each effect; its `cure_plan` holds the readings to add (None with
    `simulator`).

    Parameters
    ----------
    plan
        The plan, or a recording, of which only the plan is used; with `simulator` a table of its columns.
    simulator
        A simulator of your own, or its FILE.py, in place of the light sensor.
    sensor
        The calibrated sensor, by which detectability is computed; by default a typical one.

    Raises
    ------
    ParameterError
        If the plan has no row, or a pattern that is not described, or the table lacks a column.

    See Also
    --------
    probewise.diagnosis.audit_plan : The same with your own vocabulary.

    Examples
    --------
    >>> import probewise
    >>> from probewise.recordings import Uniform
    >>> plan = probewise.Plan.from_arrays(x_mm=range(30), y_mm=0, patterns=Uniform(0.5), unit="V", min=0, max=5)
    >>> len(probewise.audit(plan).effects_with_detectability("invisible")) > 0
    True
    """
    from probewise import diagnosis
    from probewise._progress import progress_or_bar

    with progress_or_bar(progress) as told:
        if simulator is None:
            return diagnosis.audit_plan(cast("Plan | Recording", plan), sensor=sensor, progress=told)
        acting, table, _ = _simulator_and_table(simulator, plan, sensor=sensor)
        return diagnosis.audit_system(acting, table)


def fit(
    tables: Table | Sequence[Table],
    *,
    simulator: AnySimulator,
    thorough: bool = False,
    rng: np.random.Generator,
    progress: bool | Progress = True,
) -> SystemFit:
    """Fit a simulator of your own to a table of readings: mode, posterior and evidence, without a diagnosis.

    `tables` hold the readings with the simulator's columns, each a dict of arrays or a DataFrame; several are fitted
    together. `simulator` is a `systems.Simulator`, or its FILE.py. With `thorough` the evidence is computed by nested
    sampling as well. Raises the errors of `diagnosis.fit_simulator`.
    """
    from probewise import diagnosis
    from probewise._progress import progress_or_bar

    acting, table, notes = _simulator_and_table(simulator, tables)
    with progress_or_bar(progress) as told:
        return diagnosis.fit_simulator(acting, table, notes=notes, thorough=thorough, rng=rng, progress=told)


def diagnose(
    recordings: Recording | Table | Sequence[Recording] | Sequence[Table],
    *,
    simulator: AnySimulator | None = None,
    sensor: FittedSensor | None = None,
    thorough: bool = False,
    rng: np.random.Generator,
    progress: bool | Progress = True,
) -> Diagnosis:
    """Find which physics a sensor model, or a simulator of your own, leaves out.

    The result has verdict, probabilities, location of the mismatch, the repaired model and the advised next readings.

    Parameters
    ----------
    recordings
        One recording, or several of one apparatus, diagnosed together; with `simulator` tables of its columns, as for
        `fit`.
    simulator
        A simulator, or its FILE.py, in place of the light sensor.
    sensor
        An earlier calibration, whose posterior becomes the prior.
    thorough
        Recompute the evidence of the leading hypotheses by nested sampling. It replaces Laplace's approximation if the
        two differ by more than a nat plus the standard error, and no run gave a warning.

    Raises
    ------
    ParameterError
        If there is no usable reading, units differ, or two recordings are the same.
    NotConvergedError
        If the fit of the sensor model failed.

    See Also
    --------
    probewise.diagnosis.diagnose : The same with your own vocabulary or model.

    Examples
    --------
    >>> import numpy as np
    >>> import probewise
    >>> from probewise.recordings import shipped
    >>> few = probewise.read_recording(shipped("paper")).take(np.arange(20))
    >>> probewise.diagnose(few, rng=np.random.default_rng(1)).verdict
    'cannot_tell'
    """
    from functools import partial

    from probewise import diagnosis
    from probewise._kinds import require_flag, require_rng
    from probewise._progress import progress_or_bar

    require_rng(rng)
    require_flag("thorough", thorough)
    own, nested_rng = rng.spawn(2)
    with progress_or_bar(progress) as told:
        again = partial(diagnosis.weigh_thoroughly, rng=nested_rng, progress=told) if thorough else None
        if simulator is None:
            taken = cast("Recording | Sequence[Recording]", recordings)
            return diagnosis.diagnose(taken, sensor=sensor, thorough=again, rng=own, progress=told)
        acting, table, notes = _simulator_and_table(simulator, recordings, sensor=sensor)
        return diagnosis.diagnose_system(acting, table, notes=notes, thorough=again, rng=own, progress=told)


def _simulator_and_table(
    simulator: AnySimulator, tables: object, *, sensor: FittedSensor | None = None
) -> tuple[Simulator, RunTable, tuple[str, ...]]:
    """Return a simulator, read if it is a file, its tables joined, and notes on them; ParameterError with a sensor."""
    from pathlib import Path

    from probewise.errors import require
    from probewise.systems import concatenate_tables, read_simulator, table_for

    require(sensor is None, "sensor", sensor, "None with a simulator, which replaces it")
    acting = read_simulator(simulator) if isinstance(simulator, str | Path) else simulator
    several = list(tables) if isinstance(tables, list | tuple) else [tables]
    built = [table_for(acting, cast("Table", each)) for each in several]
    return acting, *concatenate_tables(built, [f"table {k}" for k in range(1, len(built) + 1)])
