"""Templates of the effects that could be added to a fit, and banks of them with Bayes factors about any fit.

A template is a set of columns (n_usable, k), changes of the readings at given settings of an effect, which span its
change to first order; its nonlinear parameters are fixed. A fit absorbs a part of each template; the products needed
for this are computed once for each noise model.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from typing import cast

import numpy as np

from probewise._arrays import LAST_DIGITS, ROUNDING, TINY, BoolArray, FloatArray, IntArray
from probewise.diagnosis.evidence import SCALES, Linearised, scale_and_project
from probewise.diagnosis.fit import AT_ONCE, Fit, effect_values
from probewise.diagnosis.noise import NoiseLaw
from probewise.diagnosis.words import Names
from probewise.effects import Effect, name_of_first_copy
from probewise.effects.effect import LEAST_VISIBLE
from probewise.effects.reference import scan_indicator
from probewise.sensor import Stage

_MOST_REMEMBERED = 2**25  # numbers of templates that are remembered: those of a few hundred rows about every fit
_FEW_KINDS = 16  # of readings, by their precision: ends and gaps of scans make a handful; other noise, one a reading


@dataclass(eq=False)
class TemplateBank:
    """Templates, (n_points, k) each, with their Bayes factors about any fit.

    `labels`: label of each entry; several may have the same, such as the name of their effect; `which`: the number of
    each entry's template, since entries may share one, (n_entries,).
    """

    templates: tuple[FloatArray, ...]
    labels: tuple[str, ...]
    which: IntArray
    _grams: dict[tuple[bytes, ...], list[FloatArray]] = field(default_factory=dict, repr=False)
    _sums: dict[tuple[int, bool, bytes], FloatArray] = field(default_factory=dict, repr=False)
    _scores: dict[tuple[Fit, NoiseLaw], dict[str, FloatArray]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, templates: Sequence[FloatArray], labels: Sequence[str]) -> TemplateBank:
        """Build a bank of entries, with one template and one label each; the same array is kept once."""
        unique = {id(template): template for template in templates}
        numbers = {key: number for number, key in enumerate(unique)}
        which = np.array([numbers[id(template)] for template in templates], dtype=np.int64)
        return cls(tuple(unique.values()), tuple(labels), which)

    @classmethod
    def by_name(cls, each: Mapping[str, Sequence[FloatArray]]) -> TemplateBank:
        """Build a bank of the templates of each name, which is their label."""
        return cls.of([t for own in each.values() for t in own], [name for name, own in each.items() for _ in own])

    def __getitem__(self, at: int) -> FloatArray:
        """Return the template of entry number `at`, (n_points, k)."""
        return self.templates[int(self.which[at])]

    @cached_property
    def widths(self) -> IntArray:
        """Number of columns of each template, (n_templates,)."""
        return np.array([template.shape[1] for template in self.templates], dtype=np.int64)

    @cached_property
    def indices_by_label(self) -> dict[str, IntArray]:
        """Indices of the entries of each label."""
        labels = np.array(self.labels)
        return {label: np.flatnonzero(labels == label) for label in dict.fromkeys(self.labels)}

    def take_entries(self, members: IntArray) -> TemplateBank:
        """Return a bank of the entries with these indices, in this order."""
        return TemplateBank.of([self[k] for k in members], [self.labels[k] for k in members])

    @cached_property
    def groups(self) -> list[IntArray]:
        """Numbers of the templates that are multiplied together: of one width, few enough for a processor's cache."""
        out = list[IntArray]()
        for width in dict.fromkeys(self.widths.tolist()):
            members = np.flatnonzero(self.widths == width)
            # So many numbers are multiplied together as fit a processor's cache.
            at_once = max(2**19 // (max(len(self.templates[0]), 1) * width), 1)
            out += np.split(members, range(at_once, len(members), at_once))
        return out

    def log_bayes_factors(self, problem: Linearised, residuals: FloatArray | None = None) -> FloatArray:
        """Return the log Bayes factor of adding each entry to a fit, amplitude and noise sd integrated out.

        `residuals`: projected residuals, (n_rows, n_draws); the fit's own by default. Returns log Bayes factors,
        (n_entries, n_draws).
        """
        own = problem.residual[:, None] if residuals is None else residuals
        total = np.maximum(np.sum(own**2, axis=0), TINY)
        out = np.empty((len(self.templates), own.shape[1]))
        for members, _, left, along in self.projected(problem, own):
            out[members] = _log_bayes_factors_of_grams(left, along, total, problem.law.n_kept)
        return out[self.which]

    def log_bayes_factors_by_label(self, found: Fit, law: NoiseLaw) -> dict[str, FloatArray]:
        """Return the log Bayes factors of its entries about a fit under noise `law`, (n_entries,), by label; cached."""
        if (found, law) not in self._scores:
            scores = self.log_bayes_factors(Linearised.of(found, law))[:, 0]
            self._scores[found, law] = {label: scores[at] for label, at in self.indices_by_label.items()}
        return self._scores[found, law]

    def unabsorbed_shares(self, problem: Linearised) -> FloatArray:
        """Return the share of each entry's norm that a fit does not absorb, (n_entries,)."""
        out = np.empty(len(self.templates))
        for members, grams, left, _ in self.projected(problem, np.zeros((len(problem.basis), 0))):
            whole, kept = (np.trace(each, axis1=1, axis2=2) for each in (grams, left))
            out[members] = np.sqrt(np.maximum(1 - (whole - kept) / np.maximum(whole, TINY), 0.0))
        return out[self.which]

    def projected(
        self, problem: Linearised, columns: FloatArray
    ) -> Iterator[tuple[IntArray, FloatArray, FloatArray, FloatArray]]:
        """Yield products of the templates of each group, as if they were whitened and scaled to unit rms.

        They need not be for products with other columns: these are whitened once more, by the adjoint.

        `columns`: projected columns, (n_rows, k). Yields numbers of templates, (n,), Gram matrices before and after the
        fit is projected out, (n, width, width), and products with `columns`, (n, width, k).
        """
        law, n, n_absorbed = problem.law, problem.n_points, problem.basis.shape[1]
        beside = law.adjoint(np.concatenate([problem.basis[:n], columns[:n]], axis=1))
        for members, grams in zip(self.groups, self._grams_under(law), strict=True):
            norms = np.sqrt(np.maximum(np.einsum("tkk->tk", grams), 0.0))
            scale = math.sqrt(law.n_kept / grams.shape[2]) / np.where(norms > 0, norms, 1.0)
            scaled = grams * scale[:, :, None] * scale[:, None, :]
            rows = self._rows(members)
            products = (rows.reshape(-1, n) @ beside).reshape(*scale.shape, -1) * scale[:, :, None]
            taken = products[:, :, :n_absorbed]
            yield members, scaled, scaled - taken @ taken.transpose(0, 2, 1), products[:, :, n_absorbed:]

    def _rows(self, members: IntArray) -> FloatArray:
        """Return templates of one width, (n, width, n_points)."""
        every = np.concatenate([self.templates[k].T for k in members])
        return every.reshape(len(members), -1, every.shape[1])

    def _grams_under(self, law: NoiseLaw) -> list[FloatArray]:
        """Return the Gram matrices of the whitened templates of each group, (n, width, width); cached.

        Without a random walk they are sums over readings of a few precisions, which are the same for many noise models.
        """
        if (key := law.whitening_key) not in self._grams:
            given = [] if law.walk.size else law.precision
            parts = [(before, *np.unique(each, return_inverse=True)) for before, each in given]
            self._grams[key] = out = list[FloatArray]()
            for number, members in enumerate(self.groups):
                rows = self._rows(members)
                rows[:, :, law.lost] = 0.0  # before sums of which some are taken off
                if law.walk.size:
                    rows = law(rows.reshape(-1, rows.shape[2]).T).T.reshape(rows.shape)
                each = [self._weighted_grams(number, rows, *part) for part in parts] or [_gram_matrices(rows, rows)]
                out.append(np.sum(each, axis=0))
        return self._grams[key]

    def _weighted_grams(
        self, number: int, rows: FloatArray, before: IntArray | None, weights: FloatArray, kinds: IntArray
    ) -> FloatArray:
        """Return Gram matrices in which each reading has a weight, one of `weights` by its kind, (n, width, width).

        With `before` they are of each reading with another one. `number`: that of the group of templates, whose sums
        over readings of few kinds are cached.
        """
        key = number, before is None, kinds.tobytes()
        if len(weights) > _FEW_KINDS or key not in self._sums:
            others = rows if before is None else np.take(rows, before, axis=2)
        if len(weights) > _FEW_KINDS:
            grams = _gram_matrices(rows * weights[kinds], others)
        else:
            if key not in self._sums:
                # Nearly all readings are of one kind, whose sums are those of all without the rest.
                few = [np.flatnonzero(kinds == kind) for kind in range(len(weights))]
                most = int(np.argmax([len(at) for at in few]))
                few[most] = few[most][:0]
                sums = np.array([_gram_matrices(rows[:, :, at], others[:, :, at]) for at in few])
                sums[most] = _gram_matrices(rows, others) - sums.sum(axis=0)
                self._sums[key] = sums
            grams = np.einsum("k,ktij->tij", weights, self._sums[key])
        return grams if before is None else grams + grams.transpose(0, 2, 1)


def _gram_matrices(rows: FloatArray, others: FloatArray) -> FloatArray:
    """Return the products of the columns of each template, (n, width, n_points) both -> (n, width, width)."""
    if rows.shape[1] > 2:
        return np.asarray(rows @ others.transpose(0, 2, 1))
    pairs = [[(rows[:, i], others[:, j]) for j in range(rows.shape[1])] for i in range(rows.shape[1])]
    return np.array([[np.einsum("tn,tn->t", *both) for both in row] for row in pairs]).transpose(2, 0, 1)


def _gram_eigensystems(squares: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues (n, width) and eigenvectors (n, width, width) of Gram matrices (n, width, width)."""
    width = squares.shape[-1]
    if width == 1:
        return squares[:, 0], np.ones_like(squares)
    if width > 2:
        values, axes = np.linalg.eigh(squares)
        return values, axes
    # Two columns, or one as above, are the rule and have a closed form (Jacobi's rotation).
    first, second, both = squares[:, 0, 0], squares[:, 1, 1], squares[:, 0, 1]
    angle = 0.5 * np.arctan2(2 * both, first - second)
    c, s = np.cos(angle), np.sin(angle)
    both_ways = first * c * c + second * s * s + 2 * both * c * s, first * s * s + second * c * c - 2 * both * c * s
    return np.stack(both_ways).T, np.stack([np.stack([c, s], axis=1), np.stack([-s, c], axis=1)], axis=2)


def _log_bayes_factors_of_grams(grams: FloatArray, along: FloatArray, total: FloatArray, n_kept: int) -> FloatArray:
    """Return the log Bayes factors of templates of one width, (n, n_draws), with amplitude and noise sd integrated out.

    The prior of the amplitude of a unit-rms template is normal with sd kappa times the noise sd; marginalising the
    noise sd gives a Student-t. Bayes factors are averaged over the kappa of `SCALES` at which a template is detectable:
    at smaller ones the projected template has an rms lambda below `LEAST_VISIBLE`, and the Bayes factor is near one
    whatever the readings, which would keep irrelevant effects. The result is about -48 for a template that is
    detectable at no scale.

    `grams`: products of a projected template's columns, (n, width, width); `along`: their products with the residuals,
    (n, width, n_draws); `total`: sums of squares of the residuals, (n_draws,).
    """
    gain, axes = _gram_eigensystems(grams)
    gain = np.where(gain > ROUNDING * n_kept, gain, 0.0)
    turned = axes.transpose(0, 2, 1) @ along
    explained = turned**2 / np.where(gain > 0, gain, np.inf)[:, :, None] / total
    terms = np.empty((len(SCALES), len(gain), len(total)))
    visible = SCALES[:, None] ** 2 * gain.sum(axis=1) >= LEAST_VISIBLE**2
    for k, scale in enumerate(SCALES):
        ratio = scale**2 * gain
        of_all = np.einsum("bwd,bw->bd", explained, ratio / (1 + ratio))
        np.log1p(-np.minimum(of_all, 1 - LAST_DIGITS), out=terms[k])
        terms[k] *= -0.5 * n_kept
        terms[k] -= 0.5 * np.log1p(ratio).sum(axis=1)[:, None]
    terms[~visible] = -50.0  # the fit absorbs such a template entirely
    top = terms.max(axis=0)
    n_visible = np.maximum(np.count_nonzero(visible, axis=0), 1)[:, None]
    return np.asarray(top + np.log(np.exp(terms - top).sum(axis=0) / n_visible))


_RUNS_AWAY = 1e9  # times the largest prediction: such a model has diverged, and its derivative is meaningless
# Noise sds: a smaller change that is rounding, of predictions that may be by the epoch, counts as none.
_INSIGNIFICANT = 0.01


@dataclass(frozen=True, eq=False)
class EffectTemplates:
    """An effect's template bank about a fit: columns, setting and variant of each entry.

    Variants are the discrete choices of an effect, such as which scans it acts on; `choice` numbers them by entry.
    """

    columns: tuple[FloatArray, ...]  # each (n_usable, n_columns)
    settings: tuple[FloatArray, ...]  # each (n_columns, n_params)
    variants: tuple[Effect, ...]
    choice: IntArray  # number of each entry's variant, (n_entries,)

    def variant_of_entry(self, at: int) -> Effect:
        """Return the variant (discrete choice, such as of scans) of entry number `at`."""
        return self.variants[int(self.choice[at])]

    @cached_property
    def n_numbers(self) -> int:
        """Numbers in all columns."""
        return sum(columns.size for columns in self.columns)

    @cached_property
    def variant_odds(self) -> FloatArray:
        """Prior odds of each variant against the first, (n_variants,)."""
        return np.array([variant.relative_odds for variant in self.variants])

    def variant_probabilities(self, scores: FloatArray) -> FloatArray:
        """Return the posterior probability of each variant, (n_variants,), from log Bayes factors (n_entries,)."""
        shares = np.bincount(self.choice, np.exp(scores - scores.max()), len(self.variants)) * self.variant_odds
        return np.asarray(shares / shares.sum())


@dataclass(eq=False)
class TemplateCache:
    """Cache of the templates of effects about fits, on the rows `usable`; of long tables about the latest alone."""

    usable: IntArray
    known: dict[Fit, dict[Effect, EffectTemplates]] = field(default_factory=dict)
    banks: dict[tuple[Fit, tuple[str, ...]], TemplateBank] = field(default_factory=dict)

    def coarse_bank(self, found: Fit, effects: Sequence[Effect]) -> TemplateBank:
        """Return one bank of the templates of several effects about a fit, of fewer variants, labelled by name."""
        key, known = (found, tuple(effect.name for effect in effects)), self._keep(found)
        if key not in self.banks:
            few = [effect.with_fewer_variants() for effect in effects]
            for effect in few:
                known[effect] = self.templates_of(found, effect)
            self.banks[key] = TemplateBank.by_name({effect.name: known[effect].columns for effect in few})
        return self.banks[key]

    def passing_banks(self, found: Fit, effects: Sequence[Effect]) -> Iterator[TemplateBank]:
        """Yield the same in banks of a few effects each, which are not kept."""
        each, n_numbers = dict[str, tuple[FloatArray, ...]](), 0
        for effect in effects:
            own = templates_of_effect(found, effect.with_fewer_variants(), self.usable)
            each[effect.name] = own.columns
            n_numbers += own.n_numbers
            if n_numbers > 2**22 or effect is effects[-1]:  # of templates that are not remembered
                yield TemplateBank.by_name(each)
                each, n_numbers = {}, 0

    def templates_of(self, found: Fit, effect: Effect) -> EffectTemplates:
        """Return the templates of one effect about one fit; those of more variants than a bank has are not kept."""
        known = self._keep(found)
        own = known.get(effect) or self._shared_with_first(known, effect)
        return own or templates_of_effect(found, effect, self.usable)

    def _keep(self, found: Fit) -> dict[Effect, EffectTemplates]:
        """Return the templates about a fit, now the latest; forget those about the earliest if there are too many."""
        self.known[found] = self.known.pop(found, {})
        while sum(each.n_numbers for own in self.known.values() for each in own.values()) > _MOST_REMEMBERED:
            if (forgotten := next(iter(self.known))) is found:
                break
            del self.known[forgotten]
            self.banks = {key: bank for key, bank in self.banks.items() if key[0] is not forgotten}
        return self.known[found]

    def _shared_with_first(self, known: Mapping[Effect, EffectTemplates], effect: Effect) -> EffectTemplates | None:
        """Return the templates of a second copy of an effect where those of the first are known and hold them all."""
        name = name_of_first_copy(effect.name)
        first = next((own for e, own in known.items() if e.name == name), None)
        if first is None or len(first.variants) > 1 or len(effect.variants()) > 1:
            return None
        numbers = {setting.tobytes(): k for k, setting in enumerate(first.settings)}
        at = [numbers.get(setting.tobytes()) for setting in effect.variants()[0].entries]
        if None in at:
            return None
        columns, settings = (tuple(every[k] for k in cast(list[int], at)) for every in (first.columns, first.settings))
        return EffectTemplates(columns, settings, effect.variants(), np.zeros(len(at), dtype=np.int64))


def templates_of_effect(found: Fit, effect: Effect, usable: IntArray, *, most: int | None = None) -> EffectTemplates:
    """Predict the change of the readings by each bank entry of all variants of an effect, about a fit.

    Variants are its discrete choices, such as of scans. With `most`, so many entries are predicted, evenly spread.
    """
    variants = effect.variants()
    banks = [variant.entries for variant in variants]
    choice = np.repeat(np.arange(len(variants)), [len(bank) for bank in banks])
    entries = [entry for bank in banks for entry in bank]
    if most is not None and most < len(entries):
        kept = np.linspace(0, len(entries) - 1, most).round().astype(np.int64)
        choice, entries = choice[kept], [entries[k] for k in kept]
    gates = effect.variant_masks(found.model.plan)
    if gates is not None:
        always, opened = gates
        (everywhere,) = _predicted_changes(found, effect, always[None, :, :], usable)
        columns = [everywhere * opened[k][usable, None] for k in choice]
    else:
        # Variants bound to the same scans and patterns differ only in their priors and share one prediction.
        columns = []
        bound = [(variants[k].scans, variants[k].patterns, len(e)) for k, e in zip(choice, entries, strict=True)]
        for _, group in itertools.groupby(range(len(choice)), key=bound.__getitem__):
            at = list(group)
            columns += _predicted_changes(found, variants[choice[at[0]]], np.stack([entries[k] for k in at]), usable)
    return EffectTemplates(tuple(columns), tuple(entries), variants, choice)


def _predicted_changes(found: Fit, effect: Effect, bank: FloatArray, usable: IntArray) -> list[FloatArray]:
    """Return the change of the readings by each entry, (n_usable, n_columns); 0 if it is rounding, or diverges."""
    plain, plan = found.model, found.model.plan
    model = plain.with_effect(effect)
    n_rows = bank.shape[0] * bank.shape[1]
    own = {e.name: effect_values(e, found.z[None, plain.coordinate_slice(e.name)]) for e in plain.effects}
    sensor = plain.sensor.theta(found.z[None, : plain.sensor.n_params])
    there, at = model.part_that_predicts(usable)
    kept: BoolArray | slice = slice(None)
    if effect.scans:
        inside = np.flatnonzero(scan_indicator(plan, effect.scans))
        there, kept = plan.take(inside), np.isin(usable, inside, assume_unique=True)
        at = np.searchsorted(inside, usable[kept])
    # Effects after the light integral reuse it.
    seen = None if effect.stage < Stage.SEEN else plain.chain.simulated_view(plain.joined_theta(sensor, own), there)
    change = np.zeros((n_rows, len(usable)))
    step = max(AT_ONCE // len(there), 1)
    for first in range(0, n_rows, step):
        rows = slice(first, min(first + step, n_rows))
        n = rows.stop - first
        each = {name: np.repeat(values, n, axis=0) for name, values in own.items()}
        each[effect.name] = bank.reshape(n_rows, -1)[rows]
        theta = model.joined_theta(np.repeat(sensor, n, axis=0), each)
        if seen is None:
            read = model.chain.predict(theta, there)
        else:
            read = model.chain.readings_from_simulated_view(seen, theta, there)
        change[rows, kept] = (read if len(at) == len(there) else read[:, at]) - found.predicted[kept]
    size, largest = np.maximum(change.max(axis=1), -change.min(axis=1)), np.abs(found.predicted).max(initial=0.0)
    none = min(ROUNDING * largest, max(_INSIGNIFICANT * found.sd, LAST_DIGITS * largest))
    change[~((size >= none) & (size < _RUNS_AWAY * (1 + largest)))] = 0.0  # NaN too
    return np.split(change.T, len(bank), axis=1)


def log_mean_exp(scores: FloatArray) -> float:
    """Return the log of the mean of Bayes factors that are given as logs."""
    top = float(scores.max())  # thousands of short lists: scipy's general function is ten times slower
    return top + math.log(float(np.exp(scores - top).mean())) if math.isfinite(top) else top


def log_bayes_factors_of_pairs(
    problem: Linearised, templates: Mapping[str, Sequence[FloatArray]], singles: Mapping[str, FloatArray]
) -> dict[Names, float]:
    """Return the log Bayes factor of each pair of effects, by their sorted names.

    It is the sum of both effects' own (`singles`, one by template), corrected by the joint score of the best two
    templates of each.
    """
    pairs = list(combinations(sorted(singles), 2))
    if not pairs:
        return {}
    best = {name: np.argsort(-scores)[:2].tolist() for name, scores in singles.items()}
    entries = [(name, i) for name in singles for i in best[name]]
    columns = [templates[name][i] for name, i in entries]
    widths = np.array([c.shape[1] for c in columns])
    projected = scale_and_project(problem, columns)
    products, along = projected.T @ projected, projected.T @ problem.residual[:, None]
    own = dict(zip(entries, np.split(np.arange(len(along)), np.cumsum(widths)[:-1]), strict=True))
    asked = [((a, i), (b, j)) for a, b in pairs for i in best[a] for j in best[b]]
    both = [np.concatenate([own[first], own[second]]) for first, second in asked]
    together, n_columns = np.empty(len(both)), np.array([len(at) for at in both])
    total = np.maximum(np.sum(problem.residual[:, None] ** 2, axis=0), TINY)
    per_column = np.sqrt(np.repeat(widths, widths))
    for width in set(n_columns.tolist()):
        members = np.flatnonzero(n_columns == width)
        at = np.array([both[k] for k in members])
        scale = (per_column[at] / math.sqrt(width))[:, :, None]  # both together of unit rms
        grams = products[at[:, :, None], at[:, None, :]] * scale * scale.transpose(0, 2, 1)
        together[members] = _log_bayes_factors_of_grams(grams, along[at] * scale, total, problem.law.n_kept)[:, 0]
    apart = np.array([singles[a][i] + singles[b][j] for (a, i), (b, j) in asked])
    starts = np.concatenate([[0], np.cumsum([len(best[a]) * len(best[b]) for a, b in pairs])[:-1]])
    gained = np.logaddexp.reduceat(together, starts) - np.logaddexp.reduceat(apart, starts)
    alone = {name: log_mean_exp(scores) for name, scores in singles.items()}
    return {(a, b): alone[a] + alone[b] + float(more) for (a, b), more in zip(pairs, gained, strict=True)}
