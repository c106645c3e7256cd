"""Notes on priors and declared noise sds that the readings contradict."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import ndtr

from probewise._arrays import FloatArray
from probewise.diagnosis.fitting.fit import Fit
from probewise.diagnosis.noise.law import NoiseLaw
from probewise.priors import LogUniform, Normal, Uniform
from probewise.systems import Simulator, System

_FAR = 4.0  # sds; if the truth is at the end of its prior, one recording in 30,000 is this far beyond it
_MUCH = 1.1  # factor by which the noise differs from what was declared


def notes_on_prior_conflict(system: System, found: Fit, law: NoiseLaw) -> Iterator[str]:
    """Yield a note on each parameter of a fitted system, without effects, whose prior the readings contradict.

    With the prior of one parameter removed, the readings alone move its standard-normal coordinate z by a step, known
    to within an sd; both are linear approximations. A bounded prior is uniform in the probability Phi(z), so its end is
    Phi(-|z|) / phi(z) away, measured in z.
    """
    slopes = law(found.slopes[:, : system.n_params]) / found.sd
    z, curvature = found.z[: system.n_params], slopes.T @ slopes + np.eye(system.n_params)
    downhill = slopes.T @ law(found.residuals[:, None])[:, 0] / found.sd - z
    covariance = np.linalg.inv(curvature)
    variance = np.diag(covariance)
    with np.errstate(all="ignore"):  # of what the readings do not tell: no number, and no note
        # Row k of the inverse without the prior of parameter k is that with it over 1 - variance (Sherman-Morrison).
        steps = (covariance @ downhill + z * variance) / (1 - variance)
        sds = np.sqrt(variance / (1 - variance))
    for k, (name, prior) in enumerate(system.marginals.items()):
        step, sd = float(steps[k]), float(sds[k])
        if isinstance(prior, Uniform | LogUniform):
            end = float(ndtr(-abs(z[k])) / (np.exp(-0.5 * z[k] ** 2) / np.sqrt(2 * np.pi)))
            if np.sign(z[k]) * step - end > _FAR * sd:
                where, more = ("upper", "larger") if z[k] > 0 else ("lower", "smaller")
                yield f"{name} is at the {where} end of its prior, {prior}, but the readings ask for a {more} value"
        elif isinstance(prior, Normal):
            away = z[k] + step
            if abs(away) > _FAR * np.hypot(1, sd):
                way = "above" if away > 0 else "below"
                yield f"the readings ask for {name} {abs(away):.1f} sds {way} the mean of its prior, {prior}"


def notes_on_declared_noise(simulator: Simulator, noise_sd: FloatArray) -> Iterator[str]:
    """Yield a note if samples of the noise sd, (n_samples,), contradict the number that was declared."""
    declared = simulator.noise.sd
    if declared is None or isinstance(declared, str):
        return
    mean, sd = float(np.mean(noise_sd)), float(np.std(noise_sd))
    if abs(mean - declared) > max(_FAR * sd, (_MUCH - 1) * declared):
        unit = f" {simulator.unit}" if simulator.unit else ""
        yield f"the noise sd of a reading is {mean:.3g} ± {sd:.1g}{unit}, though {declared:g} was declared"
