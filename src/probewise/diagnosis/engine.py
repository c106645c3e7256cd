"""Find the mismatch, name the physics, model it, show the gain: the road from recordings to a Diagnosis."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeAlias

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.audit import (
    Alias,
    NextMeasurement,
    aliases,
    covariance_of,
    next_measurement,
    settle,
)
from probewise.diagnosis.bank import Bank
from probewise.diagnosis.convergence import require_converged
from probewise.diagnosis.coordinates import LEAST_READINGS, sensor_from_posterior
from probewise.diagnosis.evidence import Blocks, Linearised
from probewise.diagnosis.fit import Fit, Model, fit
from probewise.diagnosis.gain import held_out_gain
from probewise.diagnosis.joining import join
from probewise.diagnosis.locate import Place, global_p_value, places, places_of_effect
from probewise.diagnosis.noise import noise_statistics, steps_within_scans
from probewise.diagnosis.null import Null
from probewise.diagnosis.repaired import ModelSamples, doubted, over_orders, sample_model
from probewise.diagnosis.search import search
from probewise.diagnosis.thinning import rows_to_diagnose
from probewise.diagnosis.unknown import correct
from probewise.diagnosis.verdict import (
    Diagnosis,
    EffectFound,
    Hypothesis,
    Improvement,
    NoiseFound,
    ParameterFound,
    Verdict,
    credible_set,
    decide,
)
from probewise.diagnosis.weighed import Candidate, Search
from probewise.diagnosis.weighing import Weighing, with_agreement
from probewise.effects import NUISANCES, UNNAMED, VOCABULARY, Extent, NamedEffect
from probewise.errors import ParameterError
from probewise.inference import sd_floor
from probewise.recordings.plan import Plan, Recording
from probewise.sensor import Stage

__all__ = ["SensorPrior", "Thorough", "diagnose"]

Names = tuple[str, ...]

Thorough: TypeAlias = Callable[[Search], tuple[Search, tuple[Weighing, ...]]]
"""Weighs again what a search has weighed: gives it with better probabilities, and what was weighed twice."""

N_DRAWS = 999
_LEAST_PROBABILITY = 1e-3
_ALARM = 0.01
_LEAST_DOUBT = 0.1  # that what has no name is what it looks most like
_DOUBT_BESIDE = 0.5  # of what has a name, where something that has none is beside it
_LEAST_OF_AN_ORDER = 0.2  # probability of an SSF order, below which the model does without it
_FOR_A_MEAN = 8  # samples whose mean prediction stands for the posterior's


class SensorPrior(Protocol):
    """An earlier posterior of the sensor: a FittedSensor, or anything with its names and samples."""

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names, one a column."""
        ...

    @property
    def samples(self) -> FloatArray:
        """Posterior samples, (n_samples, n_params)."""
        ...


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
        If there is no usable reading, or units differ, or both a sensor and a null are given.
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
    floor = sd_floor(recording)
    known = null
    if sensor is not None:
        samples = np.asarray(sensor.samples, dtype=np.float64)
        known = sensor_from_posterior(sensor.names, samples.mean(axis=0), np.cov(samples.T))
    able = {name: effect for name, effect in fitted.items() if effect is not None}
    built = {name: effect for name, effect in able.items() if known is None or known.admits(effect)}
    found = _Diagnoser(recording, built, known, floor, thorough, rng).run()
    return found if recording is everything else _of_everything(found, everything)


@dataclass(eq=False)
class _Diagnoser:
    recording: Recording
    built: Mapping[str, NamedEffect[Any]]
    sensor: Null | None
    floor: float
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
        self.search: Search = search(
            self.recording, self.built, sensor=self.sensor, sd_floor=self.floor, max_order=1 if n < 40 else 3
        )
        weighings: tuple[Weighing, ...] = ()
        if self.thorough is not None and not few:
            self.search, weighings = self.thorough(self.search)
        self.noise_names = frozenset(k for k, e in self.built.items() if e.stage is Stage.NOISE)
        probabilities = self.search.probabilities
        hypotheses = _hypotheses(probabilities)
        noise = self._most_probable_noise(probabilities)
        self.order = self.search.order
        null = self.search.candidates[self.order, ()]
        problem = Linearised.of(null.found, null.evidence[noise].law)
        if not few:
            require_converged(null.found, Linearised.of(null.found, null.law))
        draws = problem.draws(N_DRAWS, rng=self.rng)

        p_value = global_p_value(problem, self._looks(null.found), draws)
        pairs = self._aliases(problem, null.found)
        verdict, combination = decide(hypotheses, self.noise_names, tuple(pairs))
        # Physics is named only where the test that counts every look has raised an alarm too.
        if few or (verdict == "named" and p_value > _ALARM):
            verdict, combination = "cannot_tell", ()
        if constant:
            p_value = 1.0  # readings that never change carry no noise to measure a residual by

        mean_names = tuple(name for name in combination if name in self.built and name not in self.noise_names)
        foreseen = self._foreseen(probabilities)
        if verdict == "unknown":
            mean_names = foreseen or self.search.beside(noise)
        noise_of = noise
        if verdict in ("named", "noise", "clean"):
            stated = tuple(name for name in combination if name in self.noise_names)
            noise_of = self._most_probable_noise(
                {key: p for key, p in probabilities.items() if _in_vocabulary(key[1]) == stated}
            )
        best = self.search.best(mean_names, noise_of) or null
        samples = self._sample(best, noise_of)
        written = samples
        if verdict == "unknown" and best is not null:
            plain = self._sample_of(self.search.candidates[best.n_gaussians, ()], noise_of)
            share = max(1 - _by_mean(probabilities)[foreseen], _LEAST_DOUBT) if foreseen else _DOUBT_BESIDE
            written = doubted(samples, plain, best.found.model.effects, share, rng=self.rng)
        null_samples = samples if best is null else self._sample(null, noise_of)
        effects = self._effects(hypotheses, best, samples, noise_of)
        after = Linearised.of(best.found, best.evidence[noise_of].law)
        where = self._where(null, problem, draws, best, effects, p_value)
        improvement = self._improvement(null, best, noise_of, after, p_value)
        residuals_after, change = best.found.residuals, np.zeros(len(self.recording))
        if verdict == "unknown" and not foreseen:
            improvement, correction = self._corrected(null, best, after, noise, improvement)
            residuals_after = residuals_after - correction
            change[self.usable] = correction
        candidates = [
            e.sentence(*_moments(samples.columns(e.name))) for e in best.found.model.effects if e.name in UNNAMED
        ]
        reason = self._reason(verdict, combination, hypotheses, effects, p_value, few, pairs, where, noise, candidates)
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
            noise=self._noise(best, noise_of, after, samples),
            next_measurement=self._next(hypotheses, null),
            null=null_samples,
            repaired=written,
            residuals_before=self._spread(null.found.residuals),
            residuals_after=self._spread(residuals_after),
            predicted_before=predicted_before,
            predicted_after=predicted_after + change,
            order_probabilities=dict(self.search.order_probabilities),
            unknown_shares=self._unknown_shares(probabilities),
            weighings=weighings,
        )

    def _most_probable_noise(
        self, probabilities: Mapping[tuple[tuple[str, ...], tuple[str, ...]], float]
    ) -> tuple[str, ...]:
        marginal: dict[tuple[str, ...], float] = {}
        for (_, noise), p in probabilities.items():
            marginal[noise] = marginal.get(noise, 0.0) + p
        return max(marginal, key=lambda k: marginal[k])

    def _foreseen(self, probabilities: Mapping[tuple[Names, Names], float]) -> Names:
        """Name the leading refitted combination with something outside the vocabulary, if it leads what is unknown."""
        by_mean = _by_mean(probabilities)
        own = {names: p for names, p in by_mean.items() if UNNAMED.keys() & set(names)}
        refitted = {names for _, names in self.search.candidates}
        leader = max(own, key=lambda names: own[names], default=())
        return leader if leader in refitted and own.get(leader, 0.0) > by_mean.get(("unknown",), 0.0) else ()

    def _unknown_shares(self, probabilities: Mapping[tuple[Names, Names], float]) -> dict[str, float]:
        """Share what is unknown out over the names of our own, and over covariates for what has none."""
        by_mean = _by_mean(probabilities)
        shares = {family: by_mean.get(("unknown",), 0.0) * p for family, p in self.search.unknown_shares.items()}
        for names, p in by_mean.items():
            for name in UNNAMED.keys() & set(names):
                shares[name] = shares.get(name, 0.0) + p
        total = sum(shares.values()) or 1.0
        return {name: p / total for name, p in shares.items()}

    def _sample(self, candidate: Candidate, noise: Names) -> ModelSamples:
        """Draw from the posterior of a candidate's hypothesis, over all SSF orders that matter."""
        alike = [c for (_, names), c in self.search.candidates.items() if names == candidate.names]
        log_z = np.array([c.evidence[noise].log_z for c in alike])
        weights = np.exp(log_z - log_z.max())
        kept = weights > _LEAST_OF_AN_ORDER * weights.sum()
        parts = [self._sample_of(c, noise) for c in itertools.compress(alike, kept)]
        return over_orders(parts, weights[kept] / weights[kept].sum(), rng=self.rng)

    def _sample_of(self, candidate: Candidate, noise: Names) -> ModelSamples:
        evidence = candidate.evidence[noise]
        return sample_model(candidate.found, evidence, self.recording, weights=candidate.weights, rng=self.rng)

    def _spread(self, values: FloatArray) -> FloatArray:
        out = np.full(len(self.recording), np.nan)
        out[self.usable] = values
        return out

    def _looks(self, found: Fit) -> list[Bank]:
        """List every template that a test looks at about a fit."""
        missing = [e for k, e in self.built.items() if k not in self.noise_names and k not in found.model.names]
        return [self.search.templates.bank(found, missing), self.search.unknown_bases]

    def _aliases(self, problem: Linearised, found: Fit) -> list[Alias]:
        """Compare what survives of the effects, each by the entry of its bank that fits best here."""
        telling: dict[str, FloatArray] = {}
        chosen: dict[str, NamedEffect[Any]] = {}
        for name, effect in self.built.items():
            if name in self.noise_names or name in UNNAMED:
                continue
            templates = self.search.templates.of(found, effect)
            blocks = Blocks.of(problem, templates.columns, [name] * len(templates.columns))
            scores = np.add.reduceat((blocks.u.T @ problem.residual) ** 2, blocks.starts)
            best = int(np.argmax(scores))
            telling[name], chosen[name] = templates.columns[best], templates.variant(best)
        return settle(aliases(problem, telling, {}), found, chosen, problem.sd)

    def _where(
        self,
        null: Candidate,
        problem: Linearised,
        draws: FloatArray,
        best: Candidate,
        effects: tuple[EffectFound, ...],
        p_value: float,
    ) -> list[Place]:
        """Say where what was named is, the largest first; then where else the residual stands out."""
        covariates, residuals = self.search.covariates, null.found.residuals
        sizes = {effect.name: effect.size_lambda for effect in effects}
        named: list[Place] = []
        for effect in sorted(best.found.model.effects, key=lambda e: -sizes.get(e.name, 0.0)):
            change = self._change(best.found, effect)
            named += places_of_effect(
                effect,
                change,
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

    def _change(self, found: Fit, effect: NamedEffect[Any]) -> FloatArray:
        """Tell what one of a fit's effects does to the usable readings, (n_usable,)."""
        model = found.model
        keep = np.ones(len(found.z), dtype=np.bool_)
        keep[model.columns_of(effect.name)] = False
        without = Model(model.sensor, tuple(e for e in model.effects if e is not effect), model.plan)
        return np.asarray(found.predicted - without.predict(found.z[None, keep])[0, self.usable])

    def _effects(
        self,
        hypotheses: tuple[Hypothesis, ...],
        best: Candidate,
        samples: ModelSamples,
        noise_of: tuple[str, ...],
    ) -> tuple[EffectFound, ...]:
        out, unit = [], self.recording.plan.instrumentation.unit
        for name, effect in self.built.items():
            p = sum(h.probability for h in hypotheses if name in h.effects)
            if p <= _LEAST_PROBABILITY or name in NUISANCES or name in UNNAMED:
                continue
            holder, noise = (best, noise_of) if name in samples.effects else self._holder(name)
            if holder is None:
                effect, values, size = self._too_small(effect)
            else:
                effect = next((e for e in holder.found.model.effects if e.name == name), effect)
                own = samples
                if name not in samples.effects:
                    evidence, weights = holder.evidence[noise], holder.weights
                    own = sample_model(holder.found, evidence, self.recording, weights=weights, rng=self.rng, n_steps=0)
                values, size = own.columns(name), self._size(holder, name, noise)
            out.append(
                EffectFound(
                    name,
                    min(p, 1.0),
                    size,
                    effect.sentence(values.mean(axis=0), values.std(axis=0)),
                    (*_parameters(effect, values, unit), *_scans(effect, self.recording.plan)),
                    effect.scans,
                )
            )
        return tuple(sorted(out, key=lambda e: -e.probability))

    def _holder(self, name: str) -> tuple[Candidate | None, tuple[str, ...]]:
        """Find the most probable refitted candidate that holds an effect."""
        ranked = sorted(self.search.probabilities.items(), key=lambda item: -item[1])
        for (mean, noise), p in ranked:
            if p > 0 and name in (*mean, *noise):
                candidate = self.search.best(mean, noise)
                if candidate is not None:
                    return candidate, noise
        return None, ()

    def _too_small(self, effect: NamedEffect[Any]) -> tuple[NamedEffect[Any], FloatArray, float]:
        """Bound an effect that is not felt: amplitudes by the linearised null, the rest as the prior has it.

        Of its variants the one is taken that stands in the middle.
        """
        null = self.search.candidates[self.order, ()]
        best = max(null.evidence.values(), key=lambda e: e.log_z)
        problem = Linearised.of(null.found, best.law)
        templates = self.search.templates.of(null.found, effect)
        middle = len(templates.columns) // 2
        effect = templates.variant(middle)
        values = effect.prior.from_unit_cube(self.rng.random((N_DRAWS, len(effect.prior.names))))
        if not effect.amplitudes:
            return effect, values, 0.0
        projected = problem.project(templates.columns[middle])
        # A ridge of one prior scale keeps amplitudes that the plan cannot see from running off.
        precision = projected.T @ projected + np.eye(projected.shape[1])
        amount = np.linalg.solve(precision, projected.T @ problem.residual)
        spread = np.linalg.cholesky(np.linalg.inv(precision))
        draws = amount + self.rng.standard_normal((N_DRAWS, len(amount))) @ spread.T
        for k in effect.amplitudes:
            values[:, k] = draws @ templates.settings[middle][:, k]
        # Signs that the prior rules out are folded back.
        inside = np.isfinite(effect.prior.log_prob(values))
        values[~inside] = np.abs(values[~inside])
        return effect, values, float(np.linalg.norm(projected @ amount))

    def _size(self, holder: Candidate, name: str, noise: tuple[str, ...]) -> float:
        """Measure lambda: what is left on noise-free readings after a full refit without the effect."""
        law = holder.evidence[noise].law
        found = holder.found
        if name in self.search.certain:
            step = holder.evidence[noise].laid_out.settings[0, holder.evidence[noise].noise.columns_of(name)]
            return float(step[0]) / math.sqrt(12) / found.sd * math.sqrt(len(found.residuals))
        if name in self.noise_names:
            # On the noise: the evidence for it, as the effect of that many sd on the mean would leave.
            gain = holder.evidence[noise].log_z - holder.evidence[tuple(n for n in noise if n != name)].log_z
            return math.sqrt(2 * max(gain, 0.0))
        clean = self.recording.readings.copy()
        clean[self.usable] = found.predicted
        others = tuple(e for e in found.model.effects if e.name != name)
        model = Model(found.model.sensor, others, found.model.plan)
        keep = np.ones(len(found.z), dtype=np.bool_)
        keep[found.model.columns_of(name)] = False
        noise_free = Recording(self.recording.plan, clean)
        # With the noise's own sd as floor the refit weighs readings against priors as the real one did.
        refit = fit(model, noise_free, found.z[keep], law, sd_floor=found.sd, max_steps=12, tolerance=0.02)
        return float(np.linalg.norm(law(refit.residuals))) / found.sd * math.sqrt(law.information)

    def _improvement(
        self, null: Candidate, best: Candidate, noise: tuple[str, ...], after: Linearised, p_value: float
    ) -> Improvement:
        rms = [float(np.sqrt(np.mean(c.found.residuals**2))) for c in (null, best)]
        if best is null:
            gain = best.evidence[noise].log_z - null.evidence[self.search.certain].log_z
            return Improvement(gain, 0.0, 0.0, (), rms[0], rms[1], p_value)
        law = best.evidence[noise].law
        held = held_out_gain(null.found, best.found, self.recording, law, sd_floor=self.floor)
        p_after = global_p_value(after, self._looks(best.found), after.draws(N_DRAWS // 2, rng=self.rng))
        log_evidence = best.evidence[noise].log_z - null.evidence[self.search.certain].log_z
        return Improvement(log_evidence, held.per_reading, held.sd, held.by_scan, rms[0], rms[1], p_after)

    def _corrected(
        self, null: Candidate, best: Candidate, problem: Linearised, noise: tuple[str, ...], plain: Improvement
    ) -> tuple[Improvement, FloatArray]:
        """Repair what the named effects leave by bases without a name, where that predicts scans kept back."""
        bases = self.search.unknown_bases
        scan = self.recording.plan.scan[self.usable]
        fixed = correct(best.found, problem, bases, scan)
        if fixed.held_out.by_scan and fixed.held_out.per_reading <= 0:
            return plain, np.zeros(len(fixed.change))
        wider = replace(
            best.found,
            residuals=best.found.residuals - fixed.change,
            slopes=np.concatenate([best.found.slopes, fixed.columns], axis=1),
            z=np.concatenate([best.found.z, np.zeros(fixed.columns.shape[1])]),
        )
        after = Linearised.of(wider, problem.law)
        p_after = global_p_value(after, self._looks(best.found), after.draws(N_DRAWS // 2, rng=self.rng))
        plain_z = null.evidence[noise].log_z
        named = dict(plain.heldout_by_scan)
        by_scan = ((self.recording.plan.scan_names[int(k)], gained) for k, gained in fixed.held_out.by_scan)
        gain = replace(
            plain,
            log_evidence=self.search.unknown.get((best.n_gaussians, best.names, noise), plain_z) - plain_z,
            heldout_log_density_per_reading=plain.heldout_log_density_per_reading + fixed.held_out.per_reading,
            heldout_sd=math.hypot(plain.heldout_sd, fixed.held_out.sd),
            heldout_by_scan=tuple((name, gained + named.get(name, 0.0)) for name, gained in by_scan),
            rms_after=float(np.sqrt(np.mean(wider.residuals**2))),
            p_value_after=p_after,
        )
        return gain, fixed.change

    def _noise(self, best: Candidate, noise: tuple[str, ...], after: Linearised, samples: ModelSamples) -> NoiseFound:
        """Test the repaired model's residual for memory, heavy tails and a spread that follows the level."""
        steps = steps_within_scans(self.recording)
        own = after.residual[: after.n_points, None]
        null = after.draws(N_DRAWS, rng=self.rng)[: after.n_points]
        joined = noise_statistics(np.concatenate([own, null], axis=1), steps, best.found.predicted)
        center, spread = joined[:, 1:].mean(axis=1), joined[:, 1:].std(axis=1)
        worst = np.max(np.abs(joined - center[:, None]) / np.maximum(spread, 1e-12)[:, None], axis=0)
        p_value = (1 + int(np.sum(worst[1:] >= worst[0]))) / (1 + N_DRAWS)
        unit = self.recording.plan.instrumentation.unit
        parameters = [_parameter("sd", unit, samples.noise_sd)]
        for name in _in_vocabulary(noise):
            parameters += _parameters(self.built[name], samples.columns(name), unit)
        return NoiseFound("+".join(noise) or "white", p_value, tuple(parameters))

    def _next(self, hypotheses: tuple[Hypothesis, ...], null: Candidate) -> NextMeasurement | None:
        """Ask for the readings that tell the two leading refitted hypotheses about the mean apart."""
        leaders: list[Candidate] = []
        for hypothesis in hypotheses:
            names = tuple(n for n in hypothesis.effects if n not in self.noise_names)
            candidate = null if names in ((), ("unknown",)) else self.search.best(names, self.search.certain)
            if candidate is not None and all(candidate.names != leader.names for leader in leaders):
                leaders.append(candidate)
            if len(leaders) == 2:
                break
        if len(leaders) < 2:
            rival = self._rival_of(leaders[0], hypotheses)
            if rival is None:
                return None
        else:
            rival = (leaders[1].found.model, leaders[1].found.z, covariance_of(leaders[1].found))
        found = leaders[0].found
        return next_measurement((found.model, found.z, covariance_of(found)), rival, found.sd, self.recording.plan)

    def _rival_of(
        self, leader: Candidate, hypotheses: tuple[Hypothesis, ...]
    ) -> tuple[Model, FloatArray, FloatArray] | None:
        """Make a rival of the most probable effect that is not felt: just as large as lambda 3 here."""
        ranked = [n for h in hypotheses for n in h.effects if n in self.built and n not in self.noise_names]
        name = next((n for n in ranked if n not in leader.names), None)
        if name is None:
            return None
        effect, found = self.built[name], leader.found
        best = max(leader.evidence.values(), key=lambda e: e.log_z)
        problem = Linearised.of(found, best.law)
        templates = self.search.templates.of(found, effect)
        sizes = [float(np.linalg.norm(problem.project(c[:, :1]))) for c in templates.columns]
        at = int(np.argmin(np.abs(np.log(np.maximum(sizes, 1e-9) / 3.0))))
        setting = templates.settings[at][0].copy()
        for k in effect.amplitudes:
            setting[k] *= min(3.0 / max(sizes[at], 1e-9), 50.0)
        model = found.model.with_effect(templates.variant(at))
        z = np.concatenate([found.z, model.scores_of(setting[None, :])[0]])
        covariance = np.zeros((len(z), len(z)))
        covariance[: len(found.z), : len(found.z)] = covariance_of(found)
        return model, z, covariance

    def _reason(
        self,
        verdict: Verdict,
        combination: tuple[str, ...],
        hypotheses: tuple[Hypothesis, ...],
        effects: tuple[EffectFound, ...],
        p_value: float,
        few: bool,
        pairs: Sequence[Alias],
        where: Sequence[Any],
        noise: tuple[str, ...],
        candidates: Sequence[str],
    ) -> str:
        n = len(self.usable)
        if few and n >= self.least_readings:
            return f"All {n} usable readings are equal: there is no signal to diagnose; scan across an edge."
        if few:
            return f"{n} usable readings are too few to tell; {self.least_readings} or more are needed."
        by_name = {effect.name: effect for effect in effects}
        if verdict == "clean":
            order = max(self.search.order_probabilities, key=lambda k: self.search.order_probabilities[k])
            ssf = "" if order == 0 else ", an SSF of one Gaussian," if order == 1 else f", an SSF of {order} Gaussians,"
            return f"The model{ssf} explains all {n} readings to within their noise (p = {p_value:.2g})."
        if verdict == "unknown":
            if candidates:
                like = "; ".join(candidates)
                return f"Something is missing (p = {p_value:.2g}) that has no name; it is most like this: {like}."
            place = f" It shows most in {where[0].covariate}." if where else ""
            known = " and ".join(name.replace("_", " ") for name in self.search.beside(noise))
            beside = f", beside {known}" if known else ""
            return f"Something is missing (p = {p_value:.2g}) that no named effect explains{beside}.{place}"
        if verdict == "cannot_tell":
            leading = ", ".join(f"{h.label} {h.probability:.2f}" for h in itertools.islice(hypotheses, 3))
            cure = next((f"; to tell: {a.settle_by}" for a in pairs if set(a.effects) & set(combination)), "")
            return f"These {n} readings are too few to decide between {leading}{cure}."
        said = "; ".join(by_name[name].sentence for name in combination if name in by_name)
        return f"{said[0].upper()}{said[1:]} (p = {p_value:.2g})."


def _of_everything(found: Diagnosis, everything: Recording) -> Diagnosis:
    """Carry what part of a recording told to the whole of it: predictions and residuals of every row."""
    predicted = [
        samples.chain.predict(samples.theta[:_FOR_A_MEAN], everything.plan).mean(axis=0)
        for samples in (found.null, found.repaired)
    ]
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
        outside = mean == ("unknown",) or bool(UNNAMED.keys() & set(mean))
        key = ("unknown",) if outside else tuple(sorted((*mean, *_in_vocabulary(noise))))
        joined[key] = joined.get(key, 0.0) + p
    total = sum(joined.values())
    ranked = sorted(joined.items(), key=lambda item: -item[1])
    return tuple(Hypothesis(key, p / total) for key, p in ranked)


def _by_mean(probabilities: Mapping[tuple[Names, Names], float]) -> dict[Names, float]:
    out: dict[Names, float] = {}
    for (mean, _), p in probabilities.items():
        out[mean] = out.get(mean, 0.0) + p
    return out


def _moments(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    return np.asarray(values.mean(axis=0)), np.asarray(values.std(axis=0))


def _in_vocabulary(noise: tuple[str, ...]) -> tuple[str, ...]:
    """Leave out what is no name of the vocabulary's."""
    return tuple(name for name in noise if name not in NUISANCES)


def _parameters(effect: NamedEffect[Any], values: FloatArray, unit: str) -> tuple[ParameterFound, ...]:
    return tuple(
        _parameter(name, _unit(own, unit), values[:, k])
        for k, (name, own) in enumerate(zip(effect.prior.names, effect.units, strict=True))
    )


def _scans(effect: NamedEffect[Any], plan: Plan) -> tuple[ParameterFound, ...]:
    """Give the numbers of the scans that an effect is bound to, from 0 in order of taking; its sentence names them."""
    numbers = np.flatnonzero([name in effect.scans for name in plan.scan_names]).astype(np.float64)
    return (_parameter("scans", "scan", numbers),) if numbers.size else ()


def _unit(own: str, unit: str) -> str:
    """Write the unit with the reading's own for "reading"."""
    return own.replace("reading", unit) if own.startswith("reading") else own


def _parameter(name: str, unit: str, values: FloatArray) -> ParameterFound:
    low, high = np.quantile(values, [0.025, 0.975])
    return ParameterFound(name, unit, float(values.mean()), float(values.std()), (float(low), float(high)))
