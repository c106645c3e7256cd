"""Refit of the null model (a sensor without effects) to noise-free readings, and cosines after it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.diagnosis.evidence import Linearised, OrthonormalBlocks, laplace_evidence
from probewise.diagnosis.fit import Fit, Model, fit
from probewise.diagnosis.noise_law import white_noise
from probewise.diagnosis.noise_models import NoiseModel
from probewise.diagnosis.sensors import default_sensor, starts_of_one_gaussian, starts_with_more_gaussians
from probewise.diagnosis.templates import EffectTemplates, templates_of_effect
from probewise.effects import VOCABULARY, EffectKind, Extent, NamedEffect
from probewise.recordings.plan import Recording
from probewise.sensor import Stage

_NOISE_SD = 0.6  # the middle noise level of a challenge; weights the readings against the priors
_MOST_GAUSSIANS = 4
_BEHIND = 3.0  # nats: once an SSF order is this far behind the best, higher orders are not tried


class NullRefit:
    """The null model, fitted to clean readings once and refitted to readings with effects.

    The number of Gaussians in the SSF has the largest evidence on the clean readings, as in a diagnosis. The residuals
    of that fit (the true SSF may be no mixture of Gaussians) are subtracted before a refit.
    """

    def __init__(self) -> None:
        self._clean: Recording | None = None

    def __call__(self, clean: Recording, changed: Recording) -> float:
        """Return the norm of an effect's residuals after a full refit of the null, in reading units."""
        return float(np.linalg.norm(self.refit(clean, changed).residuals))

    def refit(self, clean: Recording, changed: Recording) -> Fit:
        """Return the null model's fit to `changed`, as if the model fitted `clean` exactly."""
        null = self.null_fit(clean)
        return _white_noise_fit(null.model, self.without_null_residuals(clean, changed), null.z)

    def with_one_more_gaussian(self, found: Fit, clean: Recording, changed: Recording) -> Fit:
        """Return as `refit`, but with one Gaussian more in the SSF than `found`, the result of `refit`."""
        fits = _fits_with_one_more_gaussian(found, self.without_null_residuals(clean, changed), Extent.of(clean))
        return min(fits, key=lambda f: float(np.linalg.norm(f.residuals)))

    def without_null_residuals(self, clean: Recording, changed: Recording) -> Recording:
        """Return `changed` minus the null model's residuals on `clean`."""
        readings = changed.readings.copy()
        readings[clean.usable] -= self.null_fit(clean).residuals
        return Recording(changed.plan, readings)

    def null_fit(self, clean: Recording) -> Fit:
        """Return the null model's fit to the clean readings, cached for the last recording."""
        if self._clean is not clean:
            self._clean, self._null = clean, _fit_of_best_order(clean)
        return self._null


def _fit_of_best_order(clean: Recording) -> Fit:
    extent, noise = Extent.of(clean), NoiseModel((), clean, least_sd=_NOISE_SD)
    sensor = default_sensor(extent, 1)
    found = min(
        (_white_noise_fit(Model(sensor, (), clean.plan), clean, z) for z in starts_of_one_gaussian(sensor)),
        key=lambda f: f.objective,
    )
    best, best_log_z = found, laplace_evidence(found, noise).log_z
    for _ in range(_MOST_GAUSSIANS - 1):
        found = min(_fits_with_one_more_gaussian(found, clean, extent), key=lambda f: f.objective)
        log_z = laplace_evidence(found, noise).log_z
        if log_z > best_log_z:
            best, best_log_z = found, log_z
        elif log_z < best_log_z - _BEHIND:
            break
    return best


def _fits_with_one_more_gaussian(found: Fit, recording: Recording, extent: Extent) -> Iterator[Fit]:
    """Yield fits with one more Gaussian than `found`, one from each way to split the heaviest."""
    wanted = default_sensor(extent, found.model.sensor.n_gaussians + 1)
    for z in starts_with_more_gaussians(found.model.sensor, found.z, wanted):
        yield _white_noise_fit(Model(wanted, (), recording.plan), recording, z)


def _white_noise_fit(model: Model, recording: Recording, start: FloatArray) -> Fit:
    whitener = white_noise(int(recording.usable.sum()), least=_NOISE_SD)
    return fit(model, recording, start, whitener, tolerance=0.02)


_WORTH_A_REFIT = 0.8
_STARTS = 3  # variants of an effect of a pair that are refitted
_LIKE_AN_SSF = ("halo", "edge_blur")  # aliases of these may be an SSF with one more Gaussian


def cosines_with_vocabulary(
    refit: NullRefit,
    clean: Recording,
    changed: Recording,
    *,
    vocabulary: Mapping[str, EffectKind] = VOCABULARY,
) -> dict[str, float]:
    """Return the cosine of an effect's residuals, after a refit of the null model, with every named effect on the mean.

    `refit`: the null model's refit; `clean`, `changed`: noise-free readings without and with the effect; `vocabulary`:
    the effects to compare with, by name; those that cannot act in this plan or act on the noise are left out. Returns
    cosine rho by name: the square root of the share of the residual sum of squares that the named effect, at its best
    fit and together with the null model, explains: from a full refit if the linearised rho is above 0.8. If "halo" or
    "edge_blur" is above 0.8, also of "ssf_order": one more Gaussian in the SSF, which is no missing physics.
    """
    found = refit.refit(clean, changed)
    usable = np.flatnonzero(clean.usable)
    problem = Linearised.of(found, white_noise(len(usable)))
    extent = Extent.of(clean)
    out: dict[str, float] = {}
    for name, kind in vocabulary.items():
        effect = kind.for_extent(extent)
        if effect is None or effect.stage is Stage.NOISE:
            continue
        templates, explained = _templates_and_explained_squares(problem, found, effect, usable)
        best = int(np.argmax(explained))
        rho = float(np.sqrt(min(explained[best] / float(problem.residual @ problem.residual), 1.0)))
        if rho > _WORTH_A_REFIT:
            adjusted = refit.without_null_residuals(clean, changed)
            rho = _cosine_of_fits(found, _refit_with_effect(problem, found, effect, templates, best, adjusted))
        out[name] = rho
    if max(out.get(name, 0.0) for name in _LIKE_AN_SSF) > _WORTH_A_REFIT:
        out["ssf_order"] = _cosine_of_fits(found, refit.with_one_more_gaussian(found, clean, changed))
    return out


def residual_norms_with_one_named(
    refit: NullRefit, clean: Recording, both: Recording, names: Iterable[str]
) -> dict[str, float]:
    """Return the norm of two effects' residuals after a fit of the null model and one of them, in reading units.

    `refit`: the null model's refit; `clean`, `both`: noise-free readings without any effect and with both; `names`:
    effects fitted together with the null model, one at a time. Returns norm of the residuals by name of the fitted
    effect; divided by the noise sd, it is the size of the other effect given this one. It may be much smaller than the
    other's size alone: a saturation can hide a stain.
    """
    found, adjusted = refit.refit(clean, both), refit.without_null_residuals(clean, both)
    usable = np.flatnonzero(clean.usable)
    problem = Linearised.of(found, white_noise(len(usable)))
    out = {}
    for name in names:
        effect = VOCABULARY[name].for_extent(Extent.of(clean))
        fits = [found]
        if effect is not None:
            templates, explained = _templates_and_explained_squares(problem, found, effect, usable)
            best = {
                int(templates.choice[k]): int(k) for k in np.argsort(explained)
            }  # fits of each variant, the best last
            starts = [*best.values()][-_STARTS:]
            fits += [_refit_with_effect(problem, found, effect, templates, at, adjusted) for at in starts]
        out[name] = min(float(np.linalg.norm(by.residuals)) for by in fits)
    return out


def _templates_and_explained_squares(
    problem: Linearised, found: Fit, effect: NamedEffect[Any], usable: IntArray
) -> tuple[EffectTemplates, FloatArray]:
    """Return an effect's template bank, and the sum of squares that each entry explains, (n_entries,)."""
    templates = templates_of_effect(found, effect, usable)
    blocks = OrthonormalBlocks.of(problem, templates.columns)
    return templates, np.add.reduceat((blocks.u.T @ problem.residual) ** 2, blocks.starts)


def _refit_with_effect(
    problem: Linearised, found: Fit, effect: NamedEffect[Any], templates: EffectTemplates, at: int, adjusted: Recording
) -> Fit:
    """Refit the null model with an effect to `adjusted`, from entry `at` of its template bank; return the fit."""
    columns, setting = templates.columns[at], templates.settings[at]
    amount = np.linalg.lstsq(problem.project(columns), problem.residual)[0]
    start = effect.start(setting, np.asarray(amount, dtype=np.float64))
    z = found.z + problem.absorbing_shift(found, columns @ amount)
    model = found.model.with_effect(templates.variant_of_entry(at))
    start_z = np.concatenate([z, model.z_of_last_effect(start[None, :])[0]])
    rss = float(found.residuals @ found.residuals)
    # The floor of the sd is a tenth of the residual: small enough for accuracy, large enough not to force an exact fit.
    floor = 0.1 * np.sqrt(rss / len(found.residuals))
    return fit(model, adjusted, start_z, white_noise(len(found.residuals), least=floor), tolerance=0.02)


def _cosine_of_fits(found: Fit, by: Fit) -> float:
    """Return the square root of the share of `found`'s residual sum of squares by which `by`'s is smaller."""
    left = float(by.residuals @ by.residuals) / float(found.residuals @ found.residuals)
    return float(np.sqrt(np.clip(1 - left, 0.0, 1.0)))
