"""The fit of a user's simulator, without effects, to the readings of a table, and its integration step.

The step is chosen at the best fit. Where a law is stiff, as one whose time constant may be far shorter than the time
between readings, that step makes predictions run away at parameters that fit the readings as well: the posterior would
end where the integration fails. There it is the step that likely parameters need.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy.special import ndtr, ndtri

from probewise._arrays import FloatArray
from probewise.diagnosis.evidence import covariance_root
from probewise.diagnosis.fit import AT_ONCE, FARTHEST, Fit, Model, fit, fit_each_start
from probewise.diagnosis.noise import LEAST_SCALE, NoiseLaw, rough_sd, white_noise_of_recording
from probewise.errors import ParameterError
from probewise.priors import LogUniform, Uniform
from probewise.recordings.plan import Recording
from probewise.systems import RunTable, Simulator, System
from probewise.systems.forms.readings import time_since_start_of_run
from probewise.systems.forms.reference import rows_are_in_order
from probewise.systems.system import STANDS_STILL, with_converged_step
from probewise.systems.table import median_sd_of_column

_STEPS_TRIED = 8  # from each start
_BEST_STARTS = 3  # of which it goes on
_BEGINNINGS = 0.25, 0.5  # shares of the longest run that are fitted before all of it
_CLEARLY = 0.5  # nats of evidence by which another fit is better

_SCREENED, _DESCENTS = 2000, 200  # points of the prior that are predicted, and the best of them, that are followed
_STAGES = (12, 40), (18, 12), (50, 6), (120, 6)  # steps of all, and the number of the best that go on
_POLISH, _POLISH_FEW = 400, 25  # steps with central differences, where they cost little, and else
_STILL = 1e-11  # nats
_EVENLY_HIGH = 1e-5  # nats
_SAME_PLACE = 1e-4  # of a coordinate
_DIFFERENCE = 1e-6  # of a coordinate
_LONGEST = 0.3  # of a coordinate's range, of a step
_STILL_FOR = 8  # steps
_ROUNDING = 1e-15


def fit_system(system: System, recording: Recording) -> tuple[System, Fit, float]:
    """Fit a system to readings, at an integration step at which likely predictions no longer change.

    Returns the system with that step, the fit, and the sd of a reading: as declared, or else the smaller of the
    estimates from the fit and from successive readings.
    """
    table = cast(RunTable, recording.plan)
    law = white_noise_of_recording(recording)
    found = _fit_from_best_starts(system, recording, law)
    sd = _noise_sd_of(system.simulator, table, recording, found)

    def refitted(finer: System) -> tuple[System, Fit, float]:
        again = fit(Model(finer, (), recording.plan), recording, found.z, law)
        return finer, again, _noise_sd_of(finer.simulator, table, recording, again)

    for _ in range(4):
        finer = with_converged_step(system, table, system.theta(found.z[None, :]), tolerance=STANDS_STILL * sd)
        if finer is system:
            break
        system, found, sd = refitted(finer)
    finer = with_step_for_likely_parameters(system, table, found, sd)
    return (system, found, sd) if finer is system else refitted(finer)


def _fit_from_best_starts(system: System, recording: Recording, law: NoiseLaw) -> Fit:
    """Fit a few steps from every start, then to convergence from the best, `_starts_from_partial_runs` and `modes_of`.

    A mode of the density in the priors' own coordinates leads where the evidence is larger, by Laplace's method.
    """
    model = Model(system, (), recording.plan)
    tried = _best_fits(model, recording, list(system.starts), law, max_steps=_STEPS_TRIED)
    longer = _starts_from_partial_runs(model, recording)
    if longer or not all(found.settled for found in tried):
        tried = _best_fits(model, recording, [*(found.z for found in tried), *longer], law)
    best = tried[0]
    if system.first is None and _broadcasts(system):
        for found in fit_each_start(model, recording, list(modes_of(system, recording, law, best.z)[0]), law):
            if log_evidence_of(found, law) > log_evidence_of(best, law) + _CLEARLY:
                best = found
    return best


def _broadcasts(system: System) -> bool:
    return system.caller is not None and system.caller.broadcasts


def log_evidence_of(found: Fit, law: NoiseLaw) -> float:
    """Return a fit's log evidence by Laplace's method, up to a constant; minus infinity without a finite prediction."""
    if not np.isfinite(found.objective):
        return -np.inf
    with np.errstate(all="ignore"):
        root = covariance_root(law(found.slopes), max(found.sd, LEAST_SCALE) ** 2)
    return float(np.linalg.slogdet(root)[1]) - found.objective


def _starts_from_partial_runs(model: Model, recording: Recording) -> list[FloatArray]:
    """Return starts of a fit, (n_params,) each: the best three fits to the beginning of every run.

    A quarter of the longest run's duration is fitted first, then half of it. There are no starts without a time, with
    too few readings, or if predictions are costly. For an oscillating system the objective has a local minimum for
    every period by which a run can be wrong; over the first quarter of a run there are few.
    """
    system, table = cast(System, model.sensor), cast(RunTable, recording.plan)
    if not (system.predicts_in_bulk and table.has_varying_time):
        return []
    since = time_since_start_of_run(table)
    starts = list(system.starts)
    for share in _BEGINNINGS:
        begun = since <= share * since.max()
        part = recording.with_readings(np.where(begun, recording.readings, np.nan))
        if (part.usable & ~part.censored).sum() < system.least_readings:
            return []
        law = white_noise_of_recording(part)
        starts = [found.z for found in _best_fits(model, part, starts, law, max_steps=_STEPS_TRIED)]
    return starts


def _best_fits(model: Model, recording: Recording, starts: list[FloatArray], law: NoiseLaw, **steps: int) -> list[Fit]:
    """Return the best few fits, the best first."""
    found = fit_each_start(model, recording, starts, law, **steps)
    return sorted(found, key=lambda each: each.objective if np.isfinite(each.objective) else np.inf)[:_BEST_STARTS]


def modes_of(system: System, recording: Recording, law: NoiseLaw, found: FloatArray) -> tuple[FloatArray, int]:
    """Return the modes of the posterior density in the priors' own coordinates, (n_modes, n_params), and how many tie.

    In its own coordinate, the value or its logarithm, a bounded prior is flat; a normal one has its own density. Of
    modes that are equally high, as of exchangeable terms, the one nearest to the middle of the prior is first; after
    these come the lower ones. They are in standard-normal coordinates. Levenberg-Marquardt descends from many points
    of the prior at once if predictions cost little, else from one fit, of coordinates `found` (n_params,). The noise sd
    is the likeliest everywhere.
    """
    descent = _Descent(system, recording, law)
    x, n_steps = descent.from_normal(found[None, :]), _POLISH_FEW
    if _broadcasts(system):
        points, n_steps = AT_ONCE // len(recording), _POLISH
        scattered = descent.from_normal(system.scattered_points(int(np.clip(16 * points, 50, _SCREENED))))
        heights = descent.heights(descent.residuals(scattered), scattered)[0]
        kept = np.argsort(heights)[: int(np.clip(points // (system.n_params + 1), 8, _DESCENTS))]
        x = np.concatenate([x, scattered[kept]])
        for n, n_kept in _STAGES:
            x, heights = descent.follow(x, n)
            x = x[np.argsort(heights)[:n_kept]]
    x, heights = descent.follow(x, n_steps, central=True)
    x, heights = x[np.isfinite(heights)], heights[np.isfinite(heights)]
    if not len(x):
        return np.clip(found, -FARTHEST, FARTHEST)[None, :], 1
    z = np.clip(np.where(descent.flat, ndtri(np.where(descent.flat, x, 0.5)), x), -FARTHEST, FARTHEST)
    # The error of a height by rounding is no small one where readings are met to their last digits.
    rms = np.exp(heights.min() / law.n_kept)
    rounding = float(np.finfo(np.float64).eps * law.n_kept * np.abs(descent.readings).max() / rms)
    even = heights <= heights.min() + _EVENLY_HIGH + rounding
    out: list[int] = []
    for k in np.lexsort((np.where(even, np.sum(z**2, axis=1), heights), ~even)).tolist():
        if all(np.abs(x[k] - x[j]).max() > _SAME_PLACE for j in out):
            out.append(k)
    return z[out], int(even[out].sum())


class _Descent:
    """Levenberg-Marquardt from many points at once, in coordinates in which bounded priors are flat.

    A coordinate is the share of its prior below the value, from 0 to 1, or standard normal if the prior has no bounds.
    """

    def __init__(self, system: System, recording: Recording, law: NoiseLaw) -> None:
        self.system, self.law, self.model = system, law, Model(system, (), recording.plan)
        self.usable, self.readings = np.flatnonzero(recording.usable), recording.readings[recording.usable]
        self.flat = np.array([isinstance(prior, Uniform | LogUniform) for prior in system.marginals.values()])
        self.low, self.high = np.where(self.flat, 0.0, -FARTHEST), np.where(self.flat, 1.0, FARTHEST)
        self.per_block = max(AT_ONCE // len(recording), 1)

    def from_normal(self, z: FloatArray) -> FloatArray:
        return np.where(self.flat, ndtr(z), z)

    def residuals(self, x: FloatArray) -> FloatArray:
        """Return whitened residuals, (..., n_params) -> (..., n_usable)."""
        u = np.where(self.flat, x, ndtr(x)).reshape(-1, x.shape[-1])
        blocks = np.array_split(u, -(-len(u) // self.per_block))
        part, at = self.model.part_that_predicts(self.usable)
        with np.errstate(all="ignore"):
            out = [
                self.law((self.readings - self.model.chain.predict(theta, part)[:, at]).T).T
                for theta in map(self.system.prior.from_unit_cube, blocks)
            ]
        return np.concatenate(out).reshape(*x.shape[:-1], -1)

    def heights(self, residuals: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return minus the log density at points, of whitened residuals, and the likeliest variance, (k,) both."""
        with np.errstate(all="ignore"):
            variance = np.maximum(np.sum(residuals**2, axis=-1) / self.law.n_kept, LEAST_SCALE**2)
            height = 0.5 * self.law.n_kept * np.log(variance) + 0.5 * np.sum(np.where(self.flat, 0.0, x) ** 2, axis=-1)
        return np.where(np.isfinite(height), height, np.inf), variance

    def _look(self, x: FloatArray, *, central: bool) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return residuals (k, n), slopes of the readings (k, n_params, n), variances and heights, (k,), at points."""
        steps = np.where(x > 0.5 * (self.low + self.high), -_DIFFERENCE, _DIFFERENCE) * (10.0 if central else 1.0)
        apart = steps[:, :, None] * np.eye(x.shape[1])
        sides = [x[:, None], x[:, None] + apart, *([x[:, None] - apart] if central else [])]
        own, up, *down = np.split(
            self.residuals(np.concatenate(sides, axis=1)), [1, 1 + x.shape[1]][: len(sides) - 1], axis=1
        )
        with np.errstate(all="ignore"):
            slopes = (down[0] - up) / (2 * steps[:, :, None]) if central else (own - up) / steps[:, :, None]
        residuals = own[:, 0]
        height, variance = self.heights(residuals, x)
        wrong = ~(np.isfinite(height) & np.isfinite(slopes).all(axis=(1, 2)))
        height[wrong], variance[wrong], residuals[wrong], slopes[wrong] = np.inf, 1.0, 0.0, 0.0
        return residuals, slopes, variance, height

    def follow(self, x: FloatArray, n_steps: int, *, central: bool = False) -> tuple[FloatArray, FloatArray]:
        """Descend from each point; return where to, (k, n_params), and minus the log density there, (k,)."""
        x, damping, n_still = x.copy(), np.full(len(x), 1e-2), np.zeros(len(x))
        now = self._look(x, central=central)
        eye, of_prior = np.eye(x.shape[1]), np.where(self.flat, 0.0, 1.0)
        for _ in range(n_steps):
            go = np.flatnonzero(n_still < _STILL_FOR)
            if not go.size:
                break
            residuals, slopes, variance, height = (values[go] for values in now)
            at = x[go]
            curvature = slopes @ slopes.transpose(0, 2, 1) + (variance[:, None] * of_prior)[:, :, None] * eye
            downhill = np.einsum("kpn,kn->kp", slopes, residuals) - variance[:, None] * of_prior * at
            held = ((at <= self.low) & (downhill < 0)) | ((at >= self.high) & (downhill > 0))
            scale = np.sqrt(np.maximum(np.einsum("kpp->kp", curvature), LEAST_SCALE))
            curvature = np.where(held[:, :, None] | held[:, None], eye, curvature / scale[:, :, None] / scale[:, None])
            damped = curvature + (damping[go, None, None] + _ROUNDING) * eye
            step = np.linalg.solve(damped, np.where(held, 0.0, downhill / scale)[:, :, None])[:, :, 0] / scale
            longest = _LONGEST * (self.high - self.low)
            to = np.clip(at + np.clip(step, -longest, longest), self.low, self.high)
            then = self._look(to, central=central)
            with np.errstate(invalid="ignore"):
                gain = np.nan_to_num(height - then[3], nan=0.0)
            better = gain > 0
            for values, new in zip((x, *now), (to, *then), strict=True):
                values[go[better]] = new[better]
            n_still[go] = np.where(better & (gain > _STILL), 0, n_still[go] + 1)
            damping[go] = np.clip(damping[go] * np.where(better, 1 / 6, 5.0), 1e-14, 1e8)
        return x, now[3]


def is_noise_sd_known_beside_misfit(simulator: Simulator, table: RunTable) -> bool:
    """Return whether the noise sd is declared, or successive readings tell it: not from residuals alone."""
    return simulator.noise.sd is not None or rows_are_in_order(simulator, table)


def _noise_sd_of(simulator: Simulator, table: RunTable, recording: Recording, found: Fit) -> float:
    declared = simulator.noise.sd
    known = median_sd_of_column(table, declared) if isinstance(declared, str) else declared
    if known is not None:
        return float(known)
    rough = rough_sd(recording) if rows_are_in_order(simulator, table) else 0.0  # sorted, successive ones are too alike
    return min(found.sd, rough) if rough > 0 else found.sd


_WRONG = 1.0  # noise sds, rms, by which half the step changes predictions where the step fails
_REACH = 3.0  # sds of a parameter about its best value: what is further off has no share of the posterior


def with_step_for_likely_parameters(system: System, table: RunTable, found: Fit, sd: float) -> System:
    """Return the system with a step that integrates the law three sds of a shared parameter off the fit, too.

    The sds are those of Laplace's approximation. If this takes more than 4,096 steps beyond one per row, the step stays
    longer, and `system.integrations.too_stiff` is set. A system without a law, or of which the step does not fail
    there, is returned as it is. `sd` is that of a reading.
    """
    if system.simulator.law is None:
        return system
    sds = np.linalg.norm(covariance_root(found.slopes, sd**2), axis=1)
    shared = [name in system.simulator.parameters for name in system.marginals]  # not of one run, as where it starts
    apart = _REACH * np.diag(sds)[shared]
    theta = system.theta(np.clip(found.z + np.concatenate([apart, -apart]), -FARTHEST, FARTHEST))
    try:
        if with_converged_step(system, table, theta, tolerance=_WRONG * sd) is not system:
            return with_converged_step(system, table, theta, tolerance=STANDS_STILL * sd)
    except ParameterError:
        system.integrations.too_stiff = True
    return system
