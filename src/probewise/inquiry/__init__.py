"""Choose the next measurement by the entropy map (paper, the machine learning system, figures 3 and 8).

Hypotheses drawn from the posterior predict a reading at every place of a fine grid; where
their predictions differ most, a reading tells most. The worth of a set of predictions is a
small function behind one seam, `Utility`; the paper's is `ReadingEntropy`.
"""

from probewise.inquiry.choice import best_places, choose
from probewise.inquiry.entropy_map import EntropyMap, entropy_map
from probewise.inquiry.grid import Grid
from probewise.inquiry.information import bits_gained, gaussian_entropy, neighbour_entropy, prior_entropy
from probewise.inquiry.utility import Prospect, ReadingEntropy, Utility, label_entropy

__all__ = [
    "EntropyMap",
    "Grid",
    "Prospect",
    "ReadingEntropy",
    "Utility",
    "best_places",
    "bits_gained",
    "choose",
    "entropy_map",
    "gaussian_entropy",
    "label_entropy",
    "neighbour_entropy",
    "prior_entropy",
]
