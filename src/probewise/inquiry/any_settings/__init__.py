"""Choose the settings of any instrument: a model of its readings, a prior, the settings that it has, its noise.

The paper's machine learning system without a field of shapes: readings update the posterior (`belief`), and the next
setting is the one whose reading promises most (`worth`), by expected information (Lindley 1956) or by what brings
the sds that are asked for nearest.
"""

from probewise.inquiry.any_settings.inquiry import Inquiry
from probewise.inquiry.any_settings.noise import ReadingNoise
from probewise.inquiry.any_settings.worth import Predictive

__all__ = ["Inquiry", "Predictive", "ReadingNoise"]
