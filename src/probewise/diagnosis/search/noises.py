"""The competing noise models of a recording: their prior probabilities, and the evidence of a fit under each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence.laplace import NoiseEvidence, laplace_evidence
from probewise.diagnosis.evidence.refined_nodes import refined
from probewise.diagnosis.evidence.templates import combinations_up_to
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.names import Names
from probewise.diagnosis.noise.models import NoiseModel, least_sd_given_rounding, rough_sd, rounding_hides_noise
from probewise.diagnosis.prior_odds import PriorOdds
from probewise.diagnosis.search.constants import MOST_FAULTS, NOISE_NODES_REFINED_WITHIN, NOISE_PAIR_WITHIN
from probewise.effects import CorrelatedNoise, NoiseEffect, Quantisation, RandomWalk, lattice_step
from probewise.recordings.plan import Recording

WITH_MEMORY = frozenset({CorrelatedNoise.name, RandomWalk.name})
"""Effects on the noise of which a noise distribution can contain only one."""


@dataclass(eq=False)
class NoiseModels:
    """The noise models of one recording: each noise effect alone, and pairs and triples if fewer are significant.

    `models`: noise models by the names of their effects; `certain`: noise effects that the readings show beyond doubt,
    part of every model; `least_sd`: the least plausible sd of a reading.

    `sd_about_fit` is the noise sd about a first fit, infinite without one. Rounding is judged by it too, since
    successive readings tell the noise only if the signal varies little from one to the next.
    """

    recording: Recording
    effects: Mapping[str, NoiseEffect]
    prior: PriorOdds
    sd_about_fit: float = math.inf
    least_sd: float = field(init=False)
    certain: Names = field(init=False)
    models: dict[Names, NoiseModel] = field(init=False)

    def __post_init__(self) -> None:
        self.least_sd = least_sd_given_rounding(self.recording)
        self._step = lattice_step(self.recording.readings[self.recording.usable])
        # Readings that are all multiples of a coarse step are rounded; this is an effect if it was not declared.
        sd = min(rough_sd(self.recording) or math.inf, self.sd_about_fit)
        seen = Quantisation.seen_above * sd < self._step
        rounded = {Quantisation.name: np.array([self._step])} if Quantisation.name in self.effects and seen else {}
        shown = {
            name: effect.parameters_known_before_fit
            for name, effect in self.effects.items()
            if effect.parameters_known_before_fit is not None
        }
        self._known = {name: (values[None, :], np.zeros(1)) for name, values in (rounded | shown).items()}
        self.certain = tuple(sorted(self._known))
        self._hidden = rounding_hides_noise(self._step, sd)
        others = [name for name in self.effects if name not in (Quantisation.name, *self.certain)]
        single = [tuple(sorted({*names, *self.certain})) for names in combinations_up_to(others, 1)]
        self.models = {names: self._build_model(names) for names in single}

    def _build_model(
        self, names: Names, likely: Mapping[str, tuple[FloatArray, FloatArray]] | None = None
    ) -> NoiseModel:
        # Certain effects are not re-estimated about each fit, whose own residual may be larger.
        effects = tuple(self.effects[n] for n in names)
        rounding = self._step if self._hidden and names == self.certain else 0.0
        return NoiseModel(effects, self.recording, {**self._known, **(likely or {})}, rounding, self.least_sd)

    def log_prior(self, names: Names) -> float:
        """Return the log prior probability of a noise model; certain effects do not count."""
        return self.prior.log_prior_on_noise(self._uncertain_names(names))

    def average_log_evidence(self, log_z: Mapping[Names, float]) -> float:
        """Return the log of the evidences' average over noise models, by prior; minus infinity without any."""
        values = [value + self.log_prior(names) for names, value in log_z.items()]
        return float(logsumexp(values)) if values else -math.inf

    def evidence_by_noise(self, found: Fit) -> dict[Names, NoiseEvidence]:
        """Compute the evidence of a fit under every noise model, by the names of its effects.

        Those that may come near the best have nodes about their peak, where those of the prior lie too far apart.
        """
        evidence = {names: laplace_evidence(found, model) for names, model in self.models.items()}
        best = max((e.log_z + self.log_prior(names) for names, e in evidence.items()), default=-math.inf)
        return {
            names: refined(found, own, least=best - self.log_prior(names) - NOISE_NODES_REFINED_WITHIN)
            for names, own in evidence.items()
        }

    def best_evidence(self, evidence: Mapping[Names, NoiseEvidence]) -> NoiseEvidence:
        """Return the evidence, of those given by noise model, whose noise model is most probable, priors included."""
        return evidence[max(evidence, key=lambda names: evidence[names].log_z + self.log_prior(names))]

    def add_significant_pairs(self, found: Fit, evidence: Mapping[Names, NoiseEvidence]) -> bool:
        """Add pairs of noise effects to the models if a single one is significant about a fit; triples if a pair is.

        Only those within three nats of the best are added.

        Returns
        -------
        Whether any pair was tried.
        """
        known, singles = dict(evidence), list(evidence)
        for size in range(1, MOST_FAULTS):
            of_size = {names: e for names, e in known.items() if len(self._uncertain_names(names)) == size}
            first = max(of_size, key=lambda names: of_size[names].log_z, default=self.certain)
            parts = [n for n in known if set(n) < set(first)]
            if not parts or known[first].log_z < max(known[n].log_z for n in parts) + NOISE_PAIR_WITHIN:
                return size > 1
            # Beside another effect the likeliest values may be others: nodes about them alone would lie too close.
            of_first = laplace_evidence(found, self.models[first])
            likely = {name: of_first.likeliest_nodes_of_effect(name) for name in self._uncertain_names(first)}
            best = max(e.log_z + self.log_prior(names) for names, e in known.items())
            for other in singles:
                both = tuple(sorted({*first, *other}))
                if len(self._uncertain_names(both)) != size + 1 or set(both) >= WITH_MEMORY:
                    continue
                coarse = self.models[other].coarse_nodes_by_effect()
                nearby = laplace_evidence(found, self._build_model(both, likely | coarse))
                least = best - NOISE_PAIR_WITHIN - self.log_prior(both)
                own = refined(found, nearby, least=least)
                if own.log_z > least:
                    recentred = self._nodes_beside(found, nearby, self._uncertain_names(first))
                    self.models[both], known[both] = self._build_model(both, recentred | coarse), own
        return True

    def _nodes_beside(
        self, found: Fit, evidence: NoiseEvidence, names: Names
    ) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Return the likeliest nodes of each effect named, of all its nodes, beside the likeliest nodes of the others.

        `evidence` is that of a fit under all effects together, of which each has only few nodes.
        """
        effects = self._uncertain_names(evidence.noise.names)
        likely = {name: evidence.likeliest_nodes_of_effect(name) for name in effects}
        out = {}
        for name in names:
            beside = {other: nodes for other, nodes in likely.items() if other != name}
            again = laplace_evidence(found, self._build_model(evidence.noise.names, beside))
            out[name] = again.likeliest_nodes_of_effect(name)
        return out

    def _uncertain_names(self, names: Names) -> Names:
        return tuple(n for n in names if n not in self.certain)
