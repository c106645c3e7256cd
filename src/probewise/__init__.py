"""Model a sensor, let it choose its own measurements, find the physics its model leaves out.

One folder an idea of the paper, imported as you use it: `from probewise import calibration, nested`.
In the order of one reading's path: `arm` (where readings come from), `recordings`, `scene`
(what lies under the sensor), `sensor` (from scene to reading), `inference`, `nested` (evidence and
posterior), `inquiry` (where to measure next), `experiment` (the loop), `calibration`, `diagnosis`
(what the model leaves out), `effects`, `report`; `world` is the simulated world apart.
"""

from probewise._display import before_first_display
from probewise._version import __version__

__all__ = ["__version__"]


def _load_renderers() -> None:
    """Let results show themselves with pictures; matplotlib is loaded no sooner."""
    import probewise.report.notebook  # noqa: F401


before_first_display(_load_renderers)
