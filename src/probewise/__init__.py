"""Model a sensor, let it choose its own measurements, find the physics its model leaves out."""

