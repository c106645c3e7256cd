"""The choice of the next measurement (paper, section 2.3, figures 2 and 8).

Samples of the posterior predict a reading at every place of a fine grid; a reading where the predictions differ most is
the most informative. A utility of readings is a `Utility`: the paper's is `ReadingEntropy`, of fifty hypotheses;
`InformationGain` uses the whole posterior and subtracts the entropy of the noise. For thousands of discs the readings
are interpolated in a table of the sensor's response (`DiscForecast`). Any other model predicts some hundreds of
hypotheses directly (`DirectForecast`). For an instrument that reads no field of shapes, `Inquiry` chooses among its own
settings.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from probewise.inquiry.any_instrument import Inquiry
    from probewise.inquiry.disc_table import DiscForecast, TabulatedChain, forecast_of
    from probewise.inquiry.entropy import UtilityMap, choose, entropy_map
    from probewise.inquiry.forecast import DirectForecast
    from probewise.inquiry.grid import Designs, Grid
    from probewise.inquiry.predictive import ReadingNoise
    from probewise.inquiry.readout import Readout, bits_gained, prior_entropy
    from probewise.inquiry.utilities import (
        Finishing,
        Goal,
        InformationAbout,
        InformationGain,
        ParameterValue,
        PerSecond,
        ReadingEntropy,
        Utility,
        UtilityInput,
        WhichShape,
        choose_several,
        utility_map,
        utility_named,
    )

__all__ = [
    "Designs",
    "DirectForecast",
    "DiscForecast",
    "Finishing",
    "Goal",
    "Grid",
    "InformationAbout",
    "InformationGain",
    "Inquiry",
    "ParameterValue",
    "PerSecond",
    "ReadingEntropy",
    "ReadingNoise",
    "Readout",
    "TabulatedChain",
    "Utility",
    "UtilityInput",
    "UtilityMap",
    "WhichShape",
    "bits_gained",
    "choose",
    "choose_several",
    "entropy_map",
    "forecast_of",
    "prior_entropy",
    "utility_map",
    "utility_named",
]

# In this order the first that has a name loads no other in vain.
_MODULES = ("predictive", "any_instrument", "readout", "grid", "forecast", "entropy", "utilities", "disc_table")


def __getattr__(name: str) -> object:
    """Load the module of a public name when it is first asked for (PEP 562): `Inquiry` needs no field of shapes."""
    for module in _MODULES if name in __all__ else ():
        found = getattr(import_module(f"{__name__}.{module}"), name, None)
        if found is not None:
            return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
