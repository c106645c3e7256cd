"""Find the mismatch, name the physics, model it, show the gain: the road from recordings to a Diagnosis."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.advice.aliases import Alias, aliases, settle
from probewise.diagnosis.advice.rivals import next_readings
from probewise.diagnosis.evidence.convergence import require_converged
from probewise.diagnosis.evidence.laplace import Blocks, Linearised
from probewise.diagnosis.fitting.coordinates import LEAST_READINGS
from probewise.diagnosis.fitting.earlier import SensorPrior, require_same_unit, sensor_of
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.joining import join
from probewise.diagnosis.repair.ensemble import Ensemble
from probewise.diagnosis.repair.mending import Improvement, corrected, improvement_of
from probewise.diagnosis.repair.repaired import ModelSamples
from probewise.diagnosis.residuals.fine_structure import fine_structure
from probewise.diagnosis.residuals.locate import ALARM, Place, global_p_value, places, places_of_effect
from probewise.diagnosis.search.search import search
from probewise.diagnosis.search.weighed_fit import Search, WeighedFit, in_vocabulary, out_of_vocabulary
from probewise.diagnosis.search.weighed_twice import Weighing, with_agreement
from probewise.diagnosis.thinning import rows_to_diagnose
from probewise.diagnosis.verdict_report.reasons import reason_of
from probewise.diagnosis.verdict_report.stating import effects_found, noise_found
from probewise.diagnosis.verdict_report.verdict import (
    Diagnosis,
    EffectFound,
    Hypothesis,
    credible_set,
    decide,
)
from probewise.effects import NUISANCES, UNNAMED, VOCABULARY, Extent, NamedEffect
from probewise.errors import ParameterError
from probewise.recordings.plan import Recording
from probewise.sensor import Stage

__all__ = ["Thorough", "diagnose"]

Names = tuple[str, ...]

Thorough: TypeAlias = Callable[[Search], tuple[Search, tuple[Weighing, ...]]]
"""Weighs again what a search has weighed: gives it with better probabilities, and what was weighed twice."""

N_DRAWS = 999
_NO_ALARM = 0.05  # by any rule, so that no other form of the SSF need be asked
_LEAST_DOUBT = 0.1  # that what has no name is what it looks most like
_RUIN = -1.0  # nats a reading kept back, below which what was named repairs nothing
_DOUBT_BESIDE = 0.5  # of what has a name, where something that has none is beside it


def diagnose(
    recordings: Recording | Sequence[Recording],
    *,
    sensor: SensorPrior | None = None,
    null: Null | None = None,
    effects: Mapping[str, type[NamedEffect[Any]]] = VOCABULARY,
    thorough: Thorough | None = None,
    rng: np.random.Generator,
) -> Diagnosis:
    """Tell what physics the sensor model leaves out of these recordings.

    Parameters
    ----------
    recordings
        One, or the first and those that it asked for. Of more than 2,400 readings as many are diagnosed, in
        scans spread over all of them; residuals and predictions are given for every row.
    sensor
        An earlier posterior of the sensor, taken as the prior; without it the null is calibrated here.
    null
        What is to be diagnosed instead of a calibrated sensor: `SensorAndShape`, where what lies under it
        is not known, or `OwnModel`, any simulator.
    effects
        The vocabulary to choose from, by name. What is outside it counts as unknown, also where it has a
        name of our own (`UNNAMED`).
    thorough
        Weighs what leads a second time: `weigh_thoroughly`, by nested sampling.
    rng
        Source of randomness, for the null laws of the tests and the posterior samples.

    Returns
    -------
    Diagnosis
        Verdict, probabilities, places, gain, aliases, the repaired model and the next measurement.

    Raises
    ------
    ParameterError
        If there is no usable reading, or units differ, or two recordings are the same, or both a sensor and a null are
        given.
    NotConvergedError
        If the fit of the null did not arrive anywhere.
    """
    if sensor is not None and null is not None:
        raise ParameterError("sensor, null", "both", "one of them: a null holds what is known of its sensor")
    everything = join([recordings] if isinstance(recordings, Recording) else list(recordings))
    rows = rows_to_diagnose(everything)
    recording = everything if len(rows) == len(everything) else everything.take(rows)
    extent = Extent.of(recording)
    fitted = {name: kind.for_extent(extent) for name, kind in {**effects, **UNNAMED, **NUISANCES}.items()}
    known = null
    if sensor is not None:
        require_same_unit(sensor, everything.plan)
        known = sensor_of(sensor)
    able = {name: effect for name, effect in fitted.items() if effect is not None}
    built = {
        name: effect
        for name, effect in able.items()
        if (known.admits(effect) if known is not None else not effect.is_of_the_ssf(recording.plan))
    }
    diagnoser = _Diagnoser(recording, built, known, thorough, rng)
    found = diagnoser.run()
    return found if recording is everything else _of_everything(found, diagnoser.fits, everything)


@dataclass(eq=False)
class _Diagnoser:
    recording: Recording
    built: Mapping[str, NamedEffect[Any]]
    sensor: Null | None
    thorough: Thorough | None
    rng: np.random.Generator

    @property
    def least_readings(self) -> int:
        """Fewest usable readings that a verdict is given on."""
        return LEAST_READINGS if self.sensor is None else self.sensor.least_readings

    def run(self) -> Diagnosis:
        self.usable: IntArray = np.flatnonzero(self.recording.usable)
        n = len(self.usable)
        constant = float(np.ptp(self.recording.readings[self.usable])) == 0.0
        few = n < self.least_readings or constant
        self.search: Search = search(self.recording, self.built, sensor=self.sensor, max_order=1 if n < 40 else 3)
        weighings: tuple[Weighing, ...] = ()
        if self.thorough is not None and not few:
            self.search, weighings = self.thorough(self.search)
        self.noise_names = frozenset(k for k, e in self.built.items() if e.stage is Stage.NOISE)
        if few:  # they say nothing, whatever the evidence makes of them
            on_mean = [k for k, e in self.built.items() if e.stage is not Stage.NOISE and k not in UNNAMED]
            believed = self.search.prior.alone(on_mean, self.search.certain)
            self.search = replace(self.search, probabilities=believed)
        probabilities = self.search.probabilities
        hypotheses = _hypotheses(probabilities)
        noise = self._most_probable_noise(probabilities)
        null = self.search.candidates[self.search.order, ()]
        problem = Linearised.of(null.found, null.evidence[noise].law)
        if not few:
            require_converged(null.found, Linearised.of(null.found, null.law))
        draws = problem.draws(N_DRAWS, rng=self.rng)

        p_value = self._p_value(null, noise, problem, draws)
        pairs = self._aliases(problem, null.found)
        verdict, combination = decide(hypotheses, self.noise_names, tuple(pairs), self._alike)
        # Physics is named only where the test that counts every look has raised an alarm too.
        if few or (verdict == "named" and p_value > ALARM):
            verdict, combination = "cannot_tell", ()
        if constant:
            p_value = 1.0  # readings that never change carry no noise to measure a residual by

        mean_names = tuple(name for name in combination if name in self.built and name not in self.noise_names)
        foreseen = self._foreseen()
        noise_of = noise
        if verdict in ("named", "noise", "clean"):
            stated = tuple(name for name in combination if name in self.noise_names)
            noise_of = self._most_probable_noise(
                {key: p for key, p in probabilities.items() if in_vocabulary(key[1]) == stated}
            )
        if verdict == "unknown":
            best = (self.search.best(foreseen, noise) if foreseen else self.search.beside(noise)) or null
        else:
            best = self.search.best(mean_names, noise_of) or null
        after, improvement = self._judged(null, best, noise_of, p_value)
        fails = verdict == "named" and improvement.heldout_log_density_per_reading < _RUIN
        if fails:  # what explains these readings alone is no repair
            verdict, combination, best = "cannot_tell", (), null
            after, improvement = self._judged(null, best, noise_of, p_value)
        self.fits = null.found, best.found
        ensemble = Ensemble(self.search, noise_of, self.rng)
        written = samples = ensemble.of(best)
        if verdict == "unknown" and best is not null:
            share = max(1 - self.search.by_mean[foreseen], _LEAST_DOUBT) if foreseen else _DOUBT_BESIDE
            written = ensemble.averaged(best, {best.names: 1 - share, (): share})
        elif verdict in ("named", "cannot_tell") and best.names:
            written = ensemble.averaged(best, ensemble.likely(best))
        elif not (few or fails):
            written = self._left_open(ensemble, null, noise_of, p_value)
        null_samples = samples if best is null else ensemble.of(null)
        effects = effects_found(self.search, hypotheses, best, samples, noise_of, rng=self.rng)
        where = self._where(null, problem, draws, best, effects, p_value)
        if verdict == "unknown" and not where and problem.law.share:
            # What only readings far out show is noise to a tail.
            plain = Linearised.of(null.found, problem.law.plain())
            where = self._where(null, plain, plain.draws(N_DRAWS, rng=self.rng), best, effects, p_value)
        residuals_after, change = best.found.residuals, np.zeros(len(self.recording))
        if verdict == "unknown" and not foreseen:
            improvement, correction = corrected(self.search, null, best, after, noise, improvement, rng=self.rng)
            residuals_after = residuals_after - correction
            change[self.usable] = correction
        candidates = [
            e.sentence(*_moments(samples.columns(e.name))) for e in best.found.model.effects if e.name in UNNAMED
        ]
        asked = next_readings(self.search, null)
        reason = reason_of(
            self.search,
            verdict,
            combination,
            hypotheses,
            effects,
            p_value,
            improvement.p_value_after,
            fails,
            few,
            asked,
            where,
            noise,
            candidates,
            self.least_readings,
        )
        predicted_before, predicted_after = (c.found.model.predict(c.found.z[None, :])[0] for c in (null, best))
        return Diagnosis(
            recording=self.recording,
            verdict=verdict,
            reason=with_agreement(reason, weighings),
            p_value=p_value,
            combination=combination,
            hypotheses=hypotheses,
            effects=effects,
            unknown_probability=next((h.probability for h in hypotheses if h.effects == ("unknown",)), 0.0),
            clean_probability=next((h.probability for h in hypotheses if not h.effects), 0.0),
            credible=credible_set(hypotheses),
            where=tuple(where),
            improvement=improvement,
            aliases=tuple(pairs),
            noise=noise_found(self.search, best, noise_of, after, samples, rng=self.rng),
            next_measurement=asked,
            null=null_samples,
            repaired=written,
            residuals_before=self._spread(null.found.residuals),
            residuals_after=self._spread(residuals_after),
            predicted_before=predicted_before,
            predicted_after=predicted_after + change,
            order_probabilities=dict(self.search.order_probabilities),
            unknown_shares=self._unknown_shares(),
            weighings=weighings,
            few=few,
            corrected=bool(np.any(change)),
        )

    def _judged(
        self, null: WeighedFit, best: WeighedFit, noise: Names, p_value: float
    ) -> tuple[Linearised, Improvement]:
        """Lay the repaired model out as a linear problem, and measure what it gains over the null."""
        after = Linearised.of(best.found, best.evidence[noise].law)
        return after, improvement_of(self.search, null, best, noise, after, p_value, rng=self.rng)

    def _left_open(self, ensemble: Ensemble, null: WeighedFit, noise: Names, p_value: float) -> ModelSamples:
        """Average over hypotheses where none is stated: what has a name may be it all the same, the rest is plain."""
        by_mean = self.search.by_mean
        named = {names for _, names in self.search.candidates if not out_of_vocabulary(names)}
        best = self.search.best(max(named, key=lambda names: by_mean.get(names, 0.0)), noise) or null
        if best.names and self._judged(null, best, noise, p_value)[1].heldout_log_density_per_reading < _RUIN:
            return ensemble.of(null)
        shares = {names: by_mean.get(names, 0.0) for names in ensemble.likely(best) if names}
        return ensemble.averaged(best, {**shares, (): 1 - sum(shares.values())})

    def _p_value(self, null: WeighedFit, noise: Names, problem: Linearised, draws: FloatArray) -> float:
        """Test that nothing is missing from the mean, be the SSF of the null's order, of a greater one, or finer still.

        The evidence grants a Gaussian only where it gains the ten nats and more that it costs; what an SSF that is no
        mixture leaves below that is no physics. So an alarm must stand at every order, and beside fine structure about
        the freest, and the greatest p-value counts.
        """
        p_value = global_p_value(problem, self.search.looks(null.found), draws)
        freer = sorted(n for n, names in self.search.candidates if not names and n > null.n_gaussians)
        rivals = [self.search.candidates[n, ()] for n in freer]
        asked = [(rival, False) for rival in rivals]
        if self.sensor is None:  # what is known is not forgotten: that it was turned shows by that alone
            asked.append(((rivals or [null])[-1], True))
        for rival, fine in asked:
            if p_value > _NO_ALARM:
                break
            found = rival.found
            beside = fine_structure(found.model, found.z, self.usable) if fine else None
            problem = Linearised.of(found, rival.evidence[noise].law, beside)
            own = problem.draws(N_DRAWS, rng=self.rng)
            p_value = max(p_value, global_p_value(problem, self.search.looks(found), own))
        return p_value

    def _most_probable_noise(
        self, probabilities: Mapping[tuple[tuple[str, ...], tuple[str, ...]], float]
    ) -> tuple[str, ...]:
        marginal: dict[tuple[str, ...], float] = {}
        for (_, noise), p in probabilities.items():
            marginal[noise] = marginal.get(noise, 0.0) + p
        return max(marginal, key=lambda k: marginal[k])

    def _foreseen(self) -> Names:
        """Name the leading refitted combination with something outside the vocabulary, if it leads what is unknown."""
        by_mean = self.search.by_mean
        own = {names: p for names, p in by_mean.items() if out_of_vocabulary(names)}
        refitted = {names for _, names in self.search.candidates}
        leader = max(own, key=lambda names: own[names], default=())
        return leader if leader in refitted and own.get(leader, 0.0) > by_mean.get(("unknown",), 0.0) else ()

    def _unknown_shares(self) -> dict[str, float]:
        """Share what is unknown out over the names of our own, and over covariates for what has none."""
        by_mean = self.search.by_mean
        shares = {family: by_mean.get(("unknown",), 0.0) * p for family, p in self.search.unknown_shares.items()}
        for names, p in by_mean.items():
            for name in out_of_vocabulary(names):
                shares[name] = shares.get(name, 0.0) + p
        total = sum(shares.values()) or 1.0
        return {name: p / total for name, p in shares.items()}

    def _spread(self, values: FloatArray) -> FloatArray:
        out = np.full(len(self.recording), np.nan)
        out[self.usable] = values
        return out

    def _aliases(self, problem: Linearised, found: Fit) -> list[Alias]:
        """Compare what survives of the effects, each by the entry of its bank that fits best here."""
        telling: dict[str, FloatArray] = {}
        chosen: dict[str, NamedEffect[Any]] = {}
        for name, effect in self.built.items():
            if name in self.noise_names or name in UNNAMED:
                continue
            templates = self.search.templates.of(self.search.about, effect.coarse())
            blocks = Blocks.of(problem, templates.columns, [name] * len(templates.columns))
            scores = np.add.reduceat((blocks.u.T @ problem.residual) ** 2, blocks.starts)
            best = int(np.argmax(scores))
            telling[name], chosen[name] = templates.columns[best], templates.variant(best)
        return settle(aliases(problem, telling), found, chosen, problem.sd)

    def _alike(self, combination: Names) -> frozenset[Names]:
        """Give the combinations whose effects on the mean the readings cannot tell from these, the noise the same."""
        noise = {name for name in combination if name in self.noise_names}
        others = self.search.alike(tuple(name for name in combination if name not in noise))
        return frozenset(tuple(sorted({*names, *noise})) for names in others)

    def _where(
        self,
        null: WeighedFit,
        problem: Linearised,
        draws: FloatArray,
        best: WeighedFit,
        effects: tuple[EffectFound, ...],
        p_value: float,
    ) -> list[Place]:
        """Say where what was named is, the largest first; then where else the residual stands out."""
        covariates, residuals = self.search.covariates, null.found.residuals
        plan = self.recording.plan.take(self.usable)
        sizes = {effect.name: effect.size_lambda for effect in effects}
        named: list[Place] = []
        for effect in sorted(best.found.model.effects, key=lambda e: -sizes.get(e.name, 0.0)):
            change = best.found.change_by(effect.name, self.usable)
            named += places_of_effect(
                effect,
                change,
                best.found.predicted,
                plan,
                covariates,
                residuals,
                p_value=p_value,
                size=sizes.get(effect.name, 0.0),
                sd=problem.sd,
            )
        scanned = places(problem, covariates, self.recording.plan.scan_names, residuals, draws)
        first: dict[str, Place] = {}
        for place in [*named, *scanned]:
            first.setdefault(place.witness, place)
        return list(first.values())


def _of_everything(found: Diagnosis, fits: tuple[Fit, Fit], everything: Recording) -> Diagnosis:
    """Carry what part of a recording told to the whole of it: predictions and residuals of every row."""
    predicted = [replace(fit.model, plan=everything.plan).predict(fit.z[None, :])[0] for fit in fits]
    readings = np.where(everything.usable, everything.readings, np.nan)
    return replace(
        found,
        recording=everything,
        reason=f"{found.reason} (From {len(found.recording)} of {len(everything)} readings, spread over all.)",
        residuals_before=readings - predicted[0],
        residuals_after=readings - predicted[1],
        predicted_before=predicted[0],
        predicted_after=predicted[1],
    )


def _hypotheses(
    probabilities: Mapping[tuple[tuple[str, ...], tuple[str, ...]], float],
) -> tuple[Hypothesis, ...]:
    """Join mean and noise into combinations; unknown is one hypothesis under any noise."""
    joined: dict[tuple[str, ...], float] = {}
    for (mean, noise), p in probabilities.items():
        unknown = mean == ("unknown",) or out_of_vocabulary(mean)
        key = ("unknown",) if unknown else tuple(sorted((*mean, *in_vocabulary(noise))))
        joined[key] = joined.get(key, 0.0) + p
    total = sum(joined.values())
    ranked = sorted(joined.items(), key=lambda item: -item[1])
    return tuple(Hypothesis(key, p / total) for key, p in ranked)


def _moments(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    return np.asarray(values.mean(axis=0)), np.asarray(values.std(axis=0))
