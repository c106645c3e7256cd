"""The result of a search: evidence and posterior probability of every hypothesis, and the refits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import logsumexp

from probewise.diagnosis.fit import Fit, Null
from probewise.diagnosis.locate import Covariate
from probewise.diagnosis.outlying import outlier_probabilities
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.prior_odds import Names, PriorOdds
from probewise.diagnosis.search.refits import (
    ALIASED_NATS,
    Refits,
    WeighedFit,
    effects_out_of_vocabulary,
    expected_log_bayes_factor,
    noise_effects_in_vocabulary,
    or_impossible,
)
from probewise.diagnosis.templates import TemplateBank, TemplateCache
from probewise.effects import PROPOSAL, is_out_of_vocabulary, name_of_first_copy
from probewise.effects.effect import ROWS_OF_A_SIDE
from probewise.effects.noise import outliers
from probewise.sensor import Stage

_BEYOND_DOUBT = math.log(1000)  # log odds of outlying readings against noise without them
_TIE = 0.01  # nats between hypotheses that are one: a fit stops when a step gains less than half of it


@dataclass(frozen=True, eq=False)
class Evidences:
    """Log evidences of hypotheses.

    A hypothesis is a pair (mean, noise): the names of its effects on the mean, and on the noise. The mean ("unknown",)
    stands for an unknown effect, alone or with others. The SSF order is the number of Gaussians.

    `fits`: refits by (SSF order, mean), with their evidence by noise; `screened`: combinations not refitted, by
    templates: (mean, noise) -> log evidence; `unknown`: unknown effects added to fits: (SSF order, mean, noise) -> log
    evidence; `unknown_shares`: share of each family of bases, such as "time", in the evidence of an unknown effect.
    """

    fits: Mapping[tuple[int, Names], WeighedFit]
    screened: Mapping[tuple[Names, Names], float] = field(default_factory=dict)
    unknown: Mapping[tuple[int, Names, Names], float] = field(default_factory=dict)
    unknown_shares: Mapping[str, float] = field(default_factory=dict)

    def named_outweigh_unknown(self, order: int, names: Names, noise: Names) -> bool:
        """Return whether the named effects gain more evidence over the null than everything without a name over them.

        Without a name are the unknown effect, and the effects of `names` that are out of vocabulary; if all of `names`
        are, only the unknown effect counts. The comparison is at one SSF order, under one noise model.
        """
        named = tuple(name for name in names if not is_out_of_vocabulary(name)) or names
        if not names or not {(order, ()), (order, named)} <= self.fits.keys():
            return False
        gained = self.fits[order, named].evidence[noise].log_z - self.fits[order, ()].evidence[noise].log_z
        return gained > self.unknown[order, names, noise] - self.fits[order, named].evidence[noise].log_z

    def reported_as(self, mean: Names) -> Names:
        """Return the names by which a combination is reported: ("unknown",) if any of its effects has no name.

        Its named part is reported instead if that alone has over half of the gain over the null.
        """
        named = tuple(name for name in mean if not is_out_of_vocabulary(name))
        if mean == ("unknown",) or named == mean:
            return mean
        nothing = self._largest_log_z(())
        explains_more = self._largest_log_z(named) - nothing > 0.5 * (self._largest_log_z(mean) - nothing)
        return named if named and explains_more else ("unknown",)

    def best_formula_beside(self, fit: WeighedFit, noise: Names) -> WeighedFit | None:
        """Return the refit of largest evidence that adds formulas alone to the effects of another fit, if any."""
        options = [
            more
            for (n, names), more in self.fits.items()
            if n == fit.n_gaussians
            and {*fit.names} < {*names}
            and all(name.startswith(PROPOSAL) for name in {*names} - {*fit.names})
        ]
        return max(options, key=lambda more: more.evidence[noise].log_z, default=None)

    def only_outlying_readings_differ(self, prior: PriorOdds, certain: Names) -> bool:
        """Return whether effects on the mean that beat outlying readings change no other readings than those.

        Outlying readings are beyond doubt then without an effect. Jumps before the last reading, or delays past the
        first, are many ways to say the same of fewer than five rows; the others differ by less than the three nats that
        tell aliases apart.
        """
        noise = tuple(sorted({outliers.name, *certain}))
        nulls = [fit for (_, names), fit in self.fits.items() if not names and {noise, certain} <= fit.evidence.keys()]
        if not nulls:
            return False
        null = max(nulls, key=lambda fit: fit.evidence[noise].log_z)
        least = null.evidence[noise].log_z
        odds = prior.log_prior_on_noise((outliers.name,)) - prior.log_prior_on_noise(())
        rivals = [fit for (_, names), fit in self.fits.items() if names and fit.log_z > least]
        if not rivals or not least - max(fit.evidence[certain].log_z for fit in nulls) + odds > _BEYOND_DOUBT:
            return False
        law = null.evidence[noise].likeliest_law
        narrow = 1 - outlier_probabilities(null.found.residuals, law)
        sd = law.likeliest_sigma_of(null.found.residuals)
        apart = (law(fit.found.predicted - null.found.predicted) / sd for fit in rivals)
        return all(
            0.5 * float(narrow @ change**2) < ALIASED_NATS and np.count_nonzero(np.abs(change) > 1) < ROWS_OF_A_SIDE
            for change in apart
        )

    def _largest_log_z(self, names: Names) -> float:
        return max((fit.log_z for (_, key), fit in self.fits.items() if key == names), default=-math.inf)

    def with_log_evidence_shifted(self, gaps: Mapping[tuple[int, Names], float]) -> Evidences:
        """Return a copy with the log evidence of fits, with and without an unknown effect, shifted by `gaps` in nats.

        `gaps` is by (SSF order, mean), the same under every noise model.
        """
        fits = {key: fit.with_log_evidence_shifted(gaps[key]) if key in gaps else fit for key, fit in self.fits.items()}
        unknown = {(n, mean, noise): v + gaps.get((n, mean), 0.0) for (n, mean, noise), v in self.unknown.items()}
        return replace(self, fits=fits, unknown=unknown)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Probabilities of hypotheses by (names on the mean, names on the noise)."""

    probabilities: Mapping[tuple[Names, Names], float]

    @property
    def marginal_over_noise(self) -> dict[Names, float]:
        """Probability of each hypothesis on the mean, marginalised over noise models."""
        out: dict[Names, float] = {}
        for (mean, _), p in self.probabilities.items():
            out[mean] = out.get(mean, 0.0) + p
        return out

    def likeliest_noise(self, stated: Names | None = None) -> Names:
        """Return the names of the most probable noise model, of all or of those with just the `stated` effects."""
        marginal: dict[Names, float] = {}
        for (_, noise), p in self.probabilities.items():
            if stated is None or noise_effects_in_vocabulary(noise) == stated:
                marginal[noise] = marginal.get(noise, 0.0) + p
        return max(marginal, key=lambda noise: marginal[noise])


def posterior_of(evidences: Evidences, prior: PriorOdds, *, certain: Names, n_forms: int) -> Posterior:
    """Convert evidences to probabilities of hypotheses, summed over SSF orders (numbers of Gaussians)."""
    outlying = evidences.only_outlying_readings_differ(prior, certain)
    log_z: dict[tuple[Names, Names], float] = {}
    for (_, names), fit in evidences.fits.items():
        if names and outlying:
            continue
        for noise, evidence in fit.evidence.items():
            log_z[names, noise] = float(np.logaddexp(log_z.get((names, noise), -np.inf), or_impossible(evidence.log_z)))
    log_p = {key: value + prior.log_prior_on_mean(key[0]) for key, value in log_z.items()}
    for (n, names, noise), value in evidences.unknown.items():
        if names and outlying:
            continue
        # A named effect remains named if a smaller unknown one is left.
        key = (names if evidences.named_outweigh_unknown(n, names, noise) else ("unknown",)), noise
        value = or_impossible(value) + prior.log_prior_with_unknown(names)
        log_p[key] = float(np.logaddexp(log_p.get(key, -np.inf), value))
    for (names, noise), value in evidences.screened.items() if not outlying else ():
        log_p[names, noise] = or_impossible(value) + prior.log_prior_on_mean(names)
    for names, noise in log_p:
        log_p[names, noise] += prior.log_prior_on_noise(tuple(n for n in noise if n not in certain)) - math.log(n_forms)
    # Exact aliases differ by how far their fits went: within a hundredth of a nat they tie. Of those that tie the one
    # with fewer effects, on a reading before a parameter or a rate, comes first.
    level = math.inf
    for key in sorted(log_p, key=lambda key: -log_p[key]):
        level = level if level - log_p[key] < _TIE else log_p[key]
        log_p[key] = level
    log_p = dict(sorted(log_p.items(), key=lambda item: (-item[1], *map(_plainness, item[0]))))
    total = float(logsumexp(list(log_p.values())))
    return Posterior({key: math.exp(value - total) for key, value in log_p.items()})


def _plainness(names: Names) -> tuple[int, int, Names]:
    return len(names), sum(name.count(":") for name in names), names


@dataclass(frozen=True, eq=False)
class MisfitTemplates:
    """Templates by which a fit is tested for misfits: of effects, and of the basis functions of unknown effects.

    All are built about one fit (`about`), since fits to a recording predict much the same, and a test is valid with any
    templates. `covariates` are those of the basis functions.
    """

    templates: TemplateCache
    about: Fit
    unknown_bases: TemplateBank
    covariates: tuple[Covariate, ...]


@dataclass(frozen=True, eq=False)
class Searched:
    """Result of a search.

    `nulls`: the null by SSF order (number of Gaussians), without fits; `refits`: all refits, for another search of the
    same recording.
    """

    prepared: Prepared
    prior: PriorOdds
    nulls: Mapping[int, Null]
    misfit_templates: MisfitTemplates
    refits: Refits
    evidences: Evidences
    posterior: Posterior

    @property
    def certain(self) -> Names:
        """Names of the noise effects beyond doubt, which are part of every noise model."""
        return self.refits.noises.certain

    def with_evidences(self, evidences: Evidences) -> Searched:
        """Return the result with other evidences, and the probabilities that follow from them."""
        posterior = posterior_of(evidences, self.prior, certain=self.certain, n_forms=len(self.nulls))
        return replace(self, evidences=evidences, posterior=posterior)

    def with_prior_probabilities(self) -> Searched:
        """Return the result with prior instead of posterior probabilities, for readings without information."""
        effects = self.prepared.effects
        named = (
            name for name in effects if not effects_out_of_vocabulary((name,)) and name_of_first_copy(name) is None
        )
        on_mean = [name for name in named if name not in self.prepared.noise_effect_names]
        probabilities = self.prior.single_effect_priors(on_mean, self.certain)
        return replace(self, posterior=replace(self.posterior, probabilities=probabilities))

    def best_refit_of(self, names: Names, noise: Names) -> WeighedFit | None:
        """Return the refit of these effects with the number of Gaussians of largest evidence under a noise, if any."""
        options = [fit for (_, key), fit in self.evidences.fits.items() if key == names]
        return max(options, key=lambda fit: fit.evidence[noise].log_z, default=None)

    def combinations_aliased_with(self, names: Names) -> frozenset[Names]:
        """Return the combinations aliased with this one: their expected log Bayes factor is below three nats.

        One number of Gaussians at which this is so suffices. The combination () has none.
        """
        fits = self.evidences.fits
        return frozenset(
            key
            for (n, key), other in fits.items()
            if names and key and key != names and (n, names) in fits
            if expected_log_bayes_factor(fits[n, names], other) < ALIASED_NATS
        )

    def likeliest_fit_beside_unknown(self, noise: Names) -> WeighedFit | None:
        """Return the fit by names alone that, with an unknown effect added, is most probable under a noise, if any."""
        scores = {
            (n, names): value + self.prior.log_prior_with_unknown(names)
            for (n, names, own), value in self.evidences.unknown.items()
            if own == noise and not effects_out_of_vocabulary(names)
        }
        return self.evidences.fits[max(scores, key=lambda key: scores[key])] if scores else None

    def effect_probabilities_given_unknown(self) -> dict[str, float]:
        """Return, by effect, the probability that it acts too, given that an unknown effect acts."""
        scores = {
            (order, names, noise): value
            + self.prior.log_prior_with_unknown(names)
            + self.prior.log_prior_on_noise(tuple(n for n in noise if n not in self.certain))
            for (order, names, noise), value in self.evidences.unknown.items()
            if not self.evidences.named_outweigh_unknown(order, names, noise)
        }
        top = max(scores.values(), default=0.0)
        weights = {key: math.exp(score - top) for key, score in scores.items()}
        out: dict[str, float] = {}
        for (_, names, _), weight in weights.items():
            for name in names:
                out[name] = out.get(name, 0.0) + weight / sum(weights.values())
        return out

    def noise_probabilities_given_unknown(self) -> dict[str, float]:
        """Return, by effect on the noise, the probability that it acts, given that what acts on the mean is unknown."""
        unknown: dict[Names, float] = {}
        for (mean, noise), p in self.posterior.probabilities.items():
            if self.evidences.reported_as(mean) == ("unknown",):
                unknown[noise] = unknown.get(noise, 0.0) + p
        total, out = sum(unknown.values()) or 1.0, dict[str, float]()
        for noise, p in unknown.items():
            for name in noise:
                out[name] = out.get(name, 0.0) + p / total
        return out

    def template_banks_for_global_test(self, found: Fit) -> list[TemplateBank]:
        """Return the two banks by which a fit is tested: of the effects that it lacks, and of unknown effects.

        Formulas are left out: of hundreds, the search keeps those that these readings favour, and draws under the null
        would favour others. With them a p-value would be too small.
        """
        missing = [
            effect
            for name, effect in self.prepared.effects.items()
            if effect.stage is not Stage.NOISE and not name.startswith(PROPOSAL) and name not in found.model.names
        ]
        return [
            self.misfit_templates.templates.coarse_bank(self.misfit_templates.about, missing),
            self.misfit_templates.unknown_bases,
        ]

    @property
    def likeliest_order(self) -> int:
        """The most probable number of Gaussians (SSF order), over all refits, with and without an unknown effect."""
        by_order: dict[int, float] = {}
        terms = [
            (n, fit.log_z + self.prior.log_prior_on_mean(names)) for (n, names), fit in self.evidences.fits.items()
        ]
        for (n, names, _), value in self.evidences.unknown.items():
            terms.append((n, value + self.prior.log_prior_with_unknown(names)))
        for n, value in terms:
            by_order[n] = float(np.logaddexp(by_order.get(n, -np.inf), value))
        return max(by_order, key=lambda n: by_order[n])

    @property
    def null(self) -> WeighedFit:
        """The fit of the null with the likeliest number of Gaussians."""
        return self.evidences.fits[self.likeliest_order, ()]

    def leading_combination_out_of_vocabulary(self) -> Names:
        """Return the most probable combination with a formula out of vocabulary, if it beats one without; else ()."""
        by_mean = self.posterior.marginal_over_noise
        own = {names: p for names, p in by_mean.items() if effects_out_of_vocabulary(names)}
        refitted = {names for _, names in self.evidences.fits}
        leader = max(own, key=lambda names: own[names], default=())
        return leader if leader in refitted and own.get(leader, 0.0) > by_mean.get(("unknown",), 0.0) else ()

    def probabilities_of_unknown_forms(self, *, besides: Names = ()) -> dict[str, float]:
        """Return the share of each form of an unknown effect: effects out of vocabulary, families of bases.

        `besides`: effects out of vocabulary that do not count as unknown.
        """
        by_mean = self.posterior.marginal_over_noise
        unknown = by_mean.get(("unknown",), 0.0)
        shares = {family: unknown * p for family, p in self.evidences.unknown_shares.items()}
        for names, p in by_mean.items():
            unnamed = effects_out_of_vocabulary(names)
            for name in unnamed if unnamed != besides else ():
                shares[name] = shares.get(name, 0.0) + p
        total = sum(shares.values()) or 1.0
        return {name: p / total for name, p in shares.items()}
