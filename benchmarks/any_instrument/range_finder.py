"""An ultrasonic range finder on a turntable looks for a wall; one reading in ten is an echo of something else."""

from __future__ import annotations

import math

import numpy as np

import probewise
from any_instrument.problem import Found, Instrument, Problem, found_by_particles
from probewise.inquiry import ReadingNoise
from probewise.priors import Uniform

RANGE_MM, NOISE_MM, ECHOES = 4000.0, 30.0, 0.1
BEARINGS_RAD = np.radians(np.arange(-180.0, 180.0, 3.0))
GOALS = {"distance_mm": 15.0, "normal_rad": math.radians(1.0)}
PRIOR = {"distance_mm": Uniform(300.0, 3000.0), "normal_rad": Uniform(-math.pi, math.pi)}
MOST_READINGS = 200


def ours(read: Instrument, rng: np.random.Generator) -> Found:
    """Find the wall with probewise."""

    def echo(p, bearing_rad):
        towards = np.cos(bearing_rad - p["normal_rad"])
        return np.minimum(p["distance_mm"] / np.maximum(towards, 1e-3), RANGE_MM)

    noise = ReadingNoise(NOISE_MM, outliers=ECHOES, between=(0.0, RANGE_MM))
    inquiry = probewise.Inquiry(echo, PRIOR, BEARINGS_RAD, noise, goal=GOALS, rng=rng)
    while not inquiry.settled and len(inquiry.readings) < MOST_READINGS:
        inquiry.tell(read(inquiry.next()))
    posterior = inquiry.posterior
    low, high = posterior.interval(0.95)
    return Found(len(inquiry.readings), posterior.mean(), posterior.sd(), low, high)


def theirs(read: Instrument, rng: np.random.Generator, *, n_particles=5000, base=None, **options: object) -> Found:
    """Find the wall with optbayesexpt, whose likelihood a user replaces where readings may be something else."""
    from optbayesexpt import OptBayesExpt

    def echo(settings, parameters, constants):
        (bearing_rad,) = settings
        distance_mm, normal_rad = parameters
        towards = np.cos(bearing_rad - normal_rad)
        return np.minimum(distance_mm / np.maximum(towards, 1e-3), RANGE_MM)

    class WithEchoes(base or OptBayesExpt):
        def likelihood(self, y_model, measurement_record):
            off = (y_model[0] - measurement_record[1]) / NOISE_MM
            own = np.exp(-(off**2) / 2) / (NOISE_MM * np.sqrt(2 * np.pi))
            return (1 - ECHOES) * own + ECHOES / RANGE_MM

    samples = [marginal.from_unit(rng.random(n_particles)) for marginal in PRIOR.values()]
    experiment = WithEchoes(echo, (BEARINGS_RAD,), samples, (), default_noise_std=NOISE_MM, **options)
    experiment.rng = rng
    n_readings = 0
    while (experiment.std() > list(GOALS.values())).any() and n_readings < MOST_READINGS:
        x = experiment.get_setting()
        experiment.pdf_update((x, read(x[0]), NOISE_MM))
        n_readings += 1
    return found_by_particles(n_readings, experiment.particles, experiment.particle_weights)


def theirs_at_best(read: Instrument, rng: np.random.Generator) -> Found:
    """Find the wall with optbayesexpt, without contraction, by its full utility from many draws and particles."""
    from optbayesexpt import OptBayesExpt

    class WithinPrior(OptBayesExpt):
        def enforce_parameter_constraints(self):
            columns = zip(self.particles, PRIOR.values(), strict=True)
            outside = ~np.isfinite(sum(marginal.log_prob(column) for column, marginal in columns))
            self.particle_weights[outside] = 0.0
            self.particle_weights /= self.particle_weights.sum()

    options = {"scale": False, "utility_method": "full_kld_utility", "n_draws": 100}
    return theirs(read, rng, n_particles=20_000, base=WithinPrior, **options)


def draw(rng: np.random.Generator) -> dict[str, float]:
    """Draw a wall."""
    return {name: float(marginal.from_unit(rng.random())) for name, marginal in PRIOR.items()}


def reading(p: dict[str, float], bearing_rad: float, rng: np.random.Generator) -> float:
    """Read its distance along a bearing, or something else's."""
    along = math.cos(bearing_rad - p["normal_rad"])
    own = min(p["distance_mm"] / max(along, 1e-3), RANGE_MM) + NOISE_MM * rng.standard_normal()
    other, which = rng.uniform(0.0, RANGE_MM), rng.random()
    return float(other if which < ECHOES else own)


WALL = Problem(
    {"probewise": ours, "optbayesexpt, defaults": theirs, "optbayesexpt, full utility": theirs_at_best},
    draw,
    reading,
    GOALS,
    MOST_READINGS,
)
