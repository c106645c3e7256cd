"""The centre of a resonance: a Lorentzian peak whose width, height and background are unknown too."""

from __future__ import annotations

import numpy as np

import probewise
from any_instrument.problem import Found, Instrument, Problem, found_by_particles
from probewise.priors import Normal, Uniform

GOAL = 0.01
NOISE_SD = 0.2
SETTINGS = np.linspace(1.5, 4.5, 301)
MOST_READINGS = 400

PRIOR = {
    "centre": Uniform(2.0, 4.0),
    "width": Uniform(0.02, 0.2),
    "height": Uniform(0.5, 2.0),
    "background": Normal(0.0, 0.5),
}


def ours(read: Instrument, rng: np.random.Generator) -> Found:
    """Find the centre with probewise."""

    def peak(p, x):
        return p["background"] + p["height"] / (1 + ((x - p["centre"]) / p["width"]) ** 2)

    inquiry = probewise.Inquiry(peak, PRIOR, SETTINGS, NOISE_SD, goal={"centre": GOAL}, rng=rng)
    while not inquiry.settled and len(inquiry.readings) < MOST_READINGS:
        inquiry.tell(read(inquiry.next()))
    posterior = inquiry.posterior
    low, high = posterior.interval(0.95)[:, :1]
    return Found(len(inquiry.readings), posterior.mean()[:1], posterior.sd()[:1], low, high)


def theirs(read: Instrument, rng: np.random.Generator, *, n_particles=5000, kind=None, **options: object) -> Found:
    """Find the centre with optbayesexpt."""
    from optbayesexpt import OptBayesExpt

    def peak(settings, parameters, constants):
        (x,) = settings
        centre, width, height, background = parameters
        return background + height / (1 + ((x - centre) / width) ** 2)

    samples = [marginal.from_unit(rng.random(n_particles)) for marginal in PRIOR.values()]
    experiment = (kind or OptBayesExpt)(peak, (SETTINGS,), samples, (), default_noise_std=NOISE_SD, **options)
    experiment.rng = rng
    n_readings = 0
    while experiment.std()[0] > GOAL and n_readings < MOST_READINGS:
        x = experiment.get_setting()
        experiment.pdf_update((x, read(x[0]), NOISE_SD))
        n_readings += 1
    return found_by_particles(n_readings, experiment.particles[:1], experiment.particle_weights)


def theirs_at_best(read: Instrument, rng: np.random.Generator) -> Found:
    """Find the centre with optbayesexpt, without contraction, by its full utility from many draws and particles."""
    from optbayesexpt import OptBayesExpt

    class WithinPrior(OptBayesExpt):
        def enforce_parameter_constraints(self):
            columns = zip(self.particles, PRIOR.values(), strict=True)
            outside = ~np.isfinite(sum(marginal.log_prob(column) for column, marginal in columns))
            self.particle_weights[outside] = 0.0
            self.particle_weights /= self.particle_weights.sum()

    options = {"scale": False, "utility_method": "full_kld_utility", "n_draws": 100}
    return theirs(read, rng, n_particles=20_000, kind=WithinPrior, **options)


def draw(rng: np.random.Generator) -> dict[str, float]:
    """Draw a resonance."""
    return {name: float(marginal.from_unit(rng.random())) for name, marginal in PRIOR.items()}


def reading(p: dict[str, float], x: float, rng: np.random.Generator) -> float:
    """Read it at a setting."""
    clean = p["background"] + p["height"] / (1 + ((x - p["centre"]) / p["width"]) ** 2)
    return clean + NOISE_SD * rng.standard_normal()


RESONANCE = Problem(
    {"probewise": ours, "optbayesexpt, defaults": theirs, "optbayesexpt, full utility": theirs_at_best},
    draw,
    reading,
    {"centre": GOAL},
    MOST_READINGS,
)
