"""The choice of the next measurement (paper, the machine learning system, figures 3 and 8).

Samples of the posterior predict a reading at every place of a fine grid; a reading where the predictions differ most is
the most informative. A utility of readings is a `Utility`: the paper's is `ReadingEntropy`, of fifty hypotheses;
`InformationGain` uses the whole posterior and subtracts the entropy of the noise. For thousands of hypotheses the
readings are interpolated in tables: of the sensor's response to discs (`DiscForecast`), or of the unit Gaussian's mass
inside a corner and a bent edge, for ellipses and convex polygons (`TabulatedForecast`). Any other model predicts some
hundreds of hypotheses directly (`DirectForecast`). For an instrument that reads no field of shapes, `Inquiry` chooses
among its own settings.
"""

from probewise.inquiry.any_settings import Inquiry, Predictive, ReadingNoise
from probewise.inquiry.batch import choose_several
from probewise.inquiry.bound import Bound, capacity_bits, fewest_readings, target_entropy
from probewise.inquiry.carded import CardedForecast, cards_of
from probewise.inquiry.choice import best_places_mask, choose
from probewise.inquiry.designs import Design, Designs
from probewise.inquiry.discs import DiscTable
from probewise.inquiry.finishing import Finishing
from probewise.inquiry.forecast import DirectForecast, Forecast, PredictiveDistributions
from probewise.inquiry.grid import Grid
from probewise.inquiry.information import bits_gained, neighbour_entropy, prior_entropy
from probewise.inquiry.labels import Label, ParameterValue, WhichShape
from probewise.inquiry.named import UTILITY_NAMES, utility_named
from probewise.inquiry.readout import Readout, entropy_bits
from probewise.inquiry.tabulated import DiscForecast, TabulatedForecast, forecast_of
from probewise.inquiry.tabulated_effects import TabulatedChain
from probewise.inquiry.utility import (
    InformationAbout,
    InformationGain,
    PerSecond,
    ReadingEntropy,
    Utility,
    label_entropy,
)
from probewise.inquiry.utility_input import Goal, UtilityInput
from probewise.inquiry.utility_map import UtilityMap, entropy_map, reachable_rows, utility_map

__all__ = [
    "UTILITY_NAMES",
    "Bound",
    "CardedForecast",
    "Design",
    "Designs",
    "DirectForecast",
    "DiscForecast",
    "DiscTable",
    "Finishing",
    "Forecast",
    "Goal",
    "Grid",
    "InformationAbout",
    "InformationGain",
    "Inquiry",
    "Label",
    "ParameterValue",
    "PerSecond",
    "Predictive",
    "PredictiveDistributions",
    "ReadingEntropy",
    "ReadingNoise",
    "Readout",
    "TabulatedChain",
    "TabulatedForecast",
    "Utility",
    "UtilityInput",
    "UtilityMap",
    "WhichShape",
    "best_places_mask",
    "bits_gained",
    "capacity_bits",
    "cards_of",
    "choose",
    "choose_several",
    "entropy_bits",
    "entropy_map",
    "fewest_readings",
    "forecast_of",
    "label_entropy",
    "neighbour_entropy",
    "prior_entropy",
    "reachable_rows",
    "target_entropy",
    "utility_map",
    "utility_named",
]
