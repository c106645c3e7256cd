"""Score, weigh, combine: find the set of effects that explains the recording.

Every subset of effects on the mean, under every noise model and several SSF orders. Templates screen,
a beam of the best is refitted jointly and non-linearly, Laplace weighs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.coordinates import SensorCoordinates, default_sensor
from probewise.diagnosis.covariates import Covariate, covariates_of, slope_along_the_move
from probewise.diagnosis.evidence import Blocks, Linearised, NoiseEvidence, block_log_bayes_factors, weigh
from probewise.diagnosis.fit import Fit, Model, fit, start_with_more_gaussians, starts_of_one_gaussian
from probewise.diagnosis.noise import NoiseModel, Whitener, white
from probewise.diagnosis.templates import (
    EffectTemplates,
    TemplateMemory,
    UnknownTemplates,
    subsets,
    unknown_templates,
)
from probewise.effects import Extent, NamedEffect
from probewise.recordings.plan import Recording
from probewise.sensor import Stage

__all__ = ["Candidate", "PriorOdds", "Search", "search"]

Names = tuple[str, ...]

_BEST_ENTRIES = 2  # of each effect's bank, for pairs
_STEERING = 3.0  # nats behind the best: a noise model further back does not say what to look for next


@dataclass(frozen=True)
class PriorOdds:
    """What is believed of hypotheses before any reading.

    Half of all recordings are clean. Of the mean: `clean_mean`, `unknown`, and the rest shared out over
    combinations, by size, then evenly. Of the noise: `white`, the rest evenly over noise models.
    """

    clean_mean: float = 0.60
    unknown: float = 0.06
    by_size: tuple[float, ...] = (0.31, 0.025, 0.005)
    white: float = 0.88

    def log_mean(self, names: Names, n_effects: int) -> float:
        """Log prior of a combination of effects on the mean."""
        if not names:
            return math.log(self.clean_mean)
        return math.log(self.by_size[len(names) - 1] / math.comb(n_effects, len(names)))

    def log_noise(self, names: Names, n_models: int) -> float:
        """Log prior of a noise model, one of `n_models` with the white one."""
        return math.log((1 - self.white) / max(n_models - 1, 1)) if names else math.log(self.white)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A combination of effects on the mean at one SSF order, refitted and weighed under each noise model."""

    found: Fit
    evidence: Mapping[Names, NoiseEvidence]
    log_share: float  # in the evidence, for the discrete choices that its effects have made
    weights: Mapping[str, FloatArray]  # of the variants among which each effect chose

    @property
    def names(self) -> Names:
        """Its effects on the mean, sorted."""
        return tuple(sorted(self.found.model.names))

    @property
    def n_gaussians(self) -> int:
        """Its SSF order."""
        return self.found.model.sensor.n_gaussians


@dataclass(frozen=True, eq=False)
class Search:
    """Everything weighed: refitted candidates by (order, names), and the screened rest."""

    recording: Recording
    effects: Mapping[str, NamedEffect[Any]]
    noise_models: Mapping[Names, NoiseModel]
    sensors: Mapping[int, SensorCoordinates]
    candidates: Mapping[tuple[int, Names], Candidate]
    screened: Mapping[tuple[Names, Names], float]  # (mean, noise) -> log Bayes factor against the null
    unknown: Mapping[Names, float]  # noise -> log Bayes factor of `unknown` against the null
    order: int  # at which the search was made
    prior: PriorOdds
    sd_floor: float
    covariates: tuple[Covariate, ...]
    unknown_bases: UnknownTemplates
    unknown_shares: Mapping[str, float]
    templates: TemplateMemory
    probabilities: Mapping[tuple[Names, Names], float] = field(default_factory=dict)  # (mean, noise); ("unknown",)
    order_probabilities: Mapping[int, float] = field(default_factory=dict)  # of the clean mean

    def best(self, names: Names, noise: Names = ()) -> Candidate | None:
        """Return the refitted candidate of these effects with the most evidence over orders."""
        options = [c for (_, key), c in self.candidates.items() if key == names]
        return max(options, key=lambda c: c.evidence[noise].log_z, default=None)


def search(
    recording: Recording,
    effects: Mapping[str, NamedEffect[Any]],
    *,
    sensor: SensorCoordinates | None,
    sd_floor: float,
    prior: PriorOdds | None = None,
    max_order: int = 3,
    beam: int = 3,
    depth: int = 3,
) -> Search:
    """Weigh every combination of effects.

    Parameters
    ----------
    recording
        What was read.
    effects
        The vocabulary to search, by name.
    sensor
        The prior of the sensor; None: calibrated from the recording alone.
    sd_floor
        Least believable noise sd.
    prior
        Prior odds.
    max_order
        Largest SSF order tried without a sensor; one more where the largest wins.
    beam, depth
        How many combinations of each size are refitted, and the largest size.
    """
    return _Searcher(recording, effects, sensor, sd_floor, prior or PriorOdds(), max_order, beam, depth).run()


@dataclass(eq=False)
class _Searcher:
    """The state of one search: a memory of fits, filled as the beam widens."""

    recording: Recording
    effects: Mapping[str, NamedEffect[Any]]
    sensor: SensorCoordinates | None
    sd_floor: float
    prior: PriorOdds
    max_order: int
    beam: int
    depth: int

    def __post_init__(self) -> None:
        self.usable: IntArray = np.flatnonzero(self.recording.usable)
        self.n_points = len(self.usable)
        self.templates = TemplateMemory(self.usable)
        self.extent = Extent.of(self.recording)
        self.mean_effects = {n: e for n, e in self.effects.items() if e.stage is not Stage.NOISE}
        on_noise = [n for n, e in self.effects.items() if e.stage is Stage.NOISE]
        self.noise_models = {
            names: NoiseModel.of([self.effects[n] for n in names], self.recording) for names in subsets(on_noise, 2)
        }
        self.candidates: dict[tuple[int, Names], Candidate] = {}
        self.sensors: dict[int, SensorCoordinates] = {}
        self.unknown_shares: dict[str, float] = {}
        self.not_felt: set[Names] = set()

    def run(self) -> Search:
        order = self._null_fits()
        null = self.candidates[order, ()]
        level = null.found.predicted
        slope = slope_along_the_move(null.found.model, null.found.z)[self.usable]
        covariates = tuple(covariates_of(self.recording.plan, self.usable, level, slope))
        bases = unknown_templates(covariates, level - level.min(), self.n_points)
        screened, unknown = self._screen(null, bases)
        self._grow_beam(order, screened)
        search = Search(
            self.recording,
            self.effects,
            self.noise_models,
            self.sensors,
            self.candidates,
            screened,
            unknown,
            order,
            self.prior,
            self.sd_floor,
            covariates,
            bases,
            self.unknown_shares,
            self.templates,
        )
        self._refit_what_matters(search, screened)
        self._other_orders(search)
        return weighed(search)

    def _fit(self, model: Model, starts: FloatArray, whitener: Whitener, max_steps: int = 30) -> Fit:
        """Go a few steps from each start, then all the way from the best."""
        if len(starts) > 1:
            tried = [
                fit(model, self.recording, start, whitener, sd_floor=self.sd_floor, max_steps=5) for start in starts
            ]
            starts = min(tried, key=lambda f: f.objective).z[None, :]
        return fit(model, self.recording, starts[0], whitener, sd_floor=self.sd_floor, max_steps=max_steps)

    def _weighed(
        self,
        model: Model,
        starts: FloatArray,
        *,
        log_share: float = 0.0,
        weights: Mapping[str, FloatArray] | None = None,
        max_steps: int = 30,
    ) -> Candidate:
        """Fit with white noise, weigh under every noise model, refit where another one is more probable."""

        def weighed_by_all(found: Fit) -> dict[Names, NoiseEvidence]:
            plain = {k: weigh(found, noise, sd_floor=self.sd_floor) for k, noise in self.noise_models.items()}
            return {k: replace(evidence, log_z=evidence.log_z + log_share) for k, evidence in plain.items()}

        found = self._fit(model, starts, white(self.n_points), max_steps)
        evidence = weighed_by_all(found)
        score = {k: e.log_z + self.prior.log_noise(k, len(self.noise_models)) for k, e in evidence.items()}
        best = max(score, key=lambda k: score[k])
        if best:
            found = self._fit(model, found.z[None, :], evidence[best].whitener, max_steps)
            evidence = weighed_by_all(found)
        return Candidate(found, evidence, log_share, weights or {})

    def _keep(self, candidate: Candidate) -> Candidate:
        self.candidates[candidate.n_gaussians, candidate.names] = candidate
        return candidate

    def _null_fits(self) -> int:
        """Fit the null at each SSF order; one more is always a rival. Return the order of most evidence."""
        plan = self.recording.plan
        if self.sensor is not None:
            n = self.sensor.n_gaussians
            self.sensors[n] = self.sensor
            self._keep(self._weighed(Model(self.sensor, (), plan), np.zeros((1, self.sensor.n_params))))
            return n
        first = default_sensor(self.extent, 1)
        self.sensors[1] = first
        last = self._keep(self._weighed(Model(first, (), plan), starts_of_one_gaussian(first)))
        log_z = {1: _best_log_z(last)}
        for n in range(2, self.max_order + 2 if self.max_order > 1 else 2):
            # One more than the best is always a rival; beyond one that is far behind nothing is to be found.
            if log_z[n - 1] < max(log_z.values()) - 3:
                break
            wanted = default_sensor(self.extent, n)
            self.sensors[n] = wanted
            starts = start_with_more_gaussians(last.found.model.sensor, last.found.z, wanted)
            last = self._keep(self._weighed(Model(wanted, (), plan), starts))
            log_z[n] = _best_log_z(last)
        return max(log_z, key=lambda k: log_z[k])

    def _templates(self, found: Fit, names: Sequence[str]) -> dict[str, EffectTemplates]:
        return {n: self.templates.of(found, self.mean_effects[n]) for n in names}

    def _screen(
        self, null: Candidate, bases: UnknownTemplates
    ) -> tuple[dict[tuple[Names, Names], float], dict[Names, float]]:
        """Weigh all combinations about the null by templates, under every noise model's best node."""
        templates = self._templates(null.found, list(self.mean_effects))
        screened: dict[tuple[Names, Names], float] = {}
        unknown: dict[Names, float] = {}
        for noise, evidence in null.evidence.items():
            problem = Linearised.of(null.found, evidence.whitener)
            singles = {n: _log_bayes_factors(problem, t.columns) for n, t in templates.items()}
            for name, scores in singles.items():
                screened[(name,), noise] = _log_mean(scores)
            if self.depth > 1:
                for pair, value in _screened_pairs(problem, templates, singles).items():
                    screened[pair, noise] = value
            if not bases.columns:
                unknown[noise] = 0.0
                continue
            by_family = _by_family(_log_bayes_factors(problem, bases.columns), bases.families)
            unknown[noise] = float(logsumexp(list(by_family.values()))) - math.log(len(by_family))
            if evidence is max(null.evidence.values(), key=lambda e: e.log_z):
                self.unknown_shares = {
                    k: math.exp(v - logsumexp(list(by_family.values()))) for k, v in by_family.items()
                }
        return screened, unknown

    def _grow_beam(self, order: int, screened: dict[tuple[Names, Names], float]) -> None:
        """Refit the best combinations of each size, each grown from the best of the size before."""
        null = self.candidates[order, ()]
        reference = {k: e.log_z for k, e in null.evidence.items()}
        grown: dict[Names, tuple[float, Candidate]] = {(): (0.0, null)}
        for size in range(1, min(self.depth, len(self.mean_effects)) + 1):
            wishes: dict[Names, tuple[float, Candidate, str]] = {}
            for parent in grown.values():
                self._wish(parent[1], reference, wishes)
            if size == 2:
                for (names, noise), value in screened.items():
                    if len(names) == 2 and value > wishes.get(names, (-np.inf,))[0]:
                        held = grown.get(names[:1]) or grown.get(names[1:])
                        if held is not None:
                            added = names[1] if held[1].names == names[:1] else names[0]
                            wishes[names] = (value + reference[noise] - max(reference.values()), held[1], added)
            ranked = sorted(wishes, key=lambda names: -wishes[names][0])
            best_so_far = max(score for score, _ in grown.values())
            grown = {}
            for rank, names in enumerate(ranked[: self.beam]):
                score, parent_candidate, added = wishes[names]
                # A combination that screening puts this far behind cannot come to matter.
                if score < best_so_far - 3 and (size > 1 or rank > 0):
                    continue
                candidate = self._refit(parent_candidate, added, screened)
                if candidate is None:
                    continue
                gain = max(e.log_z - max(reference.values()) for e in candidate.evidence.values())
                grown[names] = (gain, candidate)
            if not grown:
                break

    def _refit(self, parent: Candidate, added: str, screened: dict[tuple[Names, Names], float]) -> Candidate | None:
        """Refit a candidate with one more effect and keep it, or note that the effect is not felt."""
        candidate, scores = self._extend(parent, added)
        if _acts(candidate, parent):
            return self._keep(candidate)
        # Laplace fails where an effect is too small to be felt and the closed form does not; but the
        # closed form takes amplitudes of a sign that the effect cannot have, and the refit has shown that.
        names = tuple(sorted((*parent.names, added)))
        for noise, value in scores.items():
            screened[names, noise] = min(value, 0.0) + screened.get((parent.names, noise), 0.0)
        self.not_felt.add(names)
        return None

    def _refit_what_matters(self, search: Search, screened: dict[tuple[Names, Names], float]) -> None:
        """Refit whatever the screening alone would give some probability, the most probable first."""
        for _ in range(6):
            merged: dict[Names, float] = {}
            for (names, _noise), p in weighed(search).probabilities.items():
                if names not in ((), ("unknown",)) and names not in self.not_felt:
                    merged[names] = merged.get(names, 0.0) + p
            still_open = [n for n, p in merged.items() if p > 0.02 and (search.order, n) not in self.candidates]
            if not still_open:
                return
            names = max(still_open, key=lambda n: merged[n])
            parts = [part for part in subsets(names, len(names) - 1) if (search.order, part) in self.candidates]
            held = self.candidates[search.order, parts[-1]]
            for added in [n for n in names if n not in held.names]:
                grown = self._refit(held, added, screened)
                if grown is None:
                    self.not_felt.add(names)
                    for noise in held.evidence:
                        without = screened.get((held.names, noise), 0.0)
                        screened[names, noise] = min(screened.get((names, noise), np.inf), without)
                    break
                held = grown

    def _wish(
        self,
        parent: Candidate,
        reference: Mapping[Names, float],
        wishes: dict[Names, tuple[float, Candidate, str]],
    ) -> None:
        """Screen every effect that a fit does not hold yet."""
        missing = [n for n in self.mean_effects if n not in parent.names]
        templates = self._templates(parent.found, missing)
        best = max(e.log_z for e in parent.evidence.values())
        for evidence in parent.evidence.values():
            if evidence.log_z < best - _STEERING:
                continue
            problem = Linearised.of(parent.found, evidence.whitener)
            for name in missing:
                scores = _log_bayes_factors(problem, templates[name].columns)
                score = _log_mean(scores) + evidence.log_z - max(reference.values())
                names = tuple(sorted((*parent.names, name)))
                if score > wishes.get(names, (-np.inf,))[0]:
                    wishes[names] = (score, parent, name)

    def _extend(self, parent: Candidate, name: str) -> tuple[Candidate, dict[Names, float]]:
        """Refit with one more effect, from the best entries of its bank; give the closed-form scores too."""
        effect = self.mean_effects[name]
        templates = self.templates.of(parent.found, effect)
        by_noise: dict[Names, float] = {}
        for noise, evidence in parent.evidence.items():
            scores = _log_bayes_factors(Linearised.of(parent.found, evidence.whitener), templates.columns)
            by_noise[noise] = _log_mean(scores)
        best = max(parent.evidence.values(), key=lambda e: e.log_z)
        problem = Linearised.of(parent.found, best.whitener)
        scores = _log_bayes_factors(problem, templates.columns)
        leader = int(np.argmax(scores))
        log_share = parent.log_share + templates.log_share(leader, scores)
        model = parent.found.model.with_effect(templates.variant(leader))
        starts = []
        rivals = np.flatnonzero(templates.choice == templates.choice[leader])
        ranked = rivals[np.argsort(-scores[rivals])]
        for at in ranked[: 2 if scores[leader] > 5 else 1]:
            columns = templates.columns[at]
            amount = np.asarray(np.linalg.lstsq(problem.project(columns), problem.residual)[0], dtype=np.float64)
            setting = effect.start(templates.settings[at], amount)
            z = parent.found.z + problem.absorbed(parent.found, columns @ amount)
            starts.append(np.concatenate([z, model.scores_of(setting[None, :])[0]]))
        weights = {**parent.weights, name: templates.weights(scores)}
        return self._weighed(model, np.stack(starts), log_share=log_share, weights=weights), by_noise

    def _other_orders(self, search: Search) -> None:
        """Refit the leading hypotheses at the SSF orders that could rival the one of the search."""
        if self.sensor is not None:
            return
        first = weighed(search)
        ranked = sorted(first.probabilities, key=lambda key: -first.probabilities[key])
        leaders = list(dict.fromkeys(mean for mean, _ in ranked if mean and mean != ("unknown",)))[:2]
        for names in leaders:
            if sum(p for (mean, _), p in first.probabilities.items() if mean == names) < 1e-3:
                continue
            source = self.candidates.get((search.order, names))
            if source is None:
                continue
            for n, sensor in self.sensors.items():
                if n == search.order or n > search.order + 1:
                    continue
                null = self.candidates[n, ()]
                effects = source.found.model.effects
                model = Model(sensor, effects, self.recording.plan)
                own = source.found.z[source.found.model.sensor.n_params :]
                start = np.concatenate([null.found.z, own])[None, :]
                candidate = self._weighed(
                    model, start, log_share=source.log_share, weights=source.weights, max_steps=15
                )
                if _acts(candidate, null):
                    self._keep(candidate)


def weighed(search: Search) -> Search:
    """Turn evidences into probabilities of (mean, noise) hypotheses, summed over SSF orders."""
    prior, n_effects = search.prior, sum(e.stage is not Stage.NOISE for e in search.effects.values())
    orders = sorted(search.sensors)
    log_order = -math.log(len(orders))
    log_p: dict[tuple[Names, Names], float] = {}
    null_at = search.candidates[search.order, ()]
    for noise in search.noise_models:
        log_noise = prior.log_noise(noise, len(search.noise_models))
        clean = [search.candidates[n, ()].evidence[noise].log_z for n in orders if (n, ()) in search.candidates]
        log_clean = float(logsumexp(clean)) + log_order
        log_p[(), noise] = log_clean + prior.log_mean((), n_effects) + log_noise
        log_p[("unknown",), noise] = (
            null_at.evidence[noise].log_z + log_order + search.unknown[noise] + math.log(prior.unknown) + log_noise
        )
        refitted = {names for _, names in search.candidates if names}
        log_z: dict[Names, float] = {(): null_at.evidence[noise].log_z}
        for names in refitted:
            values = [c.evidence[noise].log_z for (_, key), c in search.candidates.items() if key == names]
            log_z[names] = float(logsumexp(values))
            log_p[names, noise] = log_z[names] + log_order + prior.log_mean(names, n_effects) + log_noise
        for (names, model), value in search.screened.items():
            if model == noise and names not in refitted:
                # Screening says what is gained over the best part that was refitted.
                part = max((part for part in subsets(names, len(names) - 1) if part in log_z), key=log_z.__getitem__)
                gained = value - search.screened.get((part, noise), 0.0)
                log_p[names, noise] = log_z[part] + gained + log_order + prior.log_mean(names, n_effects) + log_noise
    total = float(logsumexp(list(log_p.values())))
    clean_by_order = {
        n: float(logsumexp([search.candidates[n, ()].evidence[k].log_z for k in search.noise_models])) for n in orders
    }
    norm = float(logsumexp(list(clean_by_order.values())))
    return replace(
        search,
        probabilities={key: math.exp(value - total) for key, value in log_p.items()},
        order_probabilities={n: math.exp(v - norm) for n, v in clean_by_order.items()},
    )


def _acts(candidate: Candidate, parent: Candidate) -> bool:
    """Tell whether an added effect is felt: the fit improves by more than a parameter's fair share."""
    n_points = len(candidate.found.residuals)
    return 2 * n_points * math.log(parent.found.sd / candidate.found.sd) > 3.0


def _best_log_z(candidate: Candidate) -> float:
    return max(e.log_z for e in candidate.evidence.values())


def _log_bayes_factors(problem: Linearised, columns: Sequence[FloatArray]) -> FloatArray:
    blocks = Blocks.of(problem, columns, [""] * len(columns))
    return block_log_bayes_factors(blocks, problem.residual[:, None], problem.n_points)[:, 0]


def _by_family(values: FloatArray, families: Sequence[str]) -> dict[str, float]:
    """Average Bayes factors within each covariate."""
    names = np.array(families)
    return {
        f: float(logsumexp(values[names == f])) - math.log(int(np.sum(names == f))) for f in dict.fromkeys(families)
    }


def _log_mean(scores: FloatArray) -> float:
    return float(logsumexp(scores)) - math.log(len(scores))


def _screened_pairs(
    problem: Linearised, templates: Mapping[str, EffectTemplates], singles: Mapping[str, FloatArray]
) -> dict[Names, float]:
    """Weigh pairs: as if each effect stood alone, and what their best entries gain or lose together."""
    best = {name: np.argsort(-scores)[:_BEST_ENTRIES] for name, scores in singles.items()}
    pairs = [pair for pair in subsets(list(templates), 2) if len(pair) == 2]
    entries = [(a, b, i, j) for a, b in pairs for i in best[a] for j in best[b]]
    columns = [np.concatenate([templates[a].columns[i], templates[b].columns[j]], axis=1) for a, b, i, j in entries]
    together = _log_bayes_factors(problem, columns)
    apart = np.array([singles[a][i] + singles[b][j] for a, b, i, j in entries])
    out: dict[Names, float] = {}
    at = 0
    for a, b in pairs:
        block = slice(at, at + len(best[a]) * len(best[b]))
        at = block.stop
        gained = float(logsumexp(together[block]) - logsumexp(apart[block]))
        out[a, b] = _log_mean(singles[a]) + _log_mean(singles[b]) + gained
    return out
