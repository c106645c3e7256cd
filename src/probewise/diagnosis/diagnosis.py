"""A diagnosis: its pipeline, from recordings to a `Diagnosis`, that result, and the content of diagnosis.json.

`diagnose_prepared` searches, tests, judges, repairs (which may change the verdict), draws samples, locates, and
advises. Each step takes the values of the steps before it and returns a new one.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.resources import files
from typing import Any, TypeAlias, cast

import numpy as np

from probewise._arrays import FloatArray, data_frame, own_arithmetic, read_only_floats
from probewise._display import Reported
from probewise._kinds import checked_texts, require_kind, require_like, require_one_of, require_progress, require_rng
from probewise.diagnosis.advice import NextMeasurement, choose_next_measurement, is_settled
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.best_repair import BestRepair, Improvement, improvement_and_correction, judged_and_best_repair
from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.findings import (
    EffectFound,
    Formula,
    NoiseFound,
    Remainder,
    effects_found,
    formula_of,
    noise_found,
    remainder_of,
)
from probewise.diagnosis.fit import Fit, Null
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.locate import ALARM, Place, places_of_effect, significant_places
from probewise.diagnosis.noise import walk_given_readings
from probewise.diagnosis.prepared import Prepared, prepare, rows_to_diagnose
from probewise.diagnosis.samples import ModelSamples, draw_models, sample_model
from probewise.diagnosis.search import MAX_ORDER, search, search_with_formulas
from probewise.diagnosis.search.hypotheses import Searched, effects_out_of_vocabulary
from probewise.diagnosis.search.thorough import Weighing, sentence_with_agreement
from probewise.diagnosis.sensors import SensorPrior
from probewise.diagnosis.verdict import (
    N_DRAWS,
    NEGLIGIBLE,
    OPEN,
    GlobalTest,
    Grounds,
    Judged,
    judge,
    reason_of,
    run_global_test,
    separating_readings_in_words,
)
from probewise.diagnosis.words import effects_in_words, hypothesis_in_words, join_lists, join_names, p_in_words
from probewise.effects import (
    EFFECTS,
    VOCABULARY,
    Effect,
    Extent,
    LightEffect,
    is_out_of_vocabulary,
    name_without_copy_suffix,
)
from probewise.effects.effect import require_effect_kinds, sentence_from_samples
from probewise.errors import ParameterError
from probewise.progress import Progress, silent
from probewise.recordings.patterns import Polygon
from probewise.recordings.plan import Recording, require_recording
from probewise.scene import Shape, outlines
from probewise.sensor import Stage


@dataclass(frozen=True, eq=False)
class PredictionAndResiduals:
    """A model's predicted readings of every row, and residuals, NaN without a usable reading: (n_points,) each.

    `walk`, (n_points,), is the random walk of the offset that all readings show about the prediction, by default 0.
    Residuals are what neither explains.
    """

    readings: FloatArray
    residuals: FloatArray
    walk: FloatArray = field(default_factory=lambda: np.zeros(1))

    def __post_init__(self) -> None:
        shaped = {"readings": self.readings, "residuals": self.residuals}
        for name, values in {**shaped, "walk": np.broadcast_to(self.walk, np.shape(self.readings))}.items():
            object.__setattr__(self, name, read_only_floats(values))

    @property
    def has_walk(self) -> bool:
        """Whether the noise contains a random walk."""
        return bool(np.any(self.walk))

    @property
    def readings_with_walk(self) -> FloatArray:
        """Predicted readings with the walk, (n_points,): what residuals count from."""
        return np.asarray(self.readings + self.walk)


def predictions_before_and_after(
    prepared: Prepared, best: BestRepair, change: FloatArray
) -> tuple[PredictionAndResiduals, PredictionAndResiduals]:
    """Return those of the null and of the repaired model, for every row, including rows not used in the diagnosis.

    `change`: correction of the predictions of the readings that are used, (n_usable,), 0 if there is none.
    """
    everything, law, used = prepared.everything, best.problem.law, prepared.usable_rows_of_everything
    readings, by_rows = np.where(everything.usable, everything.readings, np.nan), np.zeros(len(everything))
    by_rows[used] = change

    def shown(found: Fit, added: FloatArray) -> PredictionAndResiduals:
        model = replace(found.model, plan=everything.plan) if prepared.is_thinned else found.model
        predicted, left = np.asarray(model.predict(found.z[None, :])[0] + added), found.residuals - added[used]
        # Between readings, the expected walk is straight; it begins at 0 before the first row.
        known = walk_given_readings(law, left)
        walk = np.interp(np.arange(len(everything)), np.append(-1, used), np.append(0.0, known))
        if prepared.is_thinned:
            return PredictionAndResiduals(predicted, readings - predicted - walk, walk)
        return PredictionAndResiduals(predicted, prepared.expand_usable_to_all_rows(left - walk[used]), walk)

    return shown(best.calibrated, np.zeros(len(everything))), shown(best.repaired, by_rows)


_SAME = 0.8  # overlap from which two places hold the same rows


def locate_effects_and_residuals(
    searched: Searched,
    test: GlobalTest,
    judged: Judged,
    best: BestRepair,
    sizes: Mapping[str, float],
    *,
    rng: np.random.Generator,
) -> tuple[Place, ...]:
    """Return the places of the repair's effects, largest first, then of other significant residuals of the null.

    A place is a range of a covariate, such as time. Of several places with the same figure, only the first is kept.
    """
    prepared, problem, law = searched.prepared, test.problem, test.problem.law
    covariates, residuals = searched.misfit_templates.covariates, test.null.found.residuals
    plan, found = prepared.recording.plan.take(prepared.usable_rows), best.fit.found
    scans = next((c for c in covariates if c.name == "scan"), None)
    named: list[Place] = []
    for effect in sorted(found.model.effects, key=lambda e: -sizes.get(e.name, 0.0)):
        change, size = found.change_by_effect(effect.name, prepared.usable_rows), sizes.get(effect.name, 0.0)
        shows_in = prepared.apparatus.covariate_of_effect(effect, change, found.predicted - change, plan, covariates)
        if shows_in is not None:
            seen = (effect, change, shows_in, scans, plan, residuals)
            named += places_of_effect(*seen, p_value=judged.p_value, size=size)
    find = partial(significant_places, covariates=covariates, scan_names=prepared.recording.plan.scan_names)
    scanned = find(problem, residuals=residuals, draws=test.draws)
    if judged.verdict == "unknown" and not (named or scanned) and law.share:
        # Under heavy-tailed noise, residuals in outlying readings only are not significant.
        white = Linearised.of(test.null.found, law.without_tail_or_rounding())
        scanned = find(white, residuals=residuals, draws=white.draw_null_residuals(N_DRAWS, rng=rng))
    first: dict[str, Place] = {}
    for place in [*named, *_controls_before_time(scanned, prepared.apparatus.controls)]:
        first.setdefault(place.figure_name, place)
    return tuple(_place_in_everything(place, prepared) if prepared.is_thinned else place for place in first.values())


def _controls_before_time(places: Sequence[Place], controls: Sequence[str]) -> list[Place]:
    """Move the place of a control before that of time if they hold the same rows: what a person moves is the cause."""
    out = list(places)
    for place in places:
        at = next((k for k, other in enumerate(out) if other is place), 0)
        before = [k for k in range(at) if out[k].covariate in ("time", "row") and place.overlap(out[k]) >= _SAME]
        if place.covariate in controls and before:
            out.insert(before[0], out.pop(at))
    return out


def _place_in_everything(place: Place, prepared: Prepared) -> Place:
    """Return a place found in some of the readings with values at all usable ones, and scans by their numbers there."""
    values, at = place.values, place.curve_at
    if values is None:
        return place
    if place.covariate == "scan":
        number = np.unique(prepared.everything.plan.scan[rows_to_diagnose(prepared.everything)])
        values, at = (number[codes.astype(np.int64)].astype(np.float64) for codes in (values, at))
    everywhere = np.full(int(prepared.everything.usable.sum()), np.nan)
    usable = np.flatnonzero(prepared.everything.usable)
    everywhere[np.searchsorted(usable, prepared.usable_rows_of_everything)] = values
    return replace(place, values=everywhere, curve_at=at)


@dataclass(frozen=True, eq=False, kw_only=True)
class Diagnosis(Judged, Reported):
    """The result of a diagnosis, which is the verdict and more: all of diagnosis.json, and the arrays for its figures.

    `recording` is what was diagnosed (several are joined). `reason`: the verdict and its reason, in a sentence or two.
    `effects`: findings on those of probability above 0.001, most probable first. `null`, `repaired`: posterior samples
    of the calibrated model, without effects, and of the repaired one; `improvement`: the gain of the latter; `before`,
    `after`: predictions and residuals of both, for all rows, under the same noise.

    `by_rows`: whether an unknown effect is corrected row by row; `improvement` and `after` include that, `repaired`
    does not. `where`: places (ranges of covariates) of the repair's effects, largest first, then of other significant
    residuals. `next_measurement`: None if no question is open, or no readings would answer it. `is_settled`: whether
    one hypothesis on the mean has a probability of .95 or more. `weighings` are log evidences by Laplace's
    approximation and by nested sampling, if they were computed. `remainder` (a misfit after the repair) and `formula`
    are None if there is none.
    """

    recording: Recording
    apparatus: Apparatus
    reason: str
    effects: tuple[EffectFound, ...]
    noise: NoiseFound
    null: ModelSamples
    repaired: ModelSamples
    improvement: Improvement
    before: PredictionAndResiduals
    after: PredictionAndResiduals
    by_rows: bool = False
    where: tuple[Place, ...] = ()
    next_measurement: NextMeasurement | None = None
    is_settled: bool = False
    weighings: tuple[Weighing, ...] = ()
    remainder: Remainder | None = None
    formula: Formula | None = None

    @property
    def repair_changes_predictions(self) -> bool:
        """Whether the residuals of the repaired and of the calibrated model differ."""
        return not np.array_equal(self.before.residuals, self.after.residuals, equal_nan=True)

    @property
    def after_in_words(self) -> str:
        """What the later one of the two predictions is: "repaired", or, row by row, "corrected in these readings"."""
        return "corrected in these readings" if self.by_rows else "repaired"

    @property
    def noise_of_residuals_in_words(self) -> str:
        """Under which noise `before` and `after` are fitted, as written after their rms; "" under white noise."""
        return (
            ""
            if self.noise.model in ("white", "noise_sd")
            else ", fitted under the noise found, where a fit alone has white noise"
        )

    @property
    def not_in_model(self) -> str:
        """That the file of the model lacks the correction by rows, or which share of its samples has a formula."""
        model, named = self.apparatus.words.model, [n for n in self.repaired.effects if is_out_of_vocabulary(n)]
        marks = [self.repaired.absent.get(name, np.zeros(1, dtype=np.bool_)) for name in named]
        share = 1.0 - float(np.mean(np.logical_and.reduce(np.broadcast_arrays(*marks)))) if marks else 0.0
        if share:
            return f"of the samples in {model}, {100 * share:.0f} % contain a formula for it instead"
        return f"{model} does not contain it"

    @property
    def combination_shares(self) -> dict[tuple[str, ...], float]:
        """Shares of the repaired model's samples, largest first, by effects that not all of them contain; or {}."""
        absent = self.repaired.absent
        if not absent:
            return {}
        held = Counter(zip(*(np.where(marks, "", name).tolist() for name, marks in absent.items()), strict=True))
        return {tuple(filter(None, names)): n / held.total() for names, n in held.most_common()}

    @property
    def shares_in_words(self) -> str:
        """Which effects all samples of the repaired model contain, and which only a share of them, in words."""
        everywhere = tuple(name for name in self.repaired.effects if name not in self.repaired.absent)
        opening, nothing = "", "no effect"
        if everywhere:
            opening, nothing = f"{join_names(effects_in_words(everywhere))}; beside that ", "nothing more"
        held = (
            f"{hypothesis_in_words(names, nothing=nothing)} ({100 * share:.0f} %)"
            for names, share in self.combination_shares.items()
        )
        return opening + join_lists([*held])

    @property
    def unstated_effects(self) -> tuple[tuple[str, float, str], ...]:
        """Effects in the repaired model that are not in `effects`: name, share of the samples with it, sentence."""
        stated, out = {effect.name for effect in self.effects}, []
        for effect in cast(Sequence[Effect], self.repaired.chain.effects):
            values = self.repaired.effect_samples(effect.name)
            marks = self.repaired.absent.get(effect.name)
            held = values if marks is None else values[~marks]
            if effect.name not in stated and len(held):
                out.append((effect.name, len(held) / len(values), sentence_from_samples(effect, held)))
        return tuple(out)

    def with_shape_in_next_plan(self, shape: Shape) -> Diagnosis:
        """Return the diagnosis with undescribed patterns of its next plan as the unknown shape, at its mean."""
        asked, names = self.next_measurement, list(self.repaired.chain.names)
        if asked is None:
            return self
        believed = self.repaired.theta[:, [names.index(name) for name in shape.prior.names]].mean(axis=0)
        outline = outlines(shape.region(believed[None, :]))[0]
        polygon = Polygon(tuple((float(x), float(y)) for x, y in outline[:-1]))
        plan = asked.plan
        patterns = {name: plan.patterns.get(name, polygon) for name in plan.pattern_names}
        return replace(self, next_measurement=replace(asked, plan=replace(plan, patterns=patterns)))

    def to_frame(self) -> Any:
        """Return a pandas DataFrame of the explanations: `effects`, `words` and `probability`, a row each."""
        columns = {
            "effects": ["+".join(h.effects) for h in self.hypotheses],
            "words": [hypothesis_in_words(h.effects) for h in self.hypotheses],
            "probability": [h.probability for h in self.hypotheses],
        }
        return data_frame(columns)

    def summary(self) -> str:
        """Describe the diagnosis in plain text."""
        lines = [f"{self.verdict}: {self.reason}"]
        if self.verdict != "unknown" or self.p_value <= ALARM:  # otherwise the reason says why it does not count
            odd = "probability of readings at least this odd if nothing is missing from the mean"
            lines.append(f"{p_in_words(self.p_value)} ({odd})")
        lines.append("probability  explanation")
        for h in (h for h in self.hypotheses[:5] if h.probability > NEGLIGIBLE):
            words, code = hypothesis_in_words(h.effects), h.label
            lines.append(f"  {h.probability:9.3f}  {words if words == code else f'{words} ({code})'}")
        # The reason is not repeated.
        lines += [
            f"{self.apparatus.words.as_sentence(e.sentence)} ({name_without_copy_suffix(e.name)}, probability "
            f"{e.probability:.3f} in all explanations together)"
            for e in self.effects
            if e.probability > OPEN and e.sentence.lower() not in self.reason.lower()
        ]
        gain, unit = self.improvement, self.recording.plan.instrumentation.unit_after_number
        unit = f"{unit}{self.recording.weighting_in_words}"
        if self.repair_changes_predictions:
            held = f"{gain.heldout_log_density_per_reading:+.4f} ± {gain.heldout_sd:.4f} nats per held-out reading"
            tested = held if gain.heldout_by_scan else "no reading could be held out"
            rms = f"{gain.rms_before:.4g} -> {gain.rms_after:.4g} {unit}".rstrip() + self.noise_of_residuals_in_words
            gained = f"log evidence {gain.log_evidence:+.1f} nats, {tested}, rms of the residuals {rms}"
            lines.append(f"{self.after_in_words}: {gained}")
        elif self.verdict == "noise" and gain.log_evidence >= 0.05:  # rounding beyond doubt is in both models
            lines.append(f"repaired noise model: log evidence {gain.log_evidence:+.1f} nats")
        if self.by_rows:
            lines.append(f"the unknown effect is corrected in these readings only: {self.not_in_model}")
        lines += [
            f"in {share:.0%} of the repaired model's samples: {sentence}"
            for _, share, sentence in self.unstated_effects
        ]
        if self.combination_shares:
            lines.append(f"samples of the repaired model contain {self.shares_in_words}")
        return "\n".join(lines)


NEXT_PLAN = "next_plan.csv"


def diagnosis_schema() -> dict[str, Any]:
    """Return the JSON schema of diagnosis.json, format "diagnosis/1"."""
    text = files("probewise.diagnosis").joinpath("diagnosis.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema


def diagnosis_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Convert a diagnosis to the content of diagnosis.json, as strict JSON allows.

    Figures of places (`where`) and the next plan are given by file name; the report and the command line write them.
    """
    require_kind("diagnosis", diagnosis, Diagnosis, "a Diagnosis, as diagnose and diagnose_system return it")
    plan, remainder, formula = diagnosis.next_measurement, diagnosis.remainder, diagnosis.formula
    document: dict[str, Any] = {
        "format": "diagnosis/1",
        "verdict": diagnosis.verdict,
        "reason": diagnosis.reason,
        "p_value": diagnosis.p_value,
        "combination": _public_names(diagnosis.combination),
        "hypotheses": [asdict(h) | {"effects": _public_names(h.effects)} for h in diagnosis.hypotheses],
        "effects": [
            _without_empty_formula(e, "scans") | {"name": name_without_copy_suffix(e.name)} for e in diagnosis.effects
        ],
        "unknown_probability": diagnosis.unknown_probability,
        "clean_probability": diagnosis.clean_probability,
        "unknown_candidates": [{"name": name, "probability": p} for name, p in diagnosis.unknown_candidates],
        "credible_set": diagnosis.credible,
        "where": [
            {"covariate": place.covariate, "scan": place.scan, "from": place.start, "to": place.end}
            | {"p_value": place.p_value, "witness": place.figure_name}
            for place in diagnosis.where
        ],
        "improvement": _as_dict(diagnosis.improvement, "heldout_by_scan", "comes_next"),
        "aliases": [asdict(a) for a in diagnosis.aliases],
        "noise": _as_dict(diagnosis.noise, "nuisances"),
        "next_measurement": None,
    }
    if plan is not None:
        document["next_measurement"] = {
            "plan": diagnosis.apparatus.words.next_plan,
            "readings": len(plan.plan),
            "minutes": plan.minutes,
            "expected_log_bayes_factor": plan.expected_log_bayes_factor,
        }
    if remainder is not None:
        document["remainder"] = _without_empty_formula(remainder)
    if formula is not None:
        document["formula"] = asdict(formula)
    if diagnosis.weighings:
        document["thorough"] = [
            {"effects": _public_names(twice.effects), "n_gaussians": twice.n_gaussians}
            | {"log_evidence_laplace": twice.laplace, "log_evidence_nested": twice.nested}
            | {"error": twice.error, "agree": twice.agree, "doubts": twice.doubts}
            for twice in diagnosis.weighings
        ]
    plain: dict[str, Any] = json.loads(json.dumps(document))  # with lists for tuples
    return plain


def _public_names(effects: Iterable[str]) -> list[str]:
    return sorted(map(name_without_copy_suffix, effects))


def _as_dict(value: Any, *without: str) -> dict[str, Any]:
    return {key: own for key, own in asdict(value).items() if key not in without}


def _without_empty_formula(found: EffectFound | Remainder, *without: str) -> dict[str, Any]:
    return _as_dict(found, *without, *(() if found.formula else ("formula",)))


Thorough: TypeAlias = Callable[[Searched], tuple[Searched, tuple[Weighing, ...]]]
"""Function that recomputes the evidence of a search; returns it with better probabilities, and both evidences."""


def generators_of_diagnosis(seed: int) -> Sequence[np.random.Generator]:
    """Return the generators of a command's diagnosis, of its nested sampling, and of the samples in its files."""
    return np.random.default_rng(seed).spawn(3)


@own_arithmetic
def diagnose(
    recordings: Recording | Sequence[Recording],
    *,
    sensor: SensorPrior | None = None,
    null: Null | None = None,
    effects: Mapping[str, LightEffect] = VOCABULARY,
    thorough: Thorough | None = None,
    hands: bool = True,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Diagnosis:
    """Diagnose what physics the sensor model leaves out of these recordings, as `probewise.diagnose` does.

    Of more than 2,400 readings, about that many are used, in scans spread over all of them; residuals and predictions
    cover every row. Arguments, result and errors are those of `probewise.diagnose`, and:

    Parameters
    ----------
    null
        Another null model instead of a calibrated sensor: `SensorAndShape` for an unknown shape. Not with a `sensor`.
    effects
        The vocabulary of effects, by name. `RARE_EFFECTS` are tried too; they are named where hardly anything
        else out of vocabulary explains the readings.
    thorough
        Function that computes the evidence of the leading hypotheses a second time, such as
        `partial(weigh_thoroughly, rng=rng)`, by nested sampling.
    hands
        Whether a person can exchange or turn sheets for the next readings; if not, the next scans are over the sheet in
        place.
    """
    require_rng(rng)
    require_progress(progress)
    require_effect_kinds(effects)
    if null is not None:
        allowed = "a null model: SensorAndShape, of probewise.diagnosis; a sensor is sensor="
        require_like("null", null, ("admits", "starts", "n_params"), allowed)
    prepared = prepare(recordings, sensor=sensor, null=null, apparatus=LightSensorApparatus(dict(effects), hands))
    return diagnose_prepared(prepared, thorough=thorough, progress=progress, rng=rng)


def diagnose_prepared(
    prepared: Prepared,
    *,
    searched: Searched | None = None,
    thorough: Thorough | None = None,
    progress: Progress = silent,
    rng: np.random.Generator,
) -> Diagnosis:
    """Run the pipeline of `diagnose` on the input of any apparatus, or on the result of a search in it."""
    searched = searched or search_with_formulas(search(prepared, progress=progress), progress=progress)
    prepared, weighings = searched.prepared, tuple[Weighing, ...]()  # with the formulas that it tried
    if prepared.has_too_little_data:
        searched = searched.with_prior_probabilities()
    elif thorough is not None:
        searched, weighings = thorough(searched)
    progress("testing the residuals")
    test = run_global_test(searched, rng=rng)
    progress("testing the repair on held-out readings")
    judged, best = judged_and_best_repair(searched, test, judge(searched, test), rng=rng)
    null, samples, repaired = draw_models(searched, test, judged, best, rng=rng, progress=progress)
    found = effects_found(searched, judged.hypotheses, best, samples, rng=rng)
    progress("locating the residuals")
    where = locate_effects_and_residuals(searched, test, judged, best, {e.name: e.size_lambda for e in found}, rng=rng)
    change, is_unknown = np.zeros(len(prepared.usable_rows)), judged.verdict == "unknown"
    if is_unknown and not effects_out_of_vocabulary(best.fit.names):
        improvement, change = improvement_and_correction(searched, test, best, rng=rng)
        best = replace(best, improvement=improvement)
    progress("choosing the next readings")
    shows_in = next(iter(where), None)
    asked = choose_next_measurement(searched, test.null, unknown_shows_in=shows_in, is_unknown=is_unknown)
    noise = noise_found(searched, best, samples, rng=rng)
    remainder = remainder_of(searched, judged, best, rng=rng)
    before, after = predictions_before_and_after(prepared, best, change)
    diagnosis = Diagnosis(
        recording=prepared.everything,
        apparatus=prepared.apparatus,
        **vars(judged),
        reason="",
        effects=found,
        noise=noise,
        null=null,
        repaired=repaired,
        improvement=best.improvement,
        before=before,
        after=after,
        by_rows=bool(np.any(change)),
        where=where,
        next_measurement=asked,
        is_settled=is_settled(searched),
        weighings=weighings,
        remainder=remainder,
        formula=formula_of(searched, judged, best, samples),
    )
    return replace(diagnosis, reason=_reason(diagnosis, searched, test, best, samples))


def _reason(diagnosis: Diagnosis, searched: Searched, test: GlobalTest, best: BestRepair, samples: ModelSamples) -> str:
    """Return the verdict and its reason in words; `samples` are those of the best repair."""
    prepared, shares = searched.prepared, searched.evidences.unknown_shares
    beside = searched.likeliest_fit_beside_unknown(test.noise)
    formulas = [effect for effect in best.fit.found.model.effects if effects_out_of_vocabulary((effect.name,))]
    settles, apart = separating_readings_in_words(searched, diagnosis, diagnosis.next_measurement)
    grounds = Grounds(
        words=prepared.apparatus.words,
        n_readings=len(prepared.usable_rows),
        least_readings=prepared.least_readings,
        form=searched.null.found.model.sensor.ssf_in_words,
        sentences={effect.name: effect.sentence for effect in diagnosis.effects},
        like=tuple(sentence_from_samples(each, samples.effect_samples(each.name)) for each in formulas),
        family=max(shares, key=lambda family: shares[family], default=""),
        beside=beside.names if beside else (),
        shows_in=tuple(place.covariate for place in diagnosis.where),
        p_value_after=diagnosis.improvement.p_value_after,
        nuisances=diagnosis.noise.nuisances,
        settles=settles,
        apart=apart,
    )
    reason = sentence_with_agreement(reason_of(diagnosis, grounds), diagnosis.weighings)
    if prepared.is_thinned:
        n_usable = int(prepared.everything.usable.sum())
        reason += f" (From {len(prepared.usable_rows)} of {n_usable} readings, evenly spread.)"
    return reason


def model_with(recording: Recording, names: Sequence[str], *, rng: np.random.Generator) -> ModelSamples:
    """Fit the sensor with these effects, at the SSF order (number of Gaussians) with the largest evidence.

    `names` are of `EFFECTS`, in the vocabulary or out of it; empty for the calibrated sensor alone. The samples are
    without any effect on the mean if the search kept no refit with all of them, and without the noise effects (but
    those beyond doubt) if it kept no noise model of just these.

    Raises ParameterError if there is no effect of a name, or it cannot act in this recording.
    """
    require_recording(recording)
    require_rng(rng)
    names = checked_texts("names", names, "names of effects")
    extent, allowed = Extent.of(recording), "effects of the vocabulary that this recording can show"
    effects: dict[str, Effect] = {}
    for name in names:
        require_one_of("names", name, list(EFFECTS))
        effect = EFFECTS[name].for_extent(extent)
        if effect is None:
            raise ParameterError("names", name, allowed)
        effects[name] = effect
    prepared = Prepared(recording, effects, None, LightSensorApparatus(), recording)
    found = search(prepared, max_order=MAX_ORDER, depth=max(len(names), 1))
    on_mean = tuple(sorted(name for name, effect in effects.items() if effect.stage is not Stage.NOISE))
    on_noise = tuple(sorted(set(names) - set(on_mean)))
    noise = on_noise if on_noise in found.refits.noises.models else found.certain
    best = found.best_refit_of(on_mean, noise) or found.best_refit_of((), noise)
    assert best is not None  # the calibrated sensor is always fitted
    if not np.isfinite(best.evidence[noise].log_z):
        raise ParameterError("names", ", ".join(noise), allowed)
    return sample_model(best.found, best.evidence[noise], recording, weights=best.weights, rng=rng)
