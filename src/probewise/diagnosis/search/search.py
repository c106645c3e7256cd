"""Score, weigh, combine: find the set of effects that explains the recording.

Every subset of effects on the mean, under every noise model and several SSF orders, and whatever has no
name beside each of them. Templates screen, a beam of the best is refitted jointly and non-linearly,
Laplace weighs.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import IntArray
from probewise.diagnosis.evidence.bank import Bank
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.evidence.screening import log_mean, score_effects, score_pairs
from probewise.diagnosis.evidence.templates import EffectTemplates, TemplateMemory
from probewise.diagnosis.fitting.coordinates import default_sensor
from probewise.diagnosis.fitting.fit import Fit, Model, start_with_more_gaussians, starts_of_one_gaussian
from probewise.diagnosis.fitting.free_form import FreeForm
from probewise.diagnosis.fitting.null import Null
from probewise.diagnosis.noise.law import steps_within_scans, white
from probewise.diagnosis.residuals.bases import unknown_templates, unlike_named
from probewise.diagnosis.residuals.covariates import covariates_of, slope_along_the_move
from probewise.diagnosis.search.noises import Noises
from probewise.diagnosis.search.odds import PriorOdds
from probewise.diagnosis.search.refits import Refits, acts
from probewise.diagnosis.search.unknown import Unknown
from probewise.diagnosis.search.unnamed import give_way
from probewise.diagnosis.search.weighed import STEERING, Candidate, Search, outside, weighed
from probewise.effects import EFFECTS, UNNAMED, Extent, NamedEffect, NoiseEffect
from probewise.recordings.plan import Recording
from probewise.sensor import Stage

__all__ = ["search"]

Names = tuple[str, ...]

# An effect may look like another Gaussian, and be explained better by its name at fewer of them.
_RIVAL_ORDER = 100.0  # nats behind the best: an SSF order so far back is not searched
_WORTH_GROWING = 20.0  # nats behind the best of its size: nothing more grows from there
_WORTH_PAIRING = 2.0  # nats of the best effect alone, below which no pair stands out either
_WITH_UNKNOWN = 4  # refitted candidates that something unknown is weighed beside
_SINGLES = 6  # effects that are refitted alone
_UNNAMED = 3  # combinations of one size that are refitted with something outside the vocabulary
_WORTH_REFITTING = 6.0  # nats behind the best so far: screening about a fit that one effect has bent is so far off
_TAKEN_APART = 3  # leading combinations, of which each effect is left out in turn
_SWAPPED = 2  # other effects that are tried in its stead
_FAINT = 0.35  # of a trace; where a null leaves no more to first order, a large effect may show in another way
_AT_OTHER_ORDERS = 6  # leading combinations that are refitted at other SSF orders
_LEAST_ELSEWHERE = 1e-4  # probability of such a combination
_PAIRED = 12  # effects that pairs are screened of, the best alone


def search(
    recording: Recording,
    effects: Mapping[str, NamedEffect[Any]],
    *,
    sensor: Null | None,
    prior: PriorOdds | None = None,
    max_order: int = 3,
    beam: int = 8,
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
        What is believed of the sensor, or of any other model; None: calibrated from the recording alone.
    prior
        Prior odds.
    max_order
        Largest SSF order tried without a sensor; one more where the largest wins.
    beam, depth
        How many combinations of each size above one are refitted, and the largest size.
    """
    return _Searcher(recording, effects, sensor, prior or PriorOdds.over(effects), max_order, beam, depth).run()


@dataclass(eq=False)
class _Searcher:
    """The state of one search: a memory of fits, filled as the beam widens."""

    recording: Recording
    effects: Mapping[str, NamedEffect[Any]]
    sensor: Null | None
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
        on_noise = {n: cast(NoiseEffect, e) for n, e in self.effects.items() if e.stage is Stage.NOISE}
        self.noises = Noises(self.recording, on_noise, self.prior)
        self.refits = Refits(self.sensor, self.noises, self.templates)
        self.candidates: dict[tuple[int, Names], Candidate] = {}
        self.sensors: dict[int, Null] = {}
        self.about_null: dict[tuple[Names, Names], float] = {}  # (mean, noise) -> log evidence
        self.about_parts: dict[tuple[Names, Names], float] = {}
        self.not_felt: set[Names] = set()
        self.grown: set[tuple[Candidate, str]] = set()  # what was refitted from where
        self.spoken_for: set[Names] = set()  # without a name, and not to be told from what has one

    def run(self) -> Search:
        self._null_fits()
        null = max(self._nulls(), key=lambda c: c.log_z)
        if self.noises.pair_up(null.found, null.evidence):
            for candidate in self._nulls():
                self._keep(candidate.with_evidence(self.noises.weigh(candidate.found)))
        null = max(self._nulls(), key=lambda c: c.log_z)
        self.about = null.found
        level = null.found.predicted
        model, z = null.found.model, null.found.z[None, :]
        slope = slope_along_the_move(lambda moved: model.predict(z, moved)[0], model.plan)[self.usable]
        covariates = covariates_of(self.recording.plan, self.usable, level, slope)
        starts = np.flatnonzero(steps_within_scans(self.recording) == 0)
        bases = unknown_templates(covariates, level - level.min(), slope, starts)
        named = [effect for name, effect in self.mean_effects.items() if name not in UNNAMED]
        problem = Linearised.of(null.found, self.refits.law_of(null))
        self.unknown = Unknown(
            unlike_named(bases, self.templates.bank(null.found, named), problem),
            tuple(covariates),
            self.noises,
            lambda worth: self._coincidence(worth, self.prior.unknown_coincidence),
        )
        if self.depth > 1:
            self._screen_pairs(null)
        self._grow_beam()
        self._take_apart()
        # Beside a form of the SSF that the readings refute, it is the form that is missing.
        best = max(c.log_z for c in self._nulls())
        self.unknown.weigh([c for c in self._nulls() if c.log_z > best - _WORTH_GROWING])
        self._refit_what_matters()
        self._other_orders()
        self.candidates, self.spoken_for = give_way(self.candidates, self.noises)
        refitted = [c for c in self.candidates.values() if c.names]
        self.unknown.weigh(sorted(refitted, key=lambda c: -c.log_z)[:_WITH_UNKNOWN])
        self.unknown.give_way(self.candidates.values())
        return self._weighed_up()

    def _weighed_up(self) -> Search:
        return weighed(
            Search(
                self.recording,
                self.effects,
                self.noises.models,
                self.noises.certain,
                self.sensors,
                self.candidates,
                self._screened(),
                self.unknown.log_z,
                self.prior,
                self.unknown.covariates,
                self.unknown.bases,
                self.unknown.shares,
                self.about,
                self.templates,
            )
        )

    def _screened(self) -> dict[tuple[Names, Names], float]:
        """Log evidence of what was not refitted, by screening.

        About a fit that holds part of it a combination is judged better than about the null; there, what
        refits have made of its parts since is put right.
        """
        refitted = {names for _, names in self.candidates}
        out = {}
        for (names, noise), value in self.about_null.items():
            parts = [p for p in itertools.combinations(names, len(names) - 1) if p in refitted]
            gains = [
                max(c.evidence[noise].log_z for (_, key), c in self.candidates.items() if key == part)
                - self.about_null.get((part, noise), np.inf)
                for part in parts
            ]
            out[names, noise] = value + max(gains, key=abs, default=0.0) if np.all(np.isfinite(gains)) else value
        out |= self.about_parts
        return {key: value for key, value in out.items() if key[0] not in refitted | self.spoken_for}

    def _nulls(self) -> list[Candidate]:
        return [c for (_, names), c in self.candidates.items() if not names]

    def _keep(self, candidate: Candidate) -> Candidate:
        self.candidates[candidate.n_gaussians, candidate.names] = candidate
        return candidate

    def _null_fits(self) -> None:
        """Fit the null with SSFs of one Gaussian, of free form, and of more Gaussians; one more is always a rival."""
        plan, law = self.recording.plan, white(self.n_points, least=self.noises.least_sd)
        if self.sensor is not None:
            self.sensors[self.sensor.n_gaussians] = self.sensor
            self._keep(self.refits.weighed(Model(self.sensor, (), plan), self.sensor.starts, law))
            return
        first = default_sensor(self.extent, 1)
        self.sensors[1] = first
        last = self._keep(self.refits.weighed(Model(first, (), plan), starts_of_one_gaussian(first), law))
        if self.max_order == 1:
            return
        free = FreeForm.about(first)
        self.sensors[free.n_gaussians] = free
        bent = self._keep(
            self.refits.weighed(Model(free, (), plan), free.start_from(last.found.z), self.refits.law_of(last))
        )
        best = max(bent.log_z, last.log_z)
        for n in range(2, self.max_order + 2):
            # One more than the best is always a rival; beyond one that is far behind nothing is to be found.
            if n > 2 and last.log_z < best - STEERING:
                break
            wanted = default_sensor(self.extent, n)
            self.sensors[n] = wanted
            starts = start_with_more_gaussians(last.found.model.sensor, last.found.z, wanted)
            last = self._keep(self.refits.weighed(Model(wanted, (), plan), starts, self.refits.law_of(last)))
            best = max(best, last.log_z)

    def _log_prior(self, names: Names) -> float:
        return self.prior.log_mean(names)

    def _coincidence(self, worth: int, each: float | None = None) -> float:
        """Give the nats against effects beside an SSF worth so few Gaussians, where the null alone takes more.

        Averaged over the null's orders: what an order wins by chance, by a fraction of a nat, must not count whole.
        """
        nulls = self._nulls()
        log_z = np.array([c.log_z for c in nulls])
        spared = np.array([max(c.worth - worth, 0) for c in nulls])
        return float(logsumexp(log_z) - logsumexp(log_z - (self.prior.coincidence if each is None else each) * spared))

    def _templates(self, found: Fit, names: Sequence[str]) -> dict[str, EffectTemplates]:
        return {n: self.templates.of(found, self.mean_effects[n]) for n in names}

    def _screen_pairs(self, null: Candidate) -> None:
        """Weigh all pairs about the null by templates, under the noise models that steer."""
        templates = self._templates(null.found, list(self.mean_effects))
        for noise, evidence in null.steering():
            problem = Linearised.of(null.found, evidence.law)
            singles = score_effects(problem, self._bank(null))
            ranked = sorted(singles, key=lambda name: -float(singles[name].max()))[:_PAIRED]
            if not ranked or log_mean(singles[ranked[0]]) < _WORTH_PAIRING:
                continue
            singles = {name: singles[name] for name in ranked}
            for pair, value in score_pairs(problem, {n: templates[n] for n in ranked}, singles).items():
                self.about_null[pair, noise] = evidence.log_z + value

    def _grow_beam(self) -> None:
        """Refit the best combinations of each size, each grown from the best of the size before."""
        best = max(self._nulls(), key=lambda c: c.log_z)
        grown = [
            c for c in self._nulls() if c.log_z > best.log_z - (_RIVAL_ORDER if c.worth <= best.worth else STEERING)
        ]
        for size in range(1, min(self.depth, len(self.mean_effects)) + 1):
            wishes: dict[Names, tuple[float, Candidate, str]] = {}
            for parent in grown:
                self._wish(parent, wishes)
            if size == 2:
                self._wish_for_pairs(wishes)
            odds = {names: score + self._log_prior(names) for names, (score, _, _) in wishes.items()}
            # A user's own effect was named to be tried, however far it leads from where screening is linear; and
            # screening says nothing of what the null takes up all but a little of to first order.
            always = (self.mean_effects.keys() - EFFECTS) | self._faint(best) if size == 1 else set()
            grown = []
            for names in self._worth_refitting(odds, size, always):
                _, parent, added = wishes[names]
                candidate = self._refit(parent, added)
                if candidate is not None:
                    grown.append(candidate)
            if not grown:
                break
            grown = [c for c in grown if c.log_z > max(r.log_z for r in _rivals(c.names, grown)) - _WORTH_GROWING]

    def _worth_refitting(self, odds: Mapping[Names, float], size: int, always: set[str]) -> list[Names]:
        """Choose which combinations are refitted, by the odds that screening gives them; `always` are effects alone."""
        ranked = sorted(odds, key=lambda names: -odds[names])
        named, rest = [n for n in ranked if not outside(n)], [n for n in ranked if outside(n)]
        behind = _WORTH_REFITTING if size == 1 else STEERING
        chosen = ranked[:1] if size == 1 else []
        for names in [*named[: _SINGLES if size == 1 else self.beam], *rest[:_UNNAMED]]:
            rivals = _rivals(names, self.candidates.values())
            # A combination that screening puts this far behind cannot come to matter.
            if odds[names] >= max(c.log_z + self._log_prior(c.names) for c in rivals) - behind:
                chosen.append(names)
        return list(dict.fromkeys([*chosen, *(names for names in ranked if names[0] in always)]))

    def _wish(self, parent: Candidate, wishes: dict[Names, tuple[float, Candidate, str]]) -> None:
        """Screen every effect that a fit does not hold yet, by its templates about the null of the same SSF."""
        null = self.candidates[parent.n_gaussians, ()]
        bank = self._bank(null)
        against = 0.0 if parent.names else self._coincidence(parent.worth)
        for noise, evidence in parent.steering():
            scores = score_effects(Linearised.of(parent.found, evidence.law), bank)
            for name, own in scores.items():
                if name in parent.names:
                    continue
                names = tuple(sorted((*parent.names, name)))
                score = evidence.log_z + log_mean(own) - against
                known = self.about_parts if parent.names else self.about_null
                if names not in self.not_felt:  # a refit has said more
                    known[names, noise] = max(score, known.get((names, noise), -np.inf))
                if score > wishes.get(names, (-np.inf,))[0]:
                    wishes[names] = (score, parent, name)

    def _bank(self, null: Candidate) -> Bank:
        return self.templates.bank(null.found, list(self.mean_effects.values()))

    def _faint(self, null: Candidate) -> set[str]:
        """Name the effects of which a fit leaves little to first order, whatever their setting."""
        bank = self._bank(null)
        left = bank.surviving(Linearised.of(null.found, null.law))
        return {name for name, members in bank.members.items() if left[members].max() < _FAINT}

    def _wish_for_pairs(self, wishes: dict[Names, tuple[float, Candidate, str]]) -> None:
        """Wish for pairs by what they promise together, where neither effect leads alone."""
        for (names, _), value in self.about_null.items():
            if names in wishes and value > wishes[names][0]:
                wishes[names] = (value, *wishes[names][1:])

    def _refit(self, parent: Candidate, added: str) -> Candidate | None:
        """Refit a candidate with one more effect and keep the best of its kind, or note that the effect is not felt."""
        against = 0.0 if parent.names else self._coincidence(parent.worth)
        candidate, scores = self.refits.extended(parent, self.mean_effects[added], against)
        self.grown.add((parent, added))
        known = self.candidates.get((candidate.n_gaussians, candidate.names), candidate)
        if acts(candidate, parent):
            return self._keep(max(known, candidate, key=lambda c: c.log_z))
        if known is not candidate:
            return known
        # Laplace fails where an effect is too small to be felt and the closed form does not; but the
        # closed form takes amplitudes of a sign that the effect cannot have, and the refit has shown that.
        names = tuple(sorted((*parent.names, added)))
        for noise, value in scores.items():
            self.about_parts[names, noise] = parent.evidence[noise].log_z + min(value, 0.0) - against
        self.not_felt.add(names)
        return None

    def _refit_what_matters(self) -> None:
        """Refit whatever the screening alone would give some probability, the most probable first."""
        for _ in range(6):
            merged: dict[Names, float] = {}
            refitted = {names for _, names in self.candidates}
            for (names, _noise), p in self._weighed_up().probabilities.items():
                if names not in ((), ("unknown",)) and names not in self.not_felt and names not in refitted:
                    merged[names] = merged.get(names, 0.0) + p
            still_open = [n for n, p in merged.items() if p > 0.02]
            if not still_open:
                return
            self._reach(max(still_open, key=lambda n: merged[n]))

    def _take_apart(self) -> None:
        """Refit the leading combinations less one effect, and grow them again from there.

        What screening put first may be superfluous, or have stood for another effect while there was but one. And the
        scans that an effect is bound to, or the place it is at, were chosen while it stood for both.
        """
        ranked = sorted(self.candidates.values(), key=lambda c: -(c.log_z + self._log_prior(c.names)))
        several = [c for c in ranked if len(c.names) > 1]
        named, rest = [c for c in several if not outside(c.names)], [c for c in several if outside(c.names)]
        for candidate in [*named[:_TAKEN_APART], *rest[:1]]:
            for left_out in candidate.names:
                others = tuple(name for name in candidate.names if name != left_out)
                if others not in {names for _, names in self.candidates} | self.not_felt:
                    self._reach(others)
                held = [c for (_, key), c in self.candidates.items() if key == others]
                if held:
                    self._grow_again(max(held, key=lambda c: c.log_z), candidate.names)

    def _grow_again(self, held: Candidate, names: Names) -> None:
        """Refit a candidate with what makes it these names, and with what leads beside it."""
        wishes: dict[Names, tuple[float, Candidate, str]] = {}
        self._wish(held, wishes)
        odds = {key: score + self._log_prior(key) for key, (score, _, _) in wishes.items()}
        chosen = [names, *self._worth_refitting(odds, len(names), set())[:_SWAPPED]]
        for added in [wishes[key][2] for key in chosen if key in wishes]:
            if (held, added) not in self.grown:
                self._refit(held, added)

    def _reach(self, names: Names) -> None:
        """Refit a combination, from the largest of its parts that is."""
        parts = [c for (_, part), c in self.candidates.items() if set(part) < set(names)]
        held = max(parts, key=lambda c: (len(c.names), c.log_z))
        for added in [n for n in names if n not in held.names]:
            grown = self._refit(held, added)
            if grown is None:
                self.not_felt.add(names)
                for noise, evidence in held.evidence.items():
                    known = self.about_parts.get((names, noise), np.inf)
                    self.about_parts[names, noise] = min(known, evidence.log_z)
                break
            held = grown

    def _other_orders(self) -> None:
        """Refit the leading hypotheses at the SSF orders that could rival the one of the search."""
        if self.sensor is not None:
            return
        by_mean = self._weighed_up().by_mean
        # What has no name may lead at an order at which no name was tried yet: that must not keep the names from it.
        known = sum(p for names, p in by_mean.items() if names != ("unknown",))
        leaders = sorted((names for names in by_mean if names not in ((), ("unknown",))), key=lambda n: -by_mean[n])
        for names in leaders[:_AT_OTHER_ORDERS]:
            held = [c for (_, key), c in self.candidates.items() if key == names]
            if held and by_mean[names] >= _LEAST_ELSEWHERE * known:
                source = max(held, key=lambda c: c.log_z)
                for n in self._rival_orders(source):
                    self._carry_over(source, n)

    def _rival_orders(self, source: Candidate) -> list[int]:
        """List the SSF orders at which what is refitted at one is worth another refit."""
        own = self.candidates[source.n_gaussians, ()].log_z
        behind = own - _WORTH_REFITTING
        return [
            n
            for n, sensor in self.sensors.items()
            if (n, source.names) not in self.candidates
            # A freer SSF that does not pay by itself does not pay beside an effect.
            and (sensor.worth < source.worth or self.candidates[n, ()].log_z > behind)
            and (sensor.worth <= source.worth + 1 or self.candidates[n, ()].log_z > own)
        ]

    def _carry_over(self, source: Candidate, n: int) -> None:
        """Refit a candidate's effects at another SSF order; keep it where they are felt."""
        null, sensor = self.candidates[n, ()], self.sensors[n]
        own = source.found.z[source.found.model.sensor.n_params :]
        candidate = self.refits.weighed(
            Model(sensor, source.found.model.effects, self.recording.plan),
            np.concatenate([null.found.z, own])[None, :],
            self.refits.law_of(source),
            max_steps=15,
        )
        log_share = source.log_share + self._coincidence(source.worth) - self._coincidence(sensor.worth)
        candidate = candidate.as_share(log_share, source.weights)
        if acts(candidate, null):
            self._keep(candidate)


def _rivals(names: Names, among: Iterable[Candidate]) -> list[Candidate]:
    """List those that a combination competes with: what has no name does not keep names from being tried."""
    return [c for c in among if outside(names) or not outside(c.names)]
