"""Effects that a run's sensor model may leave out: probabilities, a sentence, and the repaired sensor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from probewise.calibration import FittedSensor
from probewise.effects import spoken_name
from probewise.effects.reading import AmbientStep, GainDrift, OffsetDrift
from probewise.experiment.pace import theta_in_seconds_of
from probewise.experiment.rivals import WITH_CARDS
from probewise.experiment.state import Step

CLEAN = "clean"
_CREDIBLE = 0.95
_NAMED = 0.5
# Effects in the time of one run, which do not belong to the sensor.
_OF_THE_RUN = frozenset({AmbientStep.name, OffsetDrift.name, GainDrift.name})
_ALIASES = (
    "No reading of the field can show a tilt of the sensor, an offset of the arm or one error of scale along both "
    "axes: each amounts to another shape."
)


@dataclass(frozen=True)
class LeftOutEffects:
    """Probability of each effect that the sensor model may leave out, most probable first ("clean": none); a sentence.

    `wary` holds the same probabilities with the odds of every effect multiplied by 12 (`posterior.WARY`).
    """

    probability: Mapping[str, float]
    wary: Mapping[str, float]
    sentence: str = ""

    @property
    def leading(self) -> str:
        """Name of the most probable effect, or "clean"."""
        return next(iter(self.probability))

    @property
    def credible_set(self) -> tuple[str, ...]:
        """The most probable names, which together have 95 %, and every other name with 5 % or more in `wary`."""
        held, names = 0.0, []
        for name, p in self.probability.items():
            if held < _CREDIBLE or self.wary[name] >= 1.0 - _CREDIBLE:
                names.append(name)
            held += p
        return tuple(names)

    def as_json(self) -> dict[str, Any]:
        """Return the entry "left_out" of result.json."""
        hypotheses = [
            {"effects": [] if name == CLEAN else [name], "probability": p} for name, p in self.probability.items()
        ]
        return {"hypotheses": hypotheses, "credible_set": list(self.credible_set), "sentence": self.sentence}


def left_out_after_step(last: Step, trust: float) -> LeftOutEffects:
    """Summarise the probabilities of left-out effects after a step, in a run with this `Experiment.trust`."""
    shares = sorted(((p, name or CLEAN) for name, p in last.left_out.items()), reverse=True)
    probability = {name: p for p, name in shares}
    wary = {name or CLEAN: p for name, p in last.kinds.with_raised_fault_odds.left_out.items()}
    if trust == 1:
        return LeftOutEffects(probability, wary, "The sensor model was taken for complete, as it was told to be.")
    name, p = next(iter(probability.items()))
    others = [spoken_name(n) for n in LeftOutEffects(probability, wary).credible_set[1:] if n != CLEAN]
    aliases = _ALIASES if WITH_CARDS.keys().isdisjoint(last.left_out) else ""
    beside = f" Not excluded: {', '.join(others)}." if others else ""
    if name == CLEAN:
        return LeftOutEffects(
            probability,
            wary,
            f"The sensor model leaves nothing out that shows (probability {p:.3g}).{beside} {aliases}".strip(),
        )
    if p < _NAMED:
        said = f"Something may be left out, most probably {spoken_name(name)} (probability {p:.3g})."
    else:
        said = f"The sensor model leaves something out: {_effect_sentence(last, name)} (probability {p:.3g})."
    return LeftOutEffects(probability, wary, f"{said}{beside} {aliases}".strip())


def _effect_sentence(last: Step, name: str) -> str:
    """Describe an effect, with its numbers if it has any."""
    best = max(
        (k for k, kind in enumerate(last.kinds.kinds) if kind.left_out == name), key=lambda k: last.kinds.log_odds[k]
    )
    kind = last.kinds.kinds[best]
    if kind.effect is None:
        return spoken_name(name)
    own = slice(-len(kind.effect.prior.names), None)
    posterior = last.kinds.particles[best].weighted
    mean, sd = (
        theta_in_seconds_of(kind.effect, moment[own], last.pace) for moment in (posterior.mean(), posterior.sd())
    )
    # A change is told by the clock of the readings, while paced time begins at the first of them.
    is_a_time = np.array([parameter == "at_s" for parameter in kind.effect.prior.names])
    return kind.effect.sentence(mean + last.pace.start_s * is_a_time, sd)


def repaired_sensor(sensor: FittedSensor, last: Step, *, rng: np.random.Generator) -> FittedSensor:
    """Return the sensor with the effect that a run found, with samples of its parameters after step `last`.

    If no effect has a probability of one half or more, the sensor is returned as it is. A noise effect, an effect in
    the time of the run, or an effect that the sensor has already, is only mentioned in a note. Where a diagnosis left
    it open whether the sensor has this effect, the run's answer counts: of the combinations of effects, the most
    probable one is kept, with the effect.
    """
    name, p = max(last.left_out.items(), key=lambda item: item[1])
    if not name or p < _NAMED:
        return sensor
    kinds = [k for k, kind in enumerate(last.kinds.kinds) if kind.left_out == name]
    best = max(kinds, key=lambda k: last.kinds.log_odds[k])
    effect = last.kinds.kinds[best].effect
    note = f"a run that explored with it found {spoken_name(name)} (probability {p:.3g})"
    if name in sensor.absent and effect is not None and name not in _OF_THE_RUN:
        sensor = sensor.with_leading_effects()  # the run's own model, which did not hold it
    if effect is None or name in _OF_THE_RUN or name in sensor.effects:
        return replace(sensor, notes=(*sensor.notes, f"{note}, which the model does not hold"))
    # What the sensor knew keeps its origins; the effect that was found has none, since a run's model counts from 0.
    n_own, n = len(effect.prior.names), len(sensor.samples)
    own = theta_in_seconds_of(effect, last.kinds.particles[best].weighted.samples(n, rng=rng)[:, -n_own:], last.pace)
    return replace(
        sensor,
        names=(*sensor.names, *(f"{name}.{parameter}" for parameter in effect.prior.names)),
        samples=np.concatenate([sensor.samples, own], axis=1),
        effects=(*sensor.effects, name),
        notes=(*sensor.notes, note),
    )
