"""Model a sensor, let it choose its own measurements, find the physics its model leaves out."""

from probewise._version import __version__

__all__ = ["__version__"]
