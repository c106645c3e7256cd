"""The result of a diagnosis: verdict, probabilities, ranges of covariates, repair, next measurement."""

from __future__ import annotations

from dataclasses import dataclass

from probewise._display import ShowsItself
from probewise._kinds import require_kind
from probewise.diagnosis.advice.next_scans import NextMeasurement
from probewise.diagnosis.apparatus import Apparatus
from probewise.diagnosis.effect_words import hypothesis_in_words
from probewise.diagnosis.judgement.judged import Hypothesis, Judged, Verdict
from probewise.diagnosis.repair.improvement import Improvement
from probewise.diagnosis.repair.repair import Repair
from probewise.diagnosis.repair.samples import ModelSamples
from probewise.diagnosis.residuals.locate import ALARM, Place
from probewise.diagnosis.search.weighed_twice import Weighing
from probewise.diagnosis.verdict_report.beyond import Formula, Remainder
from probewise.diagnosis.verdict_report.findings import EffectFound, NoiseFound
from probewise.diagnosis.verdict_report.words import p_in_words
from probewise.effects import name_without_copy_suffix
from probewise.recordings.plan import Recording


@dataclass(frozen=True)
class VerdictReport:
    """The verdict in words and numbers: reason, effects, noise, log evidences, and what named effects do not explain.

    `weighings` are log evidences by Laplace's approximation and by nested sampling, if they were computed. `remainder`
    (a misfit after the repair) and `formula` are None if there is none. `is_settled`: whether one hypothesis on the
    mean has a probability of .95 or more.
    """

    reason: str
    effects: tuple[EffectFound, ...]
    noise: NoiseFound
    weighings: tuple[Weighing, ...] = ()
    remainder: Remainder | None = None
    formula: Formula | None = None
    is_settled: bool = False


@dataclass(frozen=True, eq=False)
class Diagnosis(ShowsItself):
    """The result of a diagnosis: the content of diagnosis.json, and the arrays for its figures.

    Attributes
    ----------
    recording
        The diagnosed recording (several are joined).
    judged
        Verdict, probabilities, aliases.
    repair
        The calibrated and the repaired model, and the gain.
    where
        Places (ranges of covariates) of the repair's effects, largest first, then of other significant residuals.
    next_measurement
        The next measurement to make; None if no question is open, or no readings would answer it.
    report
        The verdict in words, and the numbers of effects and noise.
    apparatus
        What took the readings: a light sensor, or a user's simulator over a table.
    """

    recording: Recording
    judged: Judged
    repair: Repair
    where: tuple[Place, ...]
    next_measurement: NextMeasurement | None
    report: VerdictReport
    apparatus: Apparatus

    @property
    def verdict(self) -> Verdict:
        """The verdict: clean, named, cannot_tell, unknown or noise."""
        return self.judged.verdict

    @property
    def reason(self) -> str:
        """The verdict and its reason, in a sentence or two."""
        return self.report.reason

    @property
    def p_value(self) -> float:
        """p-value of the global test of the calibrated model: small if an effect on the mean is missing."""
        return self.judged.p_value

    @property
    def combination(self) -> tuple[str, ...]:
        """Most probable set of effects; () if clean or none is named, ("unknown",) if unknown."""
        return self.judged.combination

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """All hypotheses (sets of effects) with their probabilities, most probable first."""
        return self.judged.hypotheses

    @property
    def effects(self) -> tuple[EffectFound, ...]:
        """Findings on the effects of probability above 0.001, most probable first."""
        return self.report.effects

    @property
    def improvement(self) -> Improvement:
        """Gain of the repaired model over the calibrated one."""
        return self.repair.improvement

    @property
    def null(self) -> ModelSamples:
        """Posterior samples of the calibrated model, without effects."""
        return self.repair.null

    @property
    def repaired(self) -> ModelSamples:
        """Posterior samples of the repaired model, with its effects."""
        return self.repair.model

    @property
    def unstated_effects(self) -> tuple[tuple[str, float, str], ...]:
        """Effects in the repaired model that are not in `effects`: name, share of the samples with it, sentence."""
        return self.repair.unstated_effects({effect.name for effect in self.effects})

    def summary(self) -> str:
        """Describe the diagnosis in plain text."""
        lines = [f"{self.verdict}: {self.reason}"]
        if self.verdict != "unknown" or self.p_value <= ALARM:  # otherwise the reason says why it does not count
            lines.append(_p_value_in_words(self.p_value))
        lines.append("probability  explanation")
        lines += [f"  {h.probability:9.3f}  {_with_code(h)}" for h in self.hypotheses[:5] if h.probability > 1e-3]
        # The reason is not repeated.
        lines += [
            f"{self.apparatus.words.as_sentence(e.sentence)} ({name_without_copy_suffix(e.name)}, probability "
            f"{e.probability:.3f} in all explanations together)"
            for e in self.effects
            if e.probability > 0.05 and e.sentence.lower() not in self.reason.lower()
        ]
        gain, unit = self.improvement, self.recording.plan.instrumentation.unit_after_number
        unit = f"{unit}{self.recording.weighting_in_words}"
        after, model = self.repair.after_in_words, self.apparatus.words.model
        if self.repair.changes_predictions:
            held = f"{gain.heldout_log_density_per_reading:+.4f} ± {gain.heldout_sd:.4f} nats per held-out reading"
            tested = held if gain.heldout_by_scan else "no reading could be held out"
            rms = f"{gain.rms_before:.4g} -> {gain.rms_after:.4g} {unit}".rstrip()
            lines.append(f"{after}: log evidence {gain.log_evidence:+.1f} nats, {tested}, rms of the residuals {rms}")
        elif self.verdict == "noise":
            lines.append(f"repaired noise model: log evidence {gain.log_evidence:+.1f} nats")
        if self.repair.by_rows:
            lines.append(f"the unknown effect is corrected in these readings only: {self.repair.not_in_model(model)}")
        lines += [
            f"in {share:.0%} of the repaired model's samples: {sentence}"
            for _, share, sentence in self.unstated_effects
        ]
        if self.repair.combination_shares:
            lines.append(f"samples of the repaired model contain {self.repair.shares_in_words}")
        return "\n".join(lines)


def _with_code(hypothesis: Hypothesis) -> str:
    """Return a hypothesis in words, followed by its label in diagnosis.json."""
    words, label = hypothesis_in_words(hypothesis.effects), hypothesis.label
    return words if words == label else f"{words} ({label})"


def _p_value_in_words(p_value: float) -> str:
    return f"{p_in_words(p_value)} (probability of readings at least this odd if nothing is missing from the mean)"


def require_diagnosis(diagnosis: object) -> None:
    """Raise ParameterError unless `diagnosis` is a Diagnosis."""
    require_kind("diagnosis", diagnosis, Diagnosis, "a Diagnosis, as diagnose and diagnose_system return it")
