"""Aliased effects, the readings that would separate them, and the next readings.

The next are chosen by their mutual information with the index of the true hypothesis. Between hypotheses whose
predictions are normal it has a lower bound in closed form, from the Bhattacharyya distance of each two (Kolchinsky &
Tracey 2017, "Estimating mixture entropy with pairwise distances", Entropy 19, 361: Chernoff's divergence, alpha = 1/2).
Scans are added greedily by information per minute, as long as there is information to gain.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.special import logsumexp

from probewise._arrays import LAST_DIGITS, TINY, FloatArray, IntArray
from probewise.diagnosis.apparatus import (
    ENOUGH_NATS,
    MOST_ADVISED_READINGS,
    NOTHING_NATS,
    SETTLED,
    Apparatus,
    rows_by_candidate,
)
from probewise.diagnosis.evidence import Linearised, OrthonormalBlocks, covariance_root
from probewise.diagnosis.fit import Fit, Model, residual_degrees_of_freedom
from probewise.diagnosis.locate import Place
from probewise.diagnosis.search.hypotheses import Searched, WeighedFit, effects_out_of_vocabulary
from probewise.diagnosis.words import UNKNOWN, Names, hypothesis_in_words
from probewise.effects import Effect, name_of_first_copy
from probewise.recordings.plan import Plan, Recording

COUNTS = np.array([0, 1, 2, 3, 4, 6, 8, 12, 18, 26, 36, 51, 72, MOST_ADVISED_READINGS])
"""Numbers of further readings that are tried."""

_NEARLY_FLAT = 1e-6  # prior precision of a rival's amplitudes, in changes of one noise sd: the fit decides


EffectEntry: TypeAlias = tuple[Effect, FloatArray]
"""An effect, and settings of its parameters, (n_columns, n_effect_params), that make one template."""


class _Change(NamedTuple):
    """A change by an effect in noise sds: its columns in `old` readings and `further` ones, (n_points, n_columns) each.

    `of_run`: whether each column is the value of one run; then `further` are the columns of the mean of all runs'
    values. `values`: how much of each column, (n_columns,).
    """

    old: FloatArray
    further: FloatArray
    of_run: bool
    values: FloatArray


def nats_against(
    slopes: tuple[FloatArray, FloatArray], truth: _Change, rival: _Change
) -> Callable[[IntArray, IntArray], FloatArray]:
    """Return the expected log Bayes factor of an effect that acts over another, which is refitted, as a function.

    It takes the rows of one further run, and how many of them are read, evenly spread, (n_counts,); it returns nats,
    (n_counts,), NaN if an effect has no finite change. A rival with a value per run has one more there, known as far as
    its values scatter.

    `slopes`: of the old readings, and of further ones, by coordinates with a standard normal prior.
    """
    p, k = slopes[0].shape[1], rival.old.shape[1]
    own = rival.further[:, : int(rival.of_run)] * (k * rival.values.std())
    absent = np.zeros((len(slopes[0]), own.shape[1]))
    before = np.concatenate([slopes[0], rival.old, absent, truth.old @ truth.values[:, None]], axis=1)
    further = np.concatenate([slopes[1], rival.further, own, truth.further @ truth.values[:, None]], axis=1)
    known = before.T @ before
    precision = np.diag(np.concatenate([np.ones(p), np.full(k, _NEARLY_FLAT), np.ones(own.shape[1])]))

    def nats(rows: IntArray, counts: IntArray) -> FloatArray:
        after = further[rows]
        products = known + counts[:, None, None] * (after.T @ after / len(after))
        if not np.isfinite(products).all():
            return np.full(len(counts), np.nan)
        fitted, along = products[:, :-1, :-1] + precision, products[:, :-1, -1:]
        scale = np.sqrt(np.einsum("mii->mi", fitted))[:, :, None]  # against rounding
        among, along = fitted / (scale * scale.transpose(0, 2, 1)), along / scale
        absorbed = along.transpose(0, 2, 1) @ np.linalg.solve(among, along)
        return np.asarray(0.5 * (products[:, -1, -1] - absorbed[:, 0, 0]))

    return nats


LAMBDA = 8.0  # size of an effect at which it is detected for certain, and at which a plan is judged

LEAST_SHARE = 0.05
"""Least share that counts: of an effect's change of the readings as its own, of the entropy, of the rivals' weight."""


@dataclass(frozen=True)
class Alias:
    """Two effects that a recording hardly tells apart, and the measurement that would.

    `cosine`: largest principal cosine of their templates, with the null's parameters projected out; `settle_by`: the
    separating scan in words, or that there is none; `readings`: how many of its readings are needed, or 0.
    """

    effects: tuple[str, str]
    cosine: float
    settle_by: str
    readings: int


def _projected_basis(problem: Linearised, whitened: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormalise a whitened template, (n_points, k), with a fit projected out; nothing is left if it is absorbed.

    Returns the directions, (n_rows, n_directions), and the amounts of the columns that make each, (k, n_directions).
    """
    projected = problem.project_whitened(whitened)
    # Columns that the fit absorbs to within a thousandth are ignored.
    if not np.linalg.norm(projected) > 1e-3 * np.linalg.norm(whitened):
        return projected[:, :0], np.zeros((projected.shape[1], 0))
    u, lengths, axes = np.linalg.svd(projected, full_matrices=False)
    kept = lengths > 1e-3 * lengths[0]
    return u[:, kept], axes[kept].T / lengths[kept]


def aliases_with_separating_plans(searched: Searched, problem: Linearised, found: Fit) -> list[Alias]:
    """List the aliased pairs of effects of the vocabulary on the mean, each with the scan that separates it best.

    The most collinear come first: their projected templates have a cosine of 0.9 or more. A template is the best
    entry of an effect's bank (its changes of readings, at a grid of its parameters).
    """
    prepared, about, cache = searched.prepared, searched.misfit_templates.about, searched.refits.templates
    chosen, bases, pairs = dict[str, EffectEntry](), dict[str, FloatArray](), list[Alias]()
    for name, effect in sorted(prepared.effects.items()):
        is_copy = name_of_first_copy(name) is not None
        if name in prepared.noise_effect_names or effects_out_of_vocabulary((name,)) or is_copy:
            continue
        templates = cache.templates_of(about, effect.with_fewer_variants())
        blocks = OrthonormalBlocks.of(problem, templates.columns)
        scores = np.add.reduceat((blocks.u.T @ problem.residual) ** 2, blocks.starts)
        best = int(np.argmax(scores))
        chosen[name] = templates.variant_of_entry(best), templates.settings[best]
        bases[name] = _projected_basis(problem, problem.whiten(templates.columns[best]))[0]
    for pair in itertools.combinations((name for name, basis in bases.items() if basis.size), 2):
        cosines = np.linalg.svd(bases[pair[0]].T @ bases[pair[1]], compute_uv=False)
        if cosines[0] >= 0.9:  # from there on they count as aliases
            pairs.append(Alias(pair, float(min(cosines[0], 1.0)), prepared.apparatus.words.settles_nothing, 0))
    pairs.sort(key=lambda alias: -alias.cosine)
    return pairs_with_separating_scans(pairs, problem, found, chosen, prepared.usable_rows, prepared.apparatus)


def pairs_with_separating_scans(
    pairs: Sequence[Alias],
    problem: Linearised,
    found: Fit,
    entries: Mapping[str, EffectEntry],
    usable: IntArray,
    apparatus: Apparatus,
) -> list[Alias]:
    """Return the pairs with `settle_by` and `readings` of the best scan that the apparatus could take.

    That is the scan that adds three nats between the two in the fewest readings, at most 102, or else the one that adds
    most, if more than half a nat. All parameters are refitted to old and new readings, and the other effect with them;
    of the two cases, that the one acts or the other, the harder one counts. The effect that acts has lambda 8 in the
    old readings. A pair that no scan separates is unchanged. `entries` has the one of each effect's bank that stands
    for it, by name.
    """
    plan = found.model.plan
    scans = apparatus.candidate_measurements(plan, level=found.model.predict(found.z[None, :])[0])
    if not (pairs and scans):
        return list(pairs)
    everywhere = apparatus.plan_of_alternatives(scans, plan)
    expected, by_z = replace(found.model, plan=everywhere).predict_and_differentiate(found.z)
    of_run = apparatus.coordinates_of_new_run(found.model)  # a further run has values of its own of these
    shared, own = by_z / problem.sd, by_z[:, of_run] / problem.sd
    shared[:, of_run] = 0.0
    further, known = np.concatenate([shared, own], axis=1), problem.whiten(found.slopes)
    before = np.concatenate([known, np.zeros((len(known), len(of_run)))], axis=1)

    def change_by(effect: Effect, settings: FloatArray) -> _Change:
        with_effect = found.model.with_effect(effect)
        values = with_effect.z_of_last_effect(settings)
        points = np.concatenate([np.repeat(found.z[None, :], len(values), axis=0), values], axis=1)
        without = found.model.predict(found.z[None, :])[0]  # just before: a law is solved from what was solved last
        with np.errstate(all="ignore"):  # not finite where the model diverges
            old = problem.whiten((with_effect.predict(points) - without).T[usable])
            new = (replace(with_effect, plan=everywhere).predict(points) - expected).T / problem.sd
        length = max(float(np.linalg.norm(old)), TINY)
        is_of_run = len(apparatus.coordinates_of_new_run(with_effect)) > len(of_run)
        if is_of_run:  # the new run's value is about the mean of the others
            new = np.repeat(new.mean(axis=1, keepdims=True), new.shape[1], axis=1)
        return _Change(old / length, new / length, is_of_run, np.zeros(len(values)))

    changes = {name: change_by(*entries[name]) for name in sorted({name for p in pairs for name in p.effects})}
    each_scan, out = list(zip(scans, rows_by_candidate(scans), strict=True)), list[Alias]()
    for pair in pairs:
        one, other = _collinear(problem, *(changes[name] for name in pair.effects))
        contests = [nats_against((before, further), *acting) for acting in ((one, other), (other, one))]
        best, advised = (MOST_ADVISED_READINGS + 1, -NOTHING_NATS), pair  # the least is best
        for scan, rows in each_scan:
            # Few scans gain anything: the numbers of readings in between wait for those that do.
            if not np.min([np.diff(nats(rows, COUNTS[[0, -1]])) for nats in contests]) > NOTHING_NATS:
                continue
            every = [nats(rows, COUNTS) for nats in contests]
            gained = np.min([nats - nats[0] for nats in every], axis=0)
            enough = np.flatnonzero(gained >= ENOUGH_NATS)
            needed = int(COUNTS[enough[0]]) if enough.size else MOST_ADVISED_READINGS + 1
            result = needed, -float(gained[enough[0] if enough.size else -1])
            if result < best:
                readings = min(needed, MOST_ADVISED_READINGS)
                best, advised = result, replace(pair, settle_by=scan.description, readings=readings)
        out.append(advised)
    return out


def _collinear(problem: Linearised, *changes: _Change) -> list[_Change]:
    """Return the most collinear changes by two effects, each of lambda 8; nothing of both if the fit absorbs one."""
    (first, of_first), (second, of_second) = (_projected_basis(problem, change.old) for change in changes)
    if not (first.size and second.size):
        return list(changes)
    left, _, right = np.linalg.svd(first.T @ second)
    out = []
    for change, values in zip(changes, (of_first @ left[:, 0], of_second @ right[0]), strict=True):
        seen = max(1.0, LEAST_SHARE * float(np.linalg.norm(change.old @ values)))
        out.append(change._replace(values=values * (LAMBDA / seen)))
    return out


_STRIDES = (2, 4)
_WORTHWHILE = 0.03  # least share of the entropy that a further scan must remove
_NEAR = 0.05  # of a setting's range: how near a planned reading is to a recorded one that it repeats


@dataclass(frozen=True, eq=False)
class NextMeasurement:
    """Scans to take next, as one plan, with the information that they are expected to give.

    `expected_log_bayes_factor`: of the true hypothesis over its closest rival, in nats, averaged over which one is
    true; rivals that the readings cannot tell apart count as one. `between`: each of the hypotheses, in words;
    `effects`: the effects of each; `nats` (n_rivals, n_rivals): expected log Bayes factor of each, if true, over each
    other. `minutes`: duration with breaks; of a table without a time in a known unit, a guess of one second per row.
    """

    plan: Plan
    description: str
    minutes: float
    expected_log_bayes_factor: float
    between: tuple[str, ...]
    effects: tuple[Names, ...]
    nats: FloatArray

    def classes_among(self, hypotheses: Collection[Names]) -> list[list[int]]:
        """Return the classes into which the readings separate some of the hypotheses, by their indices in `effects`.

        Two hypotheses share a class if the expected log Bayes factor of one over the other is below `NOTHING_NATS`,
        directly or through a chain of others. Hypotheses that were not compared are in no class.
        """
        return _classes_told_apart(self.nats, [k for k, names in enumerate(self.effects) if names in hypotheses])


@dataclass(frozen=True, eq=False)
class Rival:
    """A hypothesis about the mean readings (not their noise)."""

    label: str  # its name in words
    model: Model
    z: FloatArray  # its best point, (n_params,)
    root: FloatArray  # a square root of the covariance of z, (n_params, n_params): root root^T
    probability: float
    of_run: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # coordinates with a value per run

    def predict(self, plan: Plan, sd: float) -> PredictiveNormal:
        """Return the predictive distribution of a plan's readings, in noise sds; `sd` is the noise sd of a reading."""
        mean, slopes = replace(self.model, plan=plan).predict_and_differentiate(self.z)
        shared, own = slopes.copy(), np.zeros((len(slopes), 0))
        shared[:, self.of_run] = 0.0
        if self.of_run.size:  # a planned run is predicted at a recorded one's values, but each has values of its own
            inside = plan.scan[:, None] == np.arange(len(plan.scan_names))  # (n_points, n_runs)
            own = (inside[:, :, None] * slopes[:, None, self.of_run]).reshape(len(slopes), -1)
            own = own[:, np.any(own != 0, axis=0)]
        return PredictiveNormal(mean / sd, np.concatenate([shared @ self.root, own], axis=1) / sd)


class PredictiveNormal(NamedTuple):
    """Normal predictive distribution in noise sds: mean (n_points,), covariance of the readings I + factor factor^T."""

    mean: FloatArray
    factor: FloatArray

    def covariance_and_log_det(self) -> tuple[FloatArray, float]:
        """Return the covariance of the readings, (n_points, n_points), and the log of its determinant.

        The noise counts as at least 1e-6 of the largest sd: that of readings that are exact is lost to rounding.
        """
        of_factor = self.factor @ self.factor.T
        noise_2 = max(1.0, LAST_DIGITS * float(of_factor.diagonal().max(initial=0.0)))
        covariance = noise_2 * np.eye(len(self.mean)) + of_factor
        return covariance, float(np.linalg.slogdet(covariance)[1])


@np.errstate(all="ignore")  # of predictions that ran away
def measurement_separating_rivals(
    rivals: Sequence[Rival], sd: float, plan: Plan, apparatus: Apparatus
) -> NextMeasurement | None:
    """Choose scans, of at most 102 readings in all, that separate the rivals; None if none is possible or informative.

    `sd`: noise sd of a reading, in the unit of the readings.
    """
    leader = max(rivals, key=lambda rival: rival.probability)
    level = leader.model.predict(leader.z[None, :])[0]
    offered = apparatus.candidate_measurements(plan, strides=_STRIDES, level=level)
    weights = np.maximum([rival.probability for rival in rivals], LEAST_SHARE)  # since a probability may be wrong
    weights /= weights.sum()
    if not offered:
        return None
    everywhere, rows = apparatus.plan_of_alternatives(offered, plan), rows_by_candidate(offered)
    predictives = [rival.predict(everywhere, sd) for rival in rivals]

    def of_readings(taken: IntArray) -> list[PredictiveNormal]:
        return [PredictiveNormal(mean[taken], factor[taken]) for mean, factor in predictives]

    chosen: list[int] = []
    taken: IntArray = np.zeros(0, dtype=np.int64)
    told, uncertain = 0.0, float(-np.sum(weights * np.log(weights)))
    while uncertain - told > LEAST_SHARE * uncertain:
        gains = np.zeros(len(offered))
        for k in range(len(offered)):
            together = np.concatenate([taken, rows[k]])
            if k not in chosen and len(together) <= MOST_ADVISED_READINGS:
                gains[k] = mutual_information_lower_bound(of_readings(together), weights) - told
        # For the first scan anything is worth while; not finite is the gain of a model that fails there.
        gains[~(gains >= (_WORTHWHILE if chosen else 1e-6) * uncertain)] = 0.0
        best = int(np.argmax(gains / [option.minutes for option in offered]))
        if gains[best] == 0.0:
            break
        chosen.append(best)
        taken, told = np.concatenate([taken, rows[best]]), told + gains[best]
        if apparatus.takes_one_measurement_at_a_time:
            break
    if not chosen:
        return None
    scans = [offered[k] for k in chosen]
    nats = _expected_log_bayes_factors(of_readings(taken))
    return NextMeasurement(
        apparatus.plan_of_sequence(scans, plan),
        "; then ".join(scan.description for scan in scans),
        sum(scan.minutes for scan in scans),
        _mean_over_closest(nats, weights),
        tuple(rival.label for rival in rivals),
        tuple(tuple(sorted(rival.model.names)) for rival in rivals),
        nats,
    )


def measurement_at_place(
    place: Place, null: Fit, everything: Recording, sd: float, plan: Plan, apparatus: Apparatus
) -> NextMeasurement | None:
    """Choose the readings that would show an unknown effect again, if it stays where its residuals lie.

    A planned reading repeats the recorded one with the nearest settings, and its mean residual, if that is in the
    place. The readings with most nats per minute are chosen, of those with three nats over no effect; None if none has.

    `place`: a place in all readings of `everything`, with its curve of mean residuals.
    """
    from scipy.spatial import KDTree  # a tenth of a second, which few diagnoses need

    candidates = apparatus.candidate_measurements(plan, strides=_STRIDES, level=null.model.predict(null.z[None, :])[0])
    if not candidates or place.values is None:
        return None
    usable = np.flatnonzero(everything.usable)
    inside = place.rows_among(everything.plan, usable)
    shown = np.where(inside, np.interp(place.values, place.curve_at, place.curve_mean) / sd, 0.0)
    known = apparatus.settings_of(everything.plan.take(usable))
    scale = np.ptp(known, axis=0)
    varies = scale > 0
    planned = apparatus.settings_of(apparatus.plan_of_alternatives(candidates, plan))[:, varies] / scale[varies]
    apart, nearest = KDTree(known[:, varies] / scale[varies]).query(planned, p=np.inf)
    squares = np.where(apart <= _NEAR, shown[nearest], 0.0) ** 2
    nats = np.array([0.5 * float(squares[rows].sum()) for rows in rows_by_candidate(candidates)])
    per_minute = np.where(nats >= ENOUGH_NATS, nats, 0.0) / [candidate.minutes for candidate in candidates]
    best = int(np.argmax(per_minute))
    if per_minute[best] == 0.0:
        return None
    return NextMeasurement(
        apparatus.plan_of_sequence([candidates[best]], plan),
        candidates[best].description,
        candidates[best].minutes,
        float(nats[best]),
        (_null_in_words(apparatus), "what has no name"),
        ((), UNKNOWN),
        nats[best] * (1 - np.eye(2)),
    )


@np.errstate(all="ignore")  # of predictions that ran away
def mutual_information_lower_bound(predictives: Sequence[PredictiveNormal], weights: FloatArray) -> float:
    """Return a lower bound on the mutual information of hypothesis and readings, in nats.

    NaN where predictions ran away: if one is not finite, or so uncertain that rounding swallows the noise.

    `weights`: probabilities (n_hypotheses,), which sum to one.
    """
    covariances, log_dets = zip(*(each.covariance_and_log_det() for each in predictives), strict=True)
    distances = np.zeros((len(predictives), len(predictives)))
    for a, b in itertools.combinations(range(len(predictives)), 2):
        middle, apart = (covariances[a] + covariances[b]) / 2, predictives[a].mean - predictives[b].mean
        log_det = np.linalg.slogdet(middle)[1] - (log_dets[a] + log_dets[b]) / 2
        if not np.isfinite(log_det):
            return float("nan")
        distances[a, b] = distances[b, a] = apart @ np.linalg.solve(middle, apart) / 8 + log_det / 2
    return float(-weights @ logsumexp(-distances, b=weights, axis=1))


def _expected_log_bayes_factors(predictives: Sequence[PredictiveNormal]) -> FloatArray:
    """Return the expected log Bayes factor of each hypothesis, if true, over each other, (n, n), in nats."""
    covariances, log_dets = zip(*(each.covariance_and_log_det() for each in predictives), strict=True)
    inverse = [np.linalg.inv(covariance) for covariance in covariances]
    out = np.zeros((len(predictives), len(predictives)))
    for a, b in itertools.permutations(range(len(predictives)), 2):
        apart = predictives[a].mean - predictives[b].mean
        trace = float(np.sum(inverse[b] * covariances[a])) - len(apart)
        out[a, b] = 0.5 * (trace + log_dets[b] - log_dets[a] + apart @ inverse[b] @ apart)
    return out


def classes_of(members: Iterable[int], alike: Callable[[int, int], bool]) -> list[list[int]]:
    """Group members that are alike directly, or through others of their class; sorted."""
    classes: list[list[int]] = []
    for k in members:
        joined = [own for own in classes if any(alike(k, j) for j in own)]
        classes = [own for own in classes if own not in joined] + [sorted([k, *itertools.chain(*joined)])]
    return sorted(classes)


def _classes_told_apart(nats: FloatArray, members: Iterable[int]) -> list[list[int]]:
    return classes_of(members, lambda k, j: min(nats[k, j], nats[j, k]) < NOTHING_NATS)


def _mean_over_closest(nats: FloatArray, weights: FloatArray) -> float:
    """Return the log Bayes factor of the truth over its closest rival, averaged by weights (n,); `nats` (n, n)."""
    classes = _classes_told_apart(nats, range(len(nats)))
    others = np.where(np.eye(len(nats), dtype=np.bool_), np.inf, nats)
    for own in classes if len(classes) > 1 else []:
        others[np.ix_(own, own)] = np.inf
    return max(float(weights @ others.min(axis=1) / weights.sum()), 0.0)


_MOST_RIVALS = 5


def choose_next_measurement(
    searched: Searched, null: WeighedFit, *, unknown_shows_in: Place | None, is_unknown: bool
) -> NextMeasurement | None:
    """Choose the readings that answer what is open; None if nothing is, or if none answers it.

    What is open is which of the fewest hypotheses on the mean that hold .95 is true. So a leader with .95 needs no more
    readings, however well these would confirm it; nor do aliases that have .95 together, since a plan is taken only if
    it promises three nats between classes of hypotheses that it can tell apart. What has no name predicts nothing: if
    it is the verdict (`is_unknown`), or the only rival of the null, the readings go where its residuals are largest,
    `unknown_shows_in`, if anywhere.
    """
    prepared, by_mean = searched.prepared, searched.posterior.marginal_over_noise
    plan, apparatus, unknown = prepared.recording.plan, prepared.apparatus, by_mean.get(UNKNOWN, 0.0)
    # An unknown effect makes no prediction beyond the null.
    probabilities: dict[Names, float] = {(): by_mean.get((), 0.0) + unknown}
    probabilities |= {names: p for names, p in by_mean.items() if names and names != UNKNOWN}
    found, held = list[WeighedFit](), 0.0  # those of the fewest hypotheses that hold .95, at most five
    for names in sorted(probabilities, key=lambda names: -probabilities[names]):
        candidate = searched.best_refit_of(names, searched.certain) if names else null
        if candidate is not None:
            found.append(candidate)
        held += probabilities[names]
        if found and (held >= SETTLED or len(found) == _MOST_RIVALS):
            break
    sd = found[0].whitened_sd
    if is_unknown or (len(found) == 1 and found[0] is null and unknown > 1 - SETTLED):
        if unknown_shows_in is None:
            return None
        return measurement_at_place(unknown_shows_in, null.found, prepared.everything, sd, plan, apparatus)
    if is_settled(searched) or len(found) == 1:
        return None
    rivals = []
    for fit in found:
        label = hypothesis_in_words(fit.names, nothing=_null_in_words(apparatus))
        slopes, own_sd, model = fit.found.slopes, fit.whitened_sd, fit.found.model
        free = residual_degrees_of_freedom(slopes, own_sd, len(slopes))
        root = covariance_root(slopes, own_sd**2 * len(slopes) / free)
        of_run = apparatus.coordinates_of_new_run(model)
        rivals.append(Rival(label, model, fit.found.z, root, probabilities[fit.names], of_run))
    asked = measurement_separating_rivals(rivals, sd, plan, apparatus)
    return asked if asked is not None and asked.expected_log_bayes_factor >= ENOUGH_NATS else None


def _null_in_words(apparatus: Apparatus) -> str:
    return f"{apparatus.words.null} {apparatus.words.before_in_words}"


def is_settled(searched: Searched) -> bool:
    """Return whether one hypothesis on the mean, other than an unknown effect, has .95, whatever the noise."""
    by_mean = searched.posterior.marginal_over_noise
    return any(p >= SETTLED and names != UNKNOWN for names, p in by_mean.items())
