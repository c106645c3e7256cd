"""Challenge cases: recordings that conceal an effect of a known size, drawn from a sealed seed.

Which sensor, plan, noise and effect a case has follows from the seed and its number alone, and what is kept
back for the test comes from the same world. The size of an effect needs the null model that it has to survive:
whoever asks for a case hands over that refit.
"""

from probewise.world.challenge.cases import ALIASES, Case, draw_case, kept_back
from probewise.world.challenge.inside import INSIDE, NEEDS_SENSOR, NO_PHYSICS, SINGLES
from probewise.world.challenge.outsiders import OUTSIDE
from probewise.world.challenge.plans import PLANS, draw_plan, kept_back_plans
from probewise.world.challenge.regions import Region
from probewise.world.challenge.sensors import NOISE_LEVELS, NOISE_MODELS, NOISE_NAMES, SSFS, draw_sensor, with_noise
from probewise.world.challenge.sizing import Ruler, Surviving, amplitude_of_size
from probewise.world.challenge.strata import WHEEL, Kind, Stratum, stratum_of
from probewise.world.challenge.truth import Alias, Hidden, Truth

__all__ = [
    "ALIASES",
    "INSIDE",
    "NEEDS_SENSOR",
    "NOISE_LEVELS",
    "NOISE_MODELS",
    "NOISE_NAMES",
    "NO_PHYSICS",
    "OUTSIDE",
    "PLANS",
    "SINGLES",
    "SSFS",
    "WHEEL",
    "Alias",
    "Case",
    "Hidden",
    "Kind",
    "Region",
    "Ruler",
    "Stratum",
    "Surviving",
    "Truth",
    "amplitude_of_size",
    "draw_case",
    "draw_plan",
    "draw_sensor",
    "kept_back",
    "kept_back_plans",
    "stratum_of",
    "with_noise",
]
