"""From scene to reading: the SSF, its response to a scene, and the chain of stages to a reading.

Paper, sections 2.4 and 2.5: the naive sensor (eq. 6), M = I_min + (I_max - I_min) R (eq. 7), R (eq. 8 and 9), and the
mixture of Gaussians (eq. 10).
"""

from probewise.sensor.chain import Chain, FixedLevels, FreeLevels, Levels, response
from probewise.sensor.commanded import COMMANDED, with_declared_height_commanded
from probewise.sensor.gaussian import ACCURATE_NODES, FAST_NODES
from probewise.sensor.naive import NaiveSensor
from probewise.sensor.ssf import (
    N_BENDS,
    N_FREE_FORM,
    FixedMixture,
    FreeMixture,
    SSFField,
    SSFModel,
    bend_coefficients,
    footprint_of,
    free_form_theta,
    is_free_form,
    mean_albedo_by_pixels,
    mean_ssf_field,
    merged_mean_mixture,
    mixture_of_field,
    mixture_parameter_names,
)
from probewise.sensor.stages import (
    AnyEffect,
    Effect,
    Footprint,
    NoiseParameters,
    Poses,
    SceneView,
    SensorModel,
    Stage,
    View,
)

__all__ = [
    "ACCURATE_NODES",
    "COMMANDED",
    "FAST_NODES",
    "N_BENDS",
    "N_FREE_FORM",
    "AnyEffect",
    "Chain",
    "Effect",
    "FixedLevels",
    "FixedMixture",
    "Footprint",
    "FreeLevels",
    "FreeMixture",
    "Levels",
    "NaiveSensor",
    "NoiseParameters",
    "Poses",
    "SSFField",
    "SSFModel",
    "SceneView",
    "SensorModel",
    "Stage",
    "View",
    "bend_coefficients",
    "footprint_of",
    "free_form_theta",
    "is_free_form",
    "mean_albedo_by_pixels",
    "mean_ssf_field",
    "merged_mean_mixture",
    "mixture_of_field",
    "mixture_parameter_names",
    "response",
    "with_declared_height_commanded",
]
