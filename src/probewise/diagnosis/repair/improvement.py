"""The gain of a repaired model over the null: in evidence, on held-out readings, in residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probewise.diagnosis.evidence.held_out import held_out_gain
from probewise.diagnosis.evidence.laplace import Linearised
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.judgement.global_test import GlobalTest
from probewise.diagnosis.names import Names
from probewise.diagnosis.repair.under_noise import residuals_beside_walk
from probewise.diagnosis.residuals.locate import bayes_factor_p_value
from probewise.diagnosis.search.searched import Searched
from probewise.diagnosis.search.weighed_fit import WeighedFit

N_DRAWS = 499


@dataclass(frozen=True)
class Improvement:
    """The gain of the repaired model over the null.

    `log_evidence` in nats; `heldout_log_density_per_reading` and its sd in nats per held-out reading,
    `heldout_by_scan` the mean by part; rms residuals (`Recording.rms`) in the unit of the readings, beside a random
    walk if the noise has one; `p_value_after` of the global test of the repaired model.
    """

    log_evidence: float
    heldout_log_density_per_reading: float
    heldout_sd: float
    heldout_by_scan: tuple[tuple[str, float], ...]
    rms_before: float
    rms_after: float
    p_value_after: float


def improvement_of(
    searched: Searched,
    test: GlobalTest,
    best: WeighedFit,
    noise: Names,
    after: Linearised,
    *,
    shown: tuple[Fit, Fit],
    rng: np.random.Generator,
) -> Improvement:
    """Measure the gain of the best fit over the null: in evidence and, under the same noise, on held-out parts, in rms.

    Parameters
    ----------
    searched, test
        Result of the search; global test of the null.
    best, noise, after
        The best fit, its noise model, and its linearisation.
    shown
        The null and the best fit under that noise.
    rng
        Random generator, for the null distribution of the test of the repaired model.
    """
    null = test.null
    law = best.evidence[noise].likeliest_law
    rms = [searched.prepared.recording.rms(residuals_beside_walk(found.residuals, law)) for found in shown]
    log_evidence = best.evidence[noise].log_z - null.evidence[searched.certain].log_z
    if best is null:
        return Improvement(log_evidence, 0.0, 0.0, (), rms[0], rms[1], p_value_after=test.p_value)
    prepared = searched.prepared
    parts = prepared.apparatus.held_out_parts(prepared.recording)
    # What the mean leaves out looks like memory of the noise: each model has as much as is likeliest about it.
    own = null.evidence[null.possible_noise(noise)].likeliest_law
    own = own if law.has_memory and np.array_equal(own.lost, law.lost) else law
    held = held_out_gain(*shown, prepared.recording, law, parts, law_of_null=own)
    p_after = bayes_factor_p_value(
        after, searched.template_banks_for_global_test(best.found), after.draw_null_residuals(N_DRAWS, rng=rng)
    )
    return Improvement(log_evidence, held.per_reading, held.sd, held.by_scan, rms[0], rms[1], p_value_after=p_after)
