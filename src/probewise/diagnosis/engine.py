"""Find the mismatch, name the physics, model it, show the gain: the road from recordings to a Diagnosis."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

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
from probewise.diagnosis.coordinates import SensorCoordinates, sensor_from_posterior
from probewise.diagnosis.evidence import Blocks, Linearised
from probewise.diagnosis.fit import Fit, Model, fit
from probewise.diagnosis.gain import held_out_gain
from probewise.diagnosis.joining import join
from probewise.diagnosis.locate import families_of, global_p_value, places
from probewise.diagnosis.noise import noise_statistics, steps_within_scans
from probewise.diagnosis.repaired import ModelSamples, sample_model
from probewise.diagnosis.search import Candidate, Search, search
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
from probewise.effects import VOCABULARY, Extent, NamedEffect
from probewise.inference import sd_floor
from probewise.recordings.plan import Plan, Recording
from probewise.sensor import Stage

__all__ = ["SensorPrior", "diagnose"]

N_DRAWS = 999
_LEAST_PROBABILITY = 1e-3
_LEAST_READINGS = 24
_ALARM = 0.01


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
    effects: Mapping[str, type[NamedEffect[Any]]] = VOCABULARY,
    rng: np.random.Generator,
) -> Diagnosis:
    """Tell what physics the sensor model leaves out of these recordings.

    Parameters
    ----------
    recordings
        One, or the first and those that it asked for.
    sensor
        An earlier posterior of the sensor, taken as the prior; without it the null is calibrated here.
    effects
        The vocabulary to choose from, by name.
    rng
        Source of randomness, for the null laws of the tests and the posterior samples.

    Returns
    -------
    Diagnosis
        Verdict, probabilities, places, gain, aliases, the repaired model and the next measurement.

    Raises
    ------
    ParameterError
        If there is no usable reading, or units differ.
    """
    recording = join([recordings] if isinstance(recordings, Recording) else list(recordings))
    extent = Extent.of(recording)
    fitted = {name: kind.for_extent(extent) for name, kind in effects.items()}
    built = {name: effect for name, effect in fitted.items() if effect is not None}
    floor = sd_floor(recording)
    known = None
    if sensor is not None:
        samples = np.asarray(sensor.samples, dtype=np.float64)
        known = sensor_from_posterior(sensor.names, samples.mean(axis=0), np.cov(samples.T))
    return _Diagnoser(recording, built, known, floor, rng).run()


@dataclass(eq=False)
class _Diagnoser:
    recording: Recording
    built: Mapping[str, NamedEffect[Any]]
    sensor: SensorCoordinates | None
    floor: float
    rng: np.random.Generator

    def run(self) -> Diagnosis:
        self.usable: IntArray = np.flatnonzero(self.recording.usable)
        n = len(self.usable)
        constant = float(np.ptp(self.recording.readings[self.usable])) == 0.0
        few = n < _LEAST_READINGS or constant
        self.search: Search = search(
            self.recording, self.built, sensor=self.sensor, sd_floor=self.floor, max_order=1 if n < 60 else 3
        )
        self.noise_names = frozenset(k for k, e in self.built.items() if e.stage is Stage.NOISE)
        probabilities = self.search.probabilities
        hypotheses = _hypotheses(probabilities)
        marginal = {
            k: sum(p for (_, noise), p in probabilities.items() if noise == k) for k in self.search.noise_models
        }
        noise = max(marginal, key=lambda k: marginal[k])
        null = self.search.candidates[self.search.order, ()]
        problem = Linearised.of(null.found, null.evidence[noise].whitener)
        draws = problem.draws(N_DRAWS, rng=self.rng)

        columns, families = self._looks(null.found)
        p_value = global_p_value(problem, columns, families, draws)
        pairs = self._aliases(problem, null.found)
        verdict, combination = decide(hypotheses, self.noise_names, tuple(pairs))
        # Physics is named only where the test that counts every look has raised an alarm too.
        if few or (verdict == "named" and p_value > _ALARM):
            verdict, combination = "cannot_tell", ()
        if constant:
            p_value = 1.0  # readings that never change carry no noise to measure a residual by

        mean_names = tuple(name for name in combination if name in self.built and name not in self.noise_names)
        noise_of = tuple(name for name in combination if name in self.noise_names) or (
            () if verdict in ("named", "noise", "clean") else noise
        )
        best = self.search.best(mean_names, noise_of) or null
        samples = self._sample(best, noise_of)
        null_samples = self._sample(null, noise_of)
        effects = self._effects(hypotheses, best, samples, noise_of)
        after = Linearised.of(best.found, best.evidence[noise_of].whitener)
        favoured = [c for name in combination if name in self.built for c in self.built[name].covariates]
        where = places(
            problem,
            self.search.covariates,
            self.recording.plan.scan_names,
            null.found.residuals,
            draws,
            favoured=favoured,
        )
        improvement = self._improvement(null, best, noise_of, after, p_value)
        residuals_after, change = best.found.residuals, np.zeros(len(self.recording))
        if verdict == "unknown":
            improvement, correction = self._corrected(null, problem, noise, improvement)
            residuals_after = residuals_after - correction
            change[self.usable] = correction
        reason = self._reason(verdict, combination, hypotheses, effects, p_value, few, pairs, where)
        predicted_before, predicted_after = (c.found.model.predict(c.found.z[None, :])[0] for c in (null, best))
        return Diagnosis(
            recording=self.recording,
            verdict=verdict,
            reason=reason,
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
            repaired=samples,
            residuals_before=self._spread(null.found.residuals),
            residuals_after=self._spread(residuals_after),
            predicted_before=predicted_before,
            predicted_after=predicted_after + change,
            order_probabilities=dict(self.search.order_probabilities),
            unknown_shares=dict(self.search.unknown_shares),
        )

    def _sample(self, candidate: Candidate, noise: tuple[str, ...]) -> ModelSamples:
        evidence = candidate.evidence[noise]
        return sample_model(candidate.found, evidence, self.recording, weights=candidate.weights, rng=self.rng)

    def _spread(self, values: FloatArray) -> FloatArray:
        out = np.full(len(self.recording), np.nan)
        out[self.usable] = values
        return out

    def _looks(self, found: Fit) -> tuple[list[FloatArray], list[str]]:
        """List every template that a test looks at about a fit, with its family."""
        missing = [e for k, e in self.built.items() if k not in self.noise_names and k not in found.model.names]
        named = {e.name: self.search.templates.of(found, e).columns for e in missing}
        columns, families = families_of(named)
        bases = self.search.unknown_bases
        return [*columns, *bases.columns], [*families, *(f"unknown in {f}" for f in bases.families)]

    def _aliases(self, problem: Linearised, found: Fit) -> list[Alias]:
        """Compare what survives of the effects, each by the entry of its bank that fits best here."""
        telling: dict[str, FloatArray] = {}
        chosen: dict[str, NamedEffect[Any]] = {}
        for name, effect in self.built.items():
            if name in self.noise_names:
                continue
            templates = self.search.templates.of(found, effect)
            blocks = Blocks.of(problem, templates.columns, [name] * len(templates.columns))
            scores = np.add.reduceat((blocks.u.T @ problem.residual) ** 2, blocks.starts)
            best = int(np.argmax(scores))
            telling[name], chosen[name] = templates.columns[best], templates.variant(best)
        return settle(aliases(problem, telling, {}), found, chosen, problem.sd)

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
            if p <= _LEAST_PROBABILITY:
                continue
            holder, noise = (best, noise_of) if name in samples.effects else self._holder(name)
            if holder is None:
                effect, values, size = self._too_small(effect)
            else:
                effect = next((e for e in holder.found.model.effects if e.name == name), effect)
                own = samples
                if name not in samples.effects:
                    own = self._sample(holder, noise)
                values, size = own.columns(name), self._size(holder, name, noise)
            out.append(
                EffectFound(
                    name,
                    min(p, 1.0),
                    size,
                    effect.sentence(values.mean(axis=0), values.std(axis=0)),
                    (*_parameters(effect, values, unit), *_scans(effect, self.recording.plan)),
                )
            )
        return tuple(sorted(out, key=lambda e: -e.probability))

    def _holder(self, name: str) -> tuple[Candidate | None, tuple[str, ...]]:
        """Find the most probable refitted candidate that holds an effect."""
        ranked = sorted(self.search.probabilities.items(), key=lambda item: -item[1])
        for (mean, noise), _ in ranked:
            if name in (*mean, *noise):
                candidate = self.search.best(mean, noise)
                if candidate is not None:
                    return candidate, noise
        return None, ()

    def _too_small(self, effect: NamedEffect[Any]) -> tuple[NamedEffect[Any], FloatArray, float]:
        """Bound an effect that is not felt: amplitudes by the linearised null, the rest as the prior has it.

        Of its variants the one is taken that stands in the middle.
        """
        null = self.search.candidates[self.search.order, ()]
        best = max(null.evidence.values(), key=lambda e: e.log_z)
        problem = Linearised.of(null.found, best.whitener)
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
        whitener = holder.evidence[noise].whitener
        found = holder.found
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
        refit = fit(model, noise_free, found.z[keep], whitener, sd_floor=found.sd, max_steps=12, tolerance=0.02)
        return float(np.linalg.norm(whitener(refit.residuals))) / found.sd

    def _improvement(
        self, null: Candidate, best: Candidate, noise: tuple[str, ...], after: Linearised, p_value: float
    ) -> Improvement:
        rms = [float(np.sqrt(np.mean(c.found.residuals**2))) for c in (null, best)]
        if best is null:
            gain = best.evidence[noise].log_z - null.evidence[()].log_z
            return Improvement(gain, 0.0, 0.0, (), rms[0], rms[1], p_value)
        held = held_out_gain(null.found, best.found, self.recording, sd_floor=self.floor)
        columns, families = self._looks(best.found)
        p_after = global_p_value(after, columns, families, after.draws(N_DRAWS // 2, rng=self.rng))
        log_evidence = best.evidence[noise].log_z - null.evidence[()].log_z
        return Improvement(log_evidence, held.per_reading, held.sd, held.by_scan, rms[0], rms[1], p_after)

    def _corrected(
        self, null: Candidate, problem: Linearised, noise: tuple[str, ...], plain: Improvement
    ) -> tuple[Improvement, FloatArray]:
        """Repair by bases without a name, and weigh that repair like any other."""
        bases = self.search.unknown_bases
        scan = self.recording.plan.scan[self.usable]
        fixed = correct(null.found, problem, bases.columns, scan)
        wider = replace(
            null.found,
            residuals=null.found.residuals - fixed.change,
            slopes=np.concatenate([null.found.slopes, fixed.columns], axis=1),
            z=np.concatenate([null.found.z, np.zeros(fixed.columns.shape[1])]),
        )
        after = Linearised.of(wider, problem.whitener)
        columns, families = self._looks(null.found)
        p_after = global_p_value(after, columns, families, after.draws(N_DRAWS // 2, rng=self.rng))
        gain = replace(
            plain,
            log_evidence=self.search.unknown[noise],
            heldout_log_density_per_reading=fixed.held_out.per_reading,
            heldout_sd=fixed.held_out.sd,
            heldout_by_scan=fixed.held_out.by_scan,
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
        for name in noise:
            parameters += _parameters(self.built[name], samples.columns(name), unit)
        return NoiseFound("+".join(noise) or "white", p_value, tuple(parameters))

    def _next(self, hypotheses: tuple[Hypothesis, ...], null: Candidate) -> NextMeasurement | None:
        """Ask for the readings that tell the two leading refitted hypotheses about the mean apart."""
        leaders: list[Candidate] = []
        for hypothesis in hypotheses:
            names = tuple(n for n in hypothesis.effects if n not in self.noise_names)
            candidate = null if names in ((), ("unknown",)) else self.search.best(names)
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
        problem = Linearised.of(found, best.whitener)
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
    ) -> str:
        n = len(self.usable)
        if few and n >= _LEAST_READINGS:
            return f"All {n} usable readings are equal: there is no signal to diagnose; scan across an edge."
        if few:
            return f"{n} usable readings are too few to tell; {_LEAST_READINGS} or more are needed."
        by_name = {effect.name: effect for effect in effects}
        if verdict == "clean":
            order = max(self.search.order_probabilities, key=lambda k: self.search.order_probabilities[k])
            ssf = "one Gaussian" if order == 1 else f"{order} Gaussians"
            return f"The model, an SSF of {ssf}, explains all {n} readings to within their noise (p = {p_value:.2g})."
        if verdict == "unknown":
            place = f" It shows most in {where[0].covariate}." if where else ""
            return f"Something is missing (p = {p_value:.2g}) that no named effect explains.{place}"
        if verdict == "cannot_tell":
            leading = ", ".join(f"{h.label} {h.probability:.2f}" for h in itertools.islice(hypotheses, 3))
            cure = next((f"; to tell: {a.settle_by}" for a in pairs if set(a.effects) & set(combination)), "")
            return f"These {n} readings are too few to decide between {leading}{cure}."
        said = "; ".join(by_name[name].sentence for name in combination if name in by_name)
        return f"{said[0].upper()}{said[1:]} (p = {p_value:.2g})."


def _hypotheses(
    probabilities: Mapping[tuple[tuple[str, ...], tuple[str, ...]], float],
) -> tuple[Hypothesis, ...]:
    """Join mean and noise into combinations; unknown is one hypothesis under any noise."""
    joined: dict[tuple[str, ...], float] = {}
    for (mean, noise), p in probabilities.items():
        key = mean if mean == ("unknown",) else tuple(sorted((*mean, *noise)))
        joined[key] = joined.get(key, 0.0) + p
    total = sum(joined.values())
    ranked = sorted(joined.items(), key=lambda item: -item[1])
    return tuple(Hypothesis(key, p / total) for key, p in ranked)


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
