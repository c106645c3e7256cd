"""The refitted hypothesis that repairs the model, and its gain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.judgement.global_test import GlobalTest
from probewise.diagnosis.judgement.judged import Judged
from probewise.diagnosis.names import Names
from probewise.diagnosis.repair.improvement import Improvement, improvement_of
from probewise.diagnosis.repair.under_noise import fit_under_noise
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import WeighedFit

_RUIN = -1.0  # nats per held-out reading below which named effects are withdrawn


@dataclass(frozen=True, eq=False)
class BestRepair:
    """The fit that repairs the model, or the null's, with its noise effects, linearisation and gain over the null.

    `calibrated` and `repaired`: the null and that fit as they are under the noise found, which figures show.
    `out_of_vocabulary`: if the verdict is `unknown`, its effects with a formula but no name in the vocabulary.
    """

    fit: WeighedFit
    noise: Names
    problem: Linearised
    improvement: Improvement
    calibrated: Fit
    repaired: Fit
    out_of_vocabulary: Names = ()

    @classmethod
    def of(
        cls,
        searched: Searched,
        test: GlobalTest,
        fit: WeighedFit,
        noise: Names,
        *,
        out_of_vocabulary: Names = (),
        rng: np.random.Generator,
    ) -> BestRepair:
        """Build from a fit and its noise effects, and measure the fit's gain over the null."""
        noise = fit.possible_noise(noise)
        law, recording = fit.evidence[noise].likeliest_law, searched.prepared.recording
        repaired = fit_under_noise(fit, law, recording)
        calibrated = repaired if fit is test.null else fit_under_noise(test.null, law, recording)
        after = Linearised.of(repaired, law)
        gain = improvement_of(searched, test, fit, noise, after, shown=(calibrated, repaired), rng=rng)
        return cls(fit, noise, after, gain, calibrated, repaired, out_of_vocabulary)


def predicts_far_worse(gain: Improvement) -> bool:
    """Return whether a repair predicts held-out readings worse than the null by over one nat per reading."""
    return gain.heldout_log_density_per_reading < _RUIN


def judged_and_best_repair(
    searched: Searched, test: GlobalTest, judged: Judged, *, rng: np.random.Generator
) -> tuple[Judged, BestRepair]:
    """Choose the fit that belongs to a verdict; the null if nothing was found.

    Returns
    -------
    The verdict, withdrawn if the named effects predict held-out readings far worse; and the fit.
    """
    null, noise = test.null, test.noise
    if judged.verdict == "unknown":
        leading = searched.leading_combination_out_of_vocabulary()
        fit = (
            searched.best_refit_of(leading, noise) if leading else searched.likeliest_fit_beside_unknown(noise)
        ) or null
        return judged, BestRepair.of(searched, test, fit, noise, out_of_vocabulary=leading, rng=rng)
    on_noise = searched.prepared.noise_effect_names
    if judged.verdict in ("named", "noise", "clean"):
        stated = tuple(name for name in judged.repaired_by if name in on_noise)
        noise = searched.posterior.likeliest_noise(stated)
    on_mean = tuple(name for name in judged.repaired_by if name not in on_noise)
    best = BestRepair.of(searched, test, searched.best_refit_of(on_mean, noise) or null, noise, rng=rng)
    if judged.verdict == "named" and predicts_far_worse(
        best.improvement
    ):  # a fit that fails on held-out readings is no repair
        return judged.with_verdict_withdrawn(), BestRepair.of(searched, test, null, noise, rng=rng)
    return judged, best
