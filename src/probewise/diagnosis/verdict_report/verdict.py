"""The Diagnosis value: what is missing, where, how sure, what it gains, what to measure next."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast

import numpy as np

from probewise._arrays import FloatArray, frozen
from probewise._display import ShowsItself
from probewise.diagnosis.advice.aliases import Alias
from probewise.diagnosis.advice.next_scans import NextMeasurement
from probewise.diagnosis.repair.mending import Improvement
from probewise.diagnosis.repair.repaired import ModelSamples
from probewise.diagnosis.residuals.locate import Place
from probewise.diagnosis.search.weighed_twice import Weighing
from probewise.diagnosis.verdict_report.words import p_in_words
from probewise.effects import NamedEffect
from probewise.recordings.plan import Recording

__all__ = [
    "Diagnosis",
    "EffectFound",
    "Hypothesis",
    "NoiseFound",
    "ParameterFound",
    "Verdict",
    "credible_set",
    "decide",
]

_OUT_OF_THE_QUESTION = 0.2  # of the leader's probability: more than priors make of likelihoods that are the same

Verdict: TypeAlias = Literal["clean", "named", "cannot_tell", "unknown", "noise"]


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects and its probability; () is clean, ("unknown",) what has no name."""

    effects: tuple[str, ...]
    probability: float

    @property
    def label(self) -> str:
        """Its name in a credible set."""
        return "+".join(self.effects) or "clean"


@dataclass(frozen=True)
class ParameterFound:
    """One parameter: posterior mean, sd and central 95 % interval."""

    name: str
    unit: str
    mean: float
    sd: float
    interval95: tuple[float, float]


@dataclass(frozen=True)
class EffectFound:
    """One effect: how probable, how large (lambda), what it does in words, its parameters, the scans it is bound to."""

    name: str
    probability: float
    size_lambda: float
    sentence: str
    parameters: tuple[ParameterFound, ...]
    scans: tuple[str, ...] = ()


@dataclass(frozen=True)
class NoiseFound:
    """The noise model, a test of what it leaves, its parameters."""

    model: str
    p_value: float
    parameters: tuple[ParameterFound, ...]


@dataclass(frozen=True, eq=False)
class Diagnosis(ShowsItself):
    """Hold everything of diagnosis.json, and the arrays that its figures show.

    Attributes
    ----------
    recording
        What was diagnosed, recordings joined.
    verdict, reason
        The verdict and one sentence.
    p_value
        That nothing is missing from the mean, under the noise model found.
    combination
        Most probable set of effects, sorted; () when clean, ("unknown",) when unknown.
    hypotheses
        All, most probable first; they sum to one.
    effects, unknown_probability, clean_probability, credible
        What each name, the unknown and clean amount to; the fewest hypotheses that hold 0.95.
    where, improvement, aliases, noise, next_measurement
        As in diagnosis.json.
    null, repaired
        The calibrated model and the repaired one, as posterior samples.
    residuals_before, residuals_after, predicted_before, predicted_after
        One a row, (n_points,); residuals are NaN where there is no usable reading.
    order_probabilities
        Probability of each number of Gaussians of a clean sensor's SSF.
    unknown_shares
        If something has no name, the probability that it depends on each covariate.
    weighings
        Hypotheses weighed twice, by Laplace and by nested sampling, where that was asked for.
    few
        Whether there are too few readings to say anything, or all are equal.
    corrected
        Whether what has no name is repaired by rows: `improvement` counts that, `repaired` does not carry it.
    """

    recording: Recording
    verdict: Verdict
    reason: str
    p_value: float
    combination: tuple[str, ...]
    hypotheses: tuple[Hypothesis, ...]
    effects: tuple[EffectFound, ...]
    unknown_probability: float
    clean_probability: float
    credible: tuple[str, ...]
    where: tuple[Place, ...]
    improvement: Improvement
    aliases: tuple[Alias, ...]
    noise: NoiseFound
    next_measurement: NextMeasurement | None
    null: ModelSamples
    repaired: ModelSamples
    residuals_before: FloatArray
    residuals_after: FloatArray
    predicted_before: FloatArray
    predicted_after: FloatArray
    order_probabilities: Mapping[int, float]
    unknown_shares: Mapping[str, float]
    weighings: tuple[Weighing, ...] = ()
    few: bool = False
    corrected: bool = False

    def __post_init__(self) -> None:
        for name in ("residuals_before", "residuals_after", "predicted_before", "predicted_after"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    @property
    def unknown_candidates(self) -> tuple[tuple[str, float], ...]:
        """What is outside the vocabulary, by the covariate in which it shows, with its share of the unknown."""
        if self.unknown_probability < 1e-3:
            return ()
        shares = sorted(self.unknown_shares.items(), key=lambda item: -item[1])
        return tuple((name, self.unknown_probability * share) for name, share in shares if share > 0.01)

    @property
    def is_repaired(self) -> bool:
        """Whether the repaired model predicts otherwise than the calibrated one."""
        return not np.array_equal(self.residuals_before, self.residuals_after, equal_nan=True)

    @property
    def left_open(self) -> dict[tuple[str, ...], float]:
        """Share of the repaired sensor's samples by which of the effects they hold that not all hold, largest first."""
        absent = self.repaired.absent
        if not absent:
            return {}
        held = Counter(zip(*(np.where(marks, "", name).tolist() for name, marks in absent.items()), strict=True))
        return {tuple(filter(None, names)): n / held.total() for names, n in held.most_common()}

    @property
    def carried(self) -> tuple[tuple[str, float, str], ...]:
        """What the repaired sensor carries and no hypothesis with a name has: name, share of the samples, sentence."""
        stated, out = {effect.name for effect in self.effects}, []
        for effect in cast(Sequence[NamedEffect[Any]], self.repaired.chain.effects):
            values = self.repaired.columns(effect.name)
            marks = self.repaired.absent.get(effect.name)
            held = values if marks is None else values[~marks]
            if effect.name not in stated and len(held):
                sentence = effect.sentence(held.mean(axis=0), held.std(axis=0))
                out.append((effect.name, len(held) / len(values), sentence))
        return tuple(out)

    def summary(self) -> str:
        """Describe the diagnosis in plain text."""
        lines = [f"{self.verdict}: {self.reason}", f"{p_in_words(self.p_value)} that nothing is missing from the mean"]
        lines += [f"  {h.probability:.3f}  {h.label}" for h in self.hypotheses[:5] if h.probability > 1e-3]
        lines += [f"{e.name} ({e.probability:.3f}): {e.sentence}" for e in self.effects if e.probability > 0.05]
        gain = self.improvement
        if self.is_repaired:
            held = f"{gain.heldout_log_density_per_reading:+.4f} ± {gain.heldout_sd:.4f} nats each"
            kept_back = f"readings kept back {held}" if gain.heldout_by_scan else "no reading could be kept back"
            lines.append(
                f"repaired: log evidence {gain.log_evidence:+.1f}, {kept_back}, "
                f"rms {gain.rms_before:.4g} -> {gain.rms_after:.4g}"
            )
        elif self.verdict == "noise":
            lines.append(f"the noise repaired: log evidence {gain.log_evidence:+.1f}")
        if self.corrected:
            lines.append("what has no name is put right in these readings alone: sensor.json does not carry it")
        lines += [f"in {share:.0%} of its samples: {sentence}" for _, share, sentence in self.carried]
        if self.left_open:
            shares = ", ".join(f"{' with '.join(n) or 'no effect'} in {p:.0%}" for n, p in self.left_open.items())
            lines.append(f"left open in its samples: {shares}")
        return "\n".join(lines)


def credible_set(hypotheses: tuple[Hypothesis, ...], mass: float = 0.95) -> tuple[str, ...]:
    """Name the fewest hypotheses that hold `mass`."""
    out, held = [], 0.0
    for hypothesis in sorted(hypotheses, key=lambda h: -h.probability):
        out.append(hypothesis.label)
        held += hypothesis.probability
        if held >= mass:
            break
    return tuple(out)


def decide(
    hypotheses: tuple[Hypothesis, ...],
    noise_names: frozenset[str],
    aliases: tuple[Alias, ...],
    alike: Callable[[tuple[str, ...]], frozenset[tuple[str, ...]]],
) -> tuple[Verdict, tuple[str, ...]]:
    """Turn probabilities into a verdict and the combination it names.

    A class of aliases is the combinations that differ only by swapping aliased effects; where it holds
    half the probability and none of its members does, the answer is `cannot_tell`. The same where
    clean leads without holding half, and where the readings cannot tell the leader from another that is
    not out of the question (`alike`): what tells those apart is what was believed before, not what was read.
    """
    probability = {h.effects: h.probability for h in hypotheses}
    if probability.get(("unknown",), 0.0) >= 0.5:
        return "unknown", ("unknown",)
    if probability.get((), 0.0) >= 0.5:
        return "clean", ()
    named = {effects: p for effects, p in probability.items() if effects not in ((), ("unknown",))}
    if not named:
        return "cannot_tell", ()
    top = max(named, key=lambda effects: named[effects])
    if named[top] >= 0.5:
        if any(named.get(other, 0.0) > _OUT_OF_THE_QUESTION * named[top] for other in alike(top)):
            return "cannot_tell", top
        return ("noise" if set(top) <= noise_names else "named"), top
    both_ways = [pair for a in aliases for pair in (a.effects, a.effects[::-1])]
    of_class = {top} | {tuple(sorted({*top} - {name} | {other})) for name, other in both_ways if name in top}
    if len(of_class) > 1 and sum(named.get(member, 0.0) for member in of_class) >= 0.5:
        return "cannot_tell", top
    if max(probability.get((), 0.0), probability.get(("unknown",), 0.0)) > named[top]:
        return "cannot_tell", ()
    return ("noise" if set(top) <= noise_names else "named"), top
