"""Brute-force simulator of a light sensor: sums light over pixels and rays, with effects that a sensor model omits.

It shares only the file formats with the rest of the package: data simulated by the model's own code would not test
the model. The summed integral is the paper's eq. RwithSSF.
"""

from probewise.world.concealed import saturation
from probewise.world.spots import Blob, Spot, gaussian_spot, raster_spot, ridge_spot, ring_spot, tailed_spot
from probewise.world.stages import Concealed
from probewise.world.surfaces import CoveredSurface, Oval, Surface, albedo_at, seen_white_fraction
from probewise.world.world import Reader, World

__all__ = [
    "Blob",
    "Concealed",
    "CoveredSurface",
    "Oval",
    "Reader",
    "Spot",
    "Surface",
    "World",
    "albedo_at",
    "gaussian_spot",
    "raster_spot",
    "ridge_spot",
    "ring_spot",
    "saturation",
    "seen_white_fraction",
    "tailed_spot",
]
