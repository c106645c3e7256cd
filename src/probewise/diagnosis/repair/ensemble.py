"""Posterior samples of what a search has refitted: of one hypothesis, or of all that the readings leave open."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from probewise.diagnosis.repair.averaging import over_hypotheses, over_orders, side_by_side
from probewise.diagnosis.repair.repaired import ModelSamples, sample_model
from probewise.diagnosis.search.weighed_fit import Search, WeighedFit
from probewise.effects import EFFECTS

__all__ = ["Ensemble"]

Names = tuple[str, ...]

_LEAST_OF_AN_ORDER = 0.2  # probability of an SSF order, below which the model does without it
_LEAST_OF_A_RIVAL = 0.02  # probability of a hypothesis, below which the model does without it
_MOST = 6  # hypotheses in one model


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Samples under one noise model, of each hypothesis once.

    What goes into one model has an SSF of one form: mixtures of any number of Gaussians, or the free form.
    """

    search: Search
    noise: Names
    rng: np.random.Generator
    _known: dict[tuple[Names, bool], ModelSamples] = field(default_factory=dict)

    def of(self, candidate: WeighedFit) -> ModelSamples:
        """Draw from the posterior of a candidate's hypothesis, over all SSF orders of its form that matter."""
        key = candidate.names, candidate.found.model.sensor.exchangeable
        if key not in self._known:
            alike = self._of_form(candidate, candidate.names)
            log_z = np.array([c.evidence[self.noise].log_z for c in alike])
            weights = np.exp(log_z - log_z.max())
            kept = weights > _LEAST_OF_AN_ORDER * weights.sum()
            parts = [self._drawn(c) for c in itertools.compress(alike, kept)]
            self._known[key] = over_orders(parts, weights[kept] / weights[kept].sum(), rng=self.rng)
        return self._known[key]

    def likely(self, best: WeighedFit) -> dict[Names, float]:
        """Weigh what one model can hold beside the best candidate: under its noise, by the form of its SSF."""
        out: dict[Names, float] = {}
        for names in dict.fromkeys(names for _, names in self.search.candidates):
            log_z = [c.evidence[self.noise].log_z for c in self._of_form(best, names)]
            # No file holds a user's own effect; a user's own model has it where it is best itself.
            if log_z and {*names} <= {*EFFECTS, *best.names}:
                out[names] = float(np.logaddexp.reduce(log_z)) + self.search.prior.log_mean(names)
        total = np.logaddexp.reduce(list(out.values()))
        return {names: math.exp(value - total) for names, value in out.items()}

    def averaged(self, best: WeighedFit, probabilities: Mapping[Names, float]) -> ModelSamples:
        """Mix the samples of the best candidate with those of its rivals, by probability, as far as one model can."""
        kept = [(self.of(best), best, probabilities[best.names])]
        for names in sorted(set(probabilities) - {best.names}, key=lambda names: -probabilities[names]):
            if probabilities[names] < _LEAST_OF_A_RIVAL or len(kept) == _MOST:
                break
            rival = max(self._of_form(best, names), key=lambda c: c.evidence[self.noise].log_z)
            if all(side_by_side(c.found.model.effects, rival.found.model.effects) for _, c, _ in kept):
                kept.append((self.of(rival), rival, probabilities[names]))
        if len(kept) == 1:
            return kept[0][0]
        parts, shares = [part for part, _, _ in kept], np.array([p for _, _, p in kept])
        null = self.search.sensors[max(part.n_gaussians for part in parts)]
        return over_hypotheses(parts, shares, null, self.search.recording.plan, rng=self.rng)

    def _of_form(self, best: WeighedFit, names: Names) -> list[WeighedFit]:
        """List the refitted candidates of a combination whose SSF is of the form that the best one's is."""
        form = best.found.model.sensor.exchangeable
        return [
            c
            for (_, key), c in self.search.candidates.items()
            if key == names and c.found.model.sensor.exchangeable == form
        ]

    def _drawn(self, candidate: WeighedFit) -> ModelSamples:
        evidence = candidate.evidence[self.noise]
        return sample_model(candidate.found, evidence, self.search.recording, weights=candidate.weights, rng=self.rng)
