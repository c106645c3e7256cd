"""The choice of the next setting of any instrument, from a model of its readings, a prior, settings and noise.

The paper's machine learning system without a field of shapes: readings update the posterior (`posterior`), and the next
setting maximises an acquisition function (`Inquiry.utility`): expected information (Lindley 1956) or, near a goal, the
expected decrease of the posterior sds towards the goal.
"""

from probewise.inquiry.any_settings.acquisition import Predictive
from probewise.inquiry.any_settings.inquiry import Inquiry
from probewise.inquiry.any_settings.noise import ReadingNoise

__all__ = ["Inquiry", "Predictive", "ReadingNoise"]
