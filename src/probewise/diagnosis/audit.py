"""Audit of a plan before any data: undetectable effects, aliased effects, and readings that would help.

About a typical (or calibrated) sensor, every effect of the vocabulary becomes a set of templates at many settings, with
the sensor's own parameters projected out. The norm of a projected template measures detectability; the cosine of two,
how well they are separated: by lambda^2 (1 - cosine^2) / 2 nats. Cures are the fewest extra scans, chosen greedily.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple, TypeAlias, cast, get_args

import numpy as np

from probewise._arrays import (
    MOST_NUMBERS,
    TINY,
    FloatArray,
    IntArray,
    data_frame,
    own_arithmetic,
    read_only_floats,
    varies,
)
from probewise._display import Reported
from probewise._kinds import require_one_of
from probewise.calibration import FittedSensor
from probewise.diagnosis.advice import LAMBDA, LEAST_SHARE, classes_of
from probewise.diagnosis.apparatus import ENOUGH_NATS, Candidate, Words
from probewise.diagnosis.evidence import orthonormalise_groups
from probewise.diagnosis.fit import Fit, Model, Null
from probewise.diagnosis.light_sensor import LightSensorApparatus, candidate_scans, scan_started_after, target_swaps
from probewise.diagnosis.prepared import join_plans
from probewise.diagnosis.sensors import (
    LEAST_READINGS,
    CalibratedSensor,
    SensorPrior,
    default_sensor,
    require_same_unit,
    require_sensor_prior,
    sensor_from_samples,
)
from probewise.diagnosis.simulator_rows import ON_NOISE, SimulatorApparatus
from probewise.diagnosis.templates import templates_of_effect
from probewise.diagnosis.words import join_lists, substitute_reading_unit
from probewise.effects import NUISANCES, VOCABULARY, Effect, Extent, LightEffect, name_of_first_copy
from probewise.effects.noise import noise_of_runs, noise_per_run, noise_sd
from probewise.errors import ParameterError, require
from probewise.progress import Progress, silent
from probewise.recordings.plan import Plan, Recording, require_patterns_described, require_plan
from probewise.sensor import Stage
from probewise.systems import RunTable, Simulator, System, as_recording, table_for
from probewise.systems.forms import ReferenceFit, bind_forms
from probewise.systems.system import STANDS_STILL, with_converged_step

ALIAS = math.sqrt(1 - 2 * ENOUGH_NATS / LAMBDA**2)  # the cosine at which the evidence is ENOUGH_NATS


class Seen(NamedTuple):
    """What readings show of an effect: the share of its change that no parameter absorbs, median over its settings.

    `like`: cosine to the best-imitating setting of every other visible effect, by name, median over its own settings;
    `smallest`: the value of each amplitude at which it has lambda 8, likewise; None if it has none.
    """

    share: float
    like: dict[str, float]
    smallest: dict[int, float | None]


@dataclass(frozen=True, eq=False)
class EffectBank:
    """The templates of all effects under one plan: changes of its readings, in noise sds.

    They are grouped in entries: one for each setting (parameter values) of an effect's bank.
    """

    slopes: FloatArray  # of the model, (n_points, n_params)
    columns: FloatArray  # (n_points, n_columns)
    entry: IntArray  # of each column, (n_columns,)
    owner: IntArray  # the index of the effect of each entry in `built`, (n_entries,)
    built: Mapping[str, Effect]
    settings: tuple[FloatArray, ...]  # the parameter values of each entry

    def _norms_of_entries(self, columns: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.bincount(self.entry, np.einsum("ij,ij->j", columns, columns), len(self.owner))))

    def seen_in(self, rows: IntArray, asked: Sequence[str] | None = None) -> dict[str, Seen]:
        """Return what the readings of these row numbers show of each effect, by name, beside the model's parameters.

        Only effects in `asked` have cosines, by default all, and only between shares of 0.05 or more; sizes are
        computed by default only.
        """
        # Parameters, with their priors as further rows, are projected out of the columns: `left`.
        slopes, columns, names = self.slopes[rows], self.columns[rows], list(self.built)
        n_points, n_params = slopes.shape
        own, _ = np.linalg.qr(np.concatenate([slopes, np.eye(n_params)]))
        left = -own @ (own[:n_points].T @ columns)
        left[:n_points] += columns
        raw, kept = self._norms_of_entries(columns), self._norms_of_entries(left)
        out, present = dict[str, Seen](), dict[str, IntArray]()  # the entries of each effect that act on these rows
        for k in np.unique(self.owner).tolist():
            mine = np.flatnonzero(self.owner == k)
            acting = mine[raw[mine] > 1e-6 * max(float(raw[mine].max(initial=0.0)), 1e-6)]
            share = float(np.median(kept[acting] / raw[acting])) if acting.size else 0.0
            present[names[k]], smallest = acting, self._smallest(names[k], mine, left) if asked is None else {}
            out[names[k]] = Seen(share, {}, smallest)
        visible = [name for name, seen in out.items() if seen.share >= LEAST_SHARE]
        wanted = [name for name in (visible if asked is None else asked) if name in visible]
        if not wanted:
            return out
        basis, widths = np.zeros_like(left), np.bincount(self.entry)
        for width in np.unique(widths):  # all entries of one width at a time; without directions below a thousandth
            mine = np.flatnonzero(widths[self.entry] == width)
            basis[:, mine] = orthonormalise_groups(left[:, mine], int(width), least=1e-18, share=1e-6)
        mine = np.concatenate([present[name] for name in wanted])
        at = np.flatnonzero(np.isin(self.entry, mine))
        onto = (basis.T @ left[:, at]) ** 2  # of each column, on every direction of the others
        onto = np.add.reduceat(onto, _run_start_indices(self.entry), axis=0)
        onto = np.add.reduceat(onto, _run_start_indices(self.entry[at]), axis=1)
        mine = np.unique(self.entry[at])
        best = np.maximum.reduceat(onto, _run_start_indices(self.owner), axis=0)
        cosines = np.sqrt(np.minimum(best / np.maximum(kept[mine] ** 2, TINY), 1.0))
        owners = [names[k] for k in self.owner[_run_start_indices(self.owner)]]
        for name in wanted:
            typical = np.median(cosines[:, self.owner[mine] == names.index(name)], axis=1)
            like = dict(zip(owners, typical.tolist(), strict=True))
            out[name].like.update({other: like[other] for other in visible if other != name})
        return out

    def _smallest(self, name: str, entries: IntArray, left: FloatArray) -> dict[int, float | None]:
        columns = np.flatnonzero(np.isin(self.entry, entries))
        settings = np.concatenate([self.settings[k] for k in entries])
        lengths = np.linalg.norm(left[:, columns], axis=0)
        out: dict[int, float | None] = {}
        for k in self.built[name].amplitudes:
            significant = (settings[:, k] != 0) & (lengths > 1e-3)
            sizes = np.abs(settings[significant, k]) * LAMBDA / lengths[significant]
            out[k] = float(np.median(sizes)) if sizes.size else None
        return out


def _run_start_indices(codes: IntArray) -> IntArray:
    return np.flatnonzero(np.diff(codes, prepend=-1))


@dataclass(frozen=True, eq=False)
class Expected:
    """The model about which a plan is audited."""

    null: Null
    z: FloatArray  # its coordinates, (n_params,)
    sd: float  # of the noise of a reading
    effects_under: Callable[[Plan], Mapping[str, Effect]]  # scaled to a plan, without those that cannot act there
    assumed: str  # model and noise in words

    def bank(self, plan: Plan, *, most: int | None = None) -> EffectBank:
        """Build the templates of the effects on the mean under a plan.

        Each has at most `most` settings, evenly spread; by default as many as hold two million numbers, but 64 or more.
        """
        most = max(MOST_NUMBERS // len(plan), 64) if most is None else most
        model, built, rows = Model(self.null, (), plan), self.effects_under(plan), np.arange(len(plan))
        predicted, slopes = model.predict_and_differentiate(self.z)
        found = Fit(model, self.z, predicted, np.zeros(len(plan)), slopes, sd=self.sd, objective=0.0)
        columns, settings, owner = [np.zeros((len(plan), 0))], list[FloatArray](), list[int]()
        for at, effect in enumerate(built.values()):
            if effect.stage is not Stage.NOISE:
                templates = templates_of_effect(found, effect, rows, most=most)
                columns += templates.columns
                settings += templates.settings
                owner += [at] * len(templates.columns)
        entry = np.repeat(np.arange(len(settings)), [c.shape[1] for c in columns[1:]])
        whole = np.concatenate(columns, axis=1) / self.sd
        return EffectBank(slopes / self.sd, whole, entry, np.array(owner, dtype=np.int64), built, tuple(settings))


Detectability: TypeAlias = Literal["invisible", "aliased", "fine"]

_LINE = 99  # characters of a line of the summary
_SETTINGS = 48  # bank entries per effect, in the audit within a diagnosis, and where a hundred scans are tried
_LEVELS = (0.1, 0.9)  # black and white as shares of the range of readings, without a calibrated sensor
_READING_GUIDE = (
    "(fine: detected, and told from every other effect. aliased (X c): detected, but X can imitate it, with a cosine",
    " of c; the reverse need not hold. invisible: not detected.)",
)
_ABSORBED = "the model's own parameters absorb it"
_NOISE = 0.01  # noise as a share of the span between the levels, likewise
# Two Gaussians, a core and a faint halo, off-centre and not round, so that no effect is invisible by symmetry.
_TYPICAL = np.array([-0.6, 0.15, 0.2, -0.6, -0.3, 0.3, -0.2, -0.1, 0.4, 0.7, -0.2, 0.0, 0.0])


@dataclass(frozen=True)
class DetectableSize:
    """The value of one amplitude (`amount` in `unit`) that gives an effect lambda 8; None if no value does.

    Lambda is the norm of the effect's change of the readings in noise sds, after a refit of the sensor.
    """

    parameter: str
    unit: str
    amount: float | None


@dataclass(frozen=True)
class EffectAudit:
    """Detectability of one effect under a plan.

    Fine: the readings detect the effect and tell it from every other. Aliased: another effect imitates it with a cosine
    of 0.95 or more (at lambda 8 less than 3 nats apart). Invisible: it cannot act here, or the sensor's own parameters
    absorb over 95 % of its change of the readings. An effect on the noise is fine from 24 readings on, else invisible.

    `share`: share of its change of the readings that the model's parameters do not absorb, median over its settings; 0
    if it cannot act here; of a noise effect 1 if fine, else 0. `alike`: effects that imitate a typical setting of it,
    with cosines, largest first. `smallest`: the value of each amplitude at which it has lambda 8 (norm in noise sds,
    after a refit). `reason`: why it is invisible, or "". `rows`: number of rows like these that detect it if it changes
    readings by one noise sd rms; None if not computed.
    """

    name: str
    detectability: Detectability
    share: float
    alike: tuple[tuple[str, float], ...] = ()
    smallest: tuple[DetectableSize, ...] = ()
    reason: str = ""
    rows: int | None = None


@dataclass(frozen=True, eq=False)
class Cure(Candidate):
    """One scan to add, and the effects that it makes fine."""

    cured: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PlanAudit(Reported):
    """Audit of a plan: which effects its readings detect and tell apart, and scans to add for the others.

    `assumed`: the assumed sensor, in words; `effects`, `after`: every effect, under the plan and under the plan with
    all `cures`, which are in the order chosen; `cosines`: of each effect (row) with its best imitation by each other
    (column), (n_effects, n_effects), in the order of `effects`; on the diagonal, the detectable share; `classes`:
    groups of effects aliased with one another; None if not requested.
    """

    plan: Plan
    assumed: str
    effects: tuple[EffectAudit, ...]
    cosines: FloatArray
    cures: tuple[Cure, ...]
    after: tuple[EffectAudit, ...]
    words: Words = LightSensorApparatus.words
    classes: tuple[tuple[str, ...], ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "cosines", read_only_floats(self.cosines))

    def effects_with_detectability(
        self, detectability: Detectability, *, after: bool = False
    ) -> tuple[EffectAudit, ...]:
        """Return the effects that are "fine", "aliased" or "invisible" under the plan, or `after` all cures."""
        require_one_of("detectability", detectability, get_args(Detectability))
        return tuple(e for e in (self.after if after else self.effects) if e.detectability == detectability)

    @property
    def cure_plan(self) -> Plan | None:
        """All cures as one plan; None if there are none."""
        return join_plans([cure.plan for cure in self.cures]) if self.cures else None

    @property
    def extra_readings(self) -> int:
        """Number of readings of the cures."""
        return sum(len(cure.plan) for cure in self.cures)

    @property
    def extra_minutes(self) -> float:
        """Duration of the cures in minutes, including the breaks before each scan."""
        return sum(cure.minutes for cure in self.cures)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame: `effect`, `detectability`, `share` that can be seen, and `reason`, a row each."""
        names = "detectability", "share", "reason"
        columns = {name: [getattr(effect, name) for effect in self.effects] for name in names}
        return data_frame({"effect": [effect.name for effect in self.effects], **columns})

    def summary(self) -> str:
        """Return a plain-text summary of the audit."""
        n_runs = len(self.plan.scan_names)
        fine, aliased, invisible = map(self.effects_with_detectability, get_args(Detectability)[::-1])
        lines = [
            f"{len(self.plan)} readings in {n_runs} {self.words.run}{'' if n_runs == 1 else 's'}; {self.assumed}",
            *_wrapped_lines("fine", [e.name for e in fine]),
            *_wrapped_lines("aliased", [f"{e.name} ({e.alike[0][0]} {e.alike[0][1]:.2f})" for e in aliased]),
            *_wrapped_lines("invisible", [e.name for e in invisible]),
            *_READING_GUIDE,
        ]
        if not self.cures:
            no_cure = "not needed" if len(fine) == len(self.effects) else self.words.no_cure
            return "\n".join([*lines, f"cure       {no_cure}"])
        minutes = "1 minute" if self.extra_minutes < 1.5 else f"{self.extra_minutes:.0f} minutes"
        lines.append(f"cure       {self.extra_readings} more readings, about {minutes}:")
        for k, cure in enumerate(self.cures, start=1):
            so_that = ", ".join(cure.cured) or "prepares the next"
            said = f"  {k}. {cure.description}, {len(cure.plan)} readings: {so_that}"
            lines += textwrap.wrap(said, 120, subsequent_indent=" " * 5, break_on_hyphens=False)
        left = [e.name for e in self.after if e.detectability != "fine"]
        return "\n".join([*lines, *_wrapped_lines("left", left or ["nothing"])])


def _wrapped_lines(label: str, names: Sequence[str]) -> list[str]:
    """Write a list of names after a label, in lines of up to 99 characters; no lines without names."""
    text, first = ", ".join(name.replace(" ", "\0") for name in names), f"{label:<10} "  # a name stays in one line
    lines = textwrap.wrap(text, _LINE, initial_indent=first, subsequent_indent=" " * 11, break_on_hyphens=False)
    return [line.replace("\0", " ") for line in lines]


@own_arithmetic
def audit_plan(
    plan: Plan | Recording,
    *,
    sensor: SensorPrior | None = None,
    effects: Mapping[str, LightEffect] = VOCABULARY,
    progress: Progress = silent,
) -> PlanAudit:
    """Determine for each effect whether a plan detects it and tells it from every other, and which readings would help.

    Arguments and result, with up to five scans to add, are those of `probewise.audit`; and the vocabulary `effects`, by
    name. The noise sd of a reading is the calibrated sensor's, or a hundredth of the span between black and white.
    Raises ParameterError as that, and if units differ.
    """
    plan = plan.plan if isinstance(plan, Recording) else plan
    require_plan(plan)
    if sensor is not None:
        require_sensor_prior(sensor)
    require(len(plan) != 0, "plan", "no row", "at least one")
    require_patterns_described(plan)
    if sensor is not None:
        require_same_unit(sensor, plan)
    expected, unit = _expected_sensor(plan, sensor, effects), plan.instrumentation.unit
    progress("judging the plan")
    before, cosines = audits_and_cosines(expected.bank(plan), list(effects), unit)
    ailing = [effect.name for effect in before if effect.detectability != "fine"]
    chosen = choose_cure_scans(plan, expected, ailing, progress)
    steps, current = [before], plan
    for k, candidate in enumerate(chosen):
        progress("judging the plan with its cures", k, len(chosen))
        current = join_plans([current, candidate.plan])
        steps.append(audits_and_cosines(expected.bank(current), list(effects), unit)[0])
    cured = _curing_step_by_effect(steps)
    n_kept = max(cured.values(), default=0)  # drop scans that were to prepare a later one that was not added
    cures = tuple(
        Cure(**vars(candidate), cured=tuple(name for name, step in cured.items() if step == k))
        for k, candidate in enumerate(chosen[:n_kept], start=1)
    )
    return PlanAudit(plan, expected.assumed, before, cosines, cures, steps[n_kept])


def _curing_step_by_effect(steps: Sequence[Sequence[EffectAudit]]) -> dict[str, int]:
    """Return, for each effect that added scans make fine to the end, the number of scans from which it is."""
    fine = [{effect.name for effect in step if effect.detectability == "fine"} for step in steps]

    def fine_since(last: int) -> dict[str, int]:
        names = [effect.name for effect in steps[0] if effect.name in fine[last] - fine[0]]
        return {name: max(k for k in range(last) if name not in fine[k]) + 1 for name in names}

    return fine_since(max(fine_since(len(steps) - 1).values(), default=0))


def _expected_sensor(plan: Plan, sensor: SensorPrior | None, effects: Mapping[str, LightEffect]) -> Expected:
    """Return a sensor as calibrated, or a typical one, with its noise sd."""
    null: CalibratedSensor
    if sensor is not None:
        null, said = sensor_from_samples(sensor), "the sensor as calibrated"
        mean = np.asarray(sensor.samples, dtype=np.float64).mean(axis=0)
        low, high = sorted(float(mean[list(sensor.names).index(name)]) for name in ("I_min", "I_max"))
        high, z = high if low < high else low + 1e-9 * (abs(low) or 1.0), np.zeros(null.n_params)
    else:
        inst = plan.instrumentation
        bottom, top = (0.0 if inst.min is None else inst.min), (100.0 if inst.max is None else inst.max)
        span = top - bottom if top > bottom else 1e-6
        low, high = (bottom + share * span for share in _LEVELS)
        null, z = default_sensor(Extent(low, high, plan), 2), _TYPICAL.copy()
        said = f"a typical sensor of {low:g} to {high:g}"
    sd = float(sensor.noise_sd.mean()) if isinstance(sensor, FittedSensor) else _NOISE * (high - low)
    said = f"{said}, noise {sd:.3g} {plan.instrumentation.unit_after_number}".rstrip()

    def effects_under(plan: Plan) -> dict[str, Effect]:
        maybe = {name: kind.for_extent(Extent(low, high, plan)) for name, kind in effects.items()}
        return {name: effect for name, effect in maybe.items() if effect is not None and null.admits(effect)}

    return Expected(null, z, sd, effects_under, said)


def audits_and_cosines(bank: EffectBank, names: Sequence[str], unit: str) -> tuple[tuple[EffectAudit, ...], FloatArray]:
    """Return the audit of every effect, and the matrix of cosines (row imitated by column; shares on the diagonal)."""
    n_points = len(bank.slopes)
    every = bank.seen_in(np.arange(n_points))
    cosines, out = np.zeros((len(names), len(names))), list[EffectAudit]()
    for own, name in enumerate(names):
        effect = bank.built.get(name)
        share, reason = 0.0, _ABSORBED if name == noise_sd.name else "its covariate does not vary here"
        alike, smallest = list[tuple[str, float]](), tuple[DetectableSize, ...]()
        if effect is not None and effect.stage is Stage.NOISE:
            share = float(n_points >= LEAST_READINGS)
            reason = f"{n_points} readings do not show the scatter; {LEAST_READINGS} would"
        elif effect is not None:
            share, like, sizes = every[name]
            reason = _ABSORBED if share > 0 else "it leaves no trace here"
            for other, cosine in like.items():
                cosines[own, names.index(other)] = cosine
            alike = sorted(((other, c) for other, c in like.items() if c >= ALIAS), key=lambda pair: -pair[1])
            smallest = tuple(
                DetectableSize(effect.prior.names[k], substitute_reading_unit(effect.units[k], unit), amount)
                for k, amount in sizes.items()
            )
        cosines[own, own] = share
        if share < LEAST_SHARE:
            out.append(EffectAudit(name, "invisible", share, reason=reason))
        else:
            out.append(EffectAudit(name, "aliased" if alike else "fine", share, tuple(alike), smallest))
    return tuple(out), cosines


_MOST_SCANS = 5
_WORTHWHILE = 0.15  # least reduction of the summed deficit by an added scan
_WORTHWHILE_EACH = 0.005  # and per reading: at most 200 readings are spent on one effect
_STRIDES = (1, 4)


def choose_cure_scans(plan: Plan, expected: Expected, ailing: Sequence[str], progress: Progress) -> list[Candidate]:
    """Choose up to five scans to add, one after another, each with the largest reduction of the deficit per reading."""
    every = [*candidate_scans(plan, strides=_STRIDES), *target_swaps(plan)]
    chosen: list[Candidate] = []
    current = plan
    while len(chosen) < _MOST_SCANS:
        progress("looking for readings that cure", len(chosen), _MOST_SCANS)
        taken = {candidate.plan.scan_names for candidate in chosen}
        offered = [c for c in every if c.plan.scan_names not in taken]
        options = [scan_started_after(candidate, current) for candidate in offered]
        if not options:
            break
        together = join_plans([current, *(option.plan for option in options)])
        bank = expected.bank(together, most=_SETTINGS)
        now = np.arange(len(current))
        trouble = _total_detectability_deficit(bank, now, ailing)
        worth = []
        for start, end in itertools.pairwise(np.cumsum([len(current), *(len(o.plan) for o in options)]).tolist()):
            gained = trouble - _total_detectability_deficit(bank, np.concatenate([now, np.arange(start, end)]), ailing)
            readings = end - start
            worth.append(gained / readings if gained >= max(_WORTHWHILE, _WORTHWHILE_EACH * readings) else 0.0)
        best = int(np.argmax(worth))
        if worth[best] == 0.0:
            break
        chosen.append(options[best])
        current = join_plans([current, options[best].plan])
    return chosen


def _total_detectability_deficit(bank: EffectBank, rows: IntArray, ailing: Sequence[str]) -> float:
    """Return the summed deficit of the ailing effects on these rows: 0 fine, up to 1 aliased, 1 to 2 invisible."""
    every, total = bank.seen_in(rows, ailing), 0.0
    for name in ailing:
        share, like, _ = every.get(name, (0.0, {}, {}))
        if share < LEAST_SHARE:
            total += 2.0 - share / LEAST_SHARE
        else:
            nats = 0.5 * LAMBDA**2 * (1 - max(like.values(), default=0.0) ** 2)
            total += max(1.0 - nats / ENOUGH_NATS, 0.0)
    return total


CURE_PLAN = "cure_plan.csv"


def audit_json(audit: PlanAudit) -> dict[str, Any]:
    """Convert an audit to the content of audit.json.

    The `amount` of a smallest size is null if no size is detectable, `cure` if there is none; `rows` and alias classes
    that were not computed are left out.
    """
    plan, cure = audit.cure_plan, None
    if plan is not None:
        scans = [
            {"kind": each.kind, "description": each.description, "scan": each.plan.scan_names[0]}
            | {"readings": len(each.plan), "cures": list(each.cured)}
            for each in audit.cures
        ]
        cure = {"plan": CURE_PLAN, "readings": len(plan), "minutes": audit.extra_minutes, "scans": scans}
    return {
        "format": "audit/1",
        "readings": len(audit.plan),
        "assumed": audit.assumed,
        "effects": _effects_json(audit.effects),
        "cure": cure,
        "after": _effects_json(audit.after),
        **({} if audit.classes is None else {"alias_classes": [list(names) for names in audit.classes]}),
    }


def _effects_json(effects: Sequence[EffectAudit]) -> list[dict[str, Any]]:
    return [
        {
            "name": effect.name,
            "sight": effect.detectability,
            "surviving_share": effect.share,
            "alike": [{"effect": name, "cosine": cosine} for name, cosine in effect.alike],
            "smallest": [asdict(size) for size in effect.smallest],
            "reason": effect.reason,
            **({} if effect.rows is None else {"rows": effect.rows}),
        }
        for effect in effects
    ]


_MOST_ROWS = 1200  # rows used


@own_arithmetic
def audit_system(simulator: Simulator, table: RunTable | Mapping[str, Any]) -> PlanAudit:
    """Determine for each effect whether readings in the rows of a table can detect it and tell it from the others.

    The simulator is evaluated at the middle of its prior. If the readings there are constant, as those of a pendulum at
    rest, or not finite, another point of the prior is taken, and `assumed` says so. The column of readings is not used.
    The audit has no cures, but of each effect the rows that it needs, and groups of aliased effects.

    Raises
    ------
    ParameterError
        If the table lacks a column that the simulator reads, time falls within a run, or the predicted readings are
        constant, or not finite in some row, at all points of the prior that are tried.
    FileError, ShapeError
        As `diagnose_system`.
    """
    table = table_for(simulator, table)
    table.require_rising_time()
    table.require_moderate_numbers()
    inputs = replace(table, columns={name: v for name, v in table.columns.items() if name != simulator.reading})
    own = cast(RunTable, as_recording(simulator, inputs).plan)
    system = System.of(simulator, own)
    z, predicted, where = _point_where_readings_vary(system, own)
    filled = simulator.interpolated_inputs(own)  # columns that only effects read, since every row is predicted
    own = own.with_columns(filled)
    sd, noise = _noise_sd_and_source(simulator, own, predicted)
    system = with_converged_step(system, own, system.theta(z[None, :]), tolerance=STANDS_STILL * sd)
    about = ReferenceFit(system, own.with_columns({simulator.reading: predicted}), z, sd)
    forms = {name: form for name, form in bind_forms(about).items() if name_of_first_copy(name) is None}
    on_noise = {
        kind.name: noise_of_runs(own.scan_names) if kind is noise_per_run else kind()
        for kind in ON_NOISE
        if kind not in NUISANCES.values() and (kind is not noise_per_run or len(own.scan_names) > 1)
    }
    built = cast(dict[str, Effect], {**forms, **on_noise})
    reasons = _reasons_for_absence(about)
    names = dict.fromkeys([*forms, *(name for name in reasons if name not in forms), *on_noise])
    assumed = f"{simulator.source or 'the simulator'} at {where}, noise {sd:.3g} {simulator.unit} ({noise})"
    assumed += f"; gaps of {join_lists([*filled])} are interpolated" if filled else ""
    expected = Expected(cast(Null, system), z, sd, lambda _: built, assumed)
    bank = expected.bank(cast(Plan, own), most=64)
    rows = np.arange(len(own))
    if len(own) > _MOST_ROWS:  # one in each of as many stretches; by the golden ratio, so that no column keeps step
        stretch = np.arange(_MOST_ROWS)
        rows = np.asarray((stretch + stretch * ((math.sqrt(5) - 1) / 2) % 1.0) * len(own) / _MOST_ROWS, dtype=np.int64)
    each = math.sqrt(len(own) / len(rows))  # every row taken stands for several, with as much information as they have
    bank = replace(bank, slopes=each * bank.slopes[rows], columns=each * bank.columns[rows])
    found, cosines = audits_and_cosines(bank, list(names), simulator.unit)
    effects = tuple(
        replace(e, reason=e.reason if e.share > 0 else reasons.get(e.name, e.reason))
        if e.detectability == "invisible"
        else replace(e, rows=math.ceil((LAMBDA / e.share) ** 2))
        for e in found
    )
    like = {effect.name: {name for name, _ in effect.alike} for effect in effects}
    named = sorted(like)
    every = classes_of(range(len(named)), lambda j, k: named[j] in like[named[k]] or named[k] in like[named[j]])
    classes = tuple(tuple(named[k] for k in own) for own in every if len(own) > 1)
    words = SimulatorApparatus(about).words
    return PlanAudit(cast(Plan, own), assumed, effects, cosines, (), effects, words, classes)


def _point_where_readings_vary(system: System, table: RunTable) -> tuple[FloatArray, FloatArray, str]:
    """Return a point of the prior at which readings vary, its middle if possible, (n_params,).

    With the predicted readings there, (n_points,), and the point in words. Raises ParameterError if there is none, or a
    row has no reading at any.
    """
    never, is_constant = np.ones(len(table), dtype=np.bool_), False
    for k, z in enumerate(system.starts):
        predicted = system.chain(table, ()).predict(system.theta(z[None, :]), table)[0]
        if np.isfinite(predicted).all() and varies(predicted):
            other = "another point of the prior (at its middle, readings are constant or not finite)"
            return z, predicted, other if k else "the middle of the prior"
        never &= ~np.isfinite(predicted)
        is_constant |= bool(np.isfinite(predicted).all())
    if never.any():
        first = table.row_name(int(np.argmax(never)))
        found = f"no finite reading in {int(never.sum())} of {len(table)} rows, first in row {first}"
        raise ParameterError("the table", found, "a number in each cell that the simulator reads")
    if not is_constant:
        found = f"not finite in some row at any of the {len(system.starts)} points of the prior that were tried"
        raise ParameterError("the predicted reading", found, "narrower priors, with which all readings are finite")
    raise ParameterError(
        "the predicted reading", "the same in all rows, wherever the prior was tried", "rows over which it changes"
    )


def _noise_sd_and_source(simulator: Simulator, table: RunTable, predicted: FloatArray) -> tuple[float, str]:
    declared, sd = simulator.noise.sd, simulator.declared_sd(table)
    if sd is not None:
        return float(sd), f"the median of {declared}" if isinstance(declared, str) else "as declared"
    return _NOISE * float(np.ptp(predicted)), "a hundredth of the range of the readings, since none is declared"


def _reasons_for_absence(about: ReferenceFit) -> dict[str, str]:
    """Return, for every possible effect by name, the reason to give if it cannot act in this table."""
    own, table = about.system.simulator, about.table
    nothing = "it leaves no trace here"
    timeless = "no time was recorded" if not table.has_varying_time else nothing
    too_few = nothing if about.can_fit_value_per_run else "runs have too few rows"
    one_run = "there is one run" if len(table.scan_names) == 1 else too_few
    out = {"offset_drift": timeless, "gain_drift": timeless, "offset_step": nothing, "gain_step": nothing}
    out |= {"offset_per_run": one_run, "gain_per_run": one_run, "nonlinearity": nothing, "saturation": nothing}
    out |= {"hysteresis": "the readings move one way only"}
    out |= dict.fromkeys(("lag", "delay", "settling", "interference"), timeless)
    for column in own.inputs(table.covariates):
        out[f"sensitivity:{column}"] = "the column does not vary"
        out[f"curve:{column}"] = "it has fewer than three values"
        out[f"friction:{column}"] = "the column does not move both ways"
    for column in about.driving_columns:
        out |= {f"{kind}:{column}": nothing for kind in ("input_offset", "input_gain", "input_saturation", "dead_zone")}
        out |= {f"backlash:{column}": f"{column} does not turn back", f"input_delay:{column}": timeless}
        out |= {f"periodic_error:{column}": "the column has too few values"}
    out |= {"clock_drift": timeless, noise_per_run.name: one_run}
    for name in own.parameters:
        out |= {f"drifts:{name}": timeless, f"steps:{name}": nothing}
        out |= {} if name in own.per_run else {f"differs:{name}": one_run}
    for state in about.states:
        kinds = ("damping", "drag", "friction", "forcing", "periodic_forcing", "limit")
        out |= {f"{kind}:{state}": nothing for kind in kinds}
    return out
