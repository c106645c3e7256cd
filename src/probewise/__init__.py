"""Model a sensor, let it choose its own measurements, find the physics its model leaves out.

The commands of the command line as functions:

- `calibrate(recording, rng=rng)` fits a sensor model to a recording
- `predict(sensor, plan)` predicts the readings of a plan
- `explore(sensor, rng=rng)` lets the robot find a shape, choosing its own measurements
- `audit(plan)` says, before any data, which effects a plan cannot detect or distinguish
- `diagnose(recordings, rng=rng)` finds the physics that the model leaves out

With `simulator=`, a `Simulator` of your own or its file, `diagnose`, `audit` and `fit` take tables; `investigate` takes
the readings that a diagnosis advises.

`Inquiry(model, prior, settings, noise, rng=rng)` chooses the settings of any other instrument.

`Recording.from_table` makes recordings; `read_recording`, `read_plan`, `read_sensor`, `read_simulator` and
`read_fitted_system` read files. Results display themselves in notebooks.

The parts are packages, loaded at first use. In the order of one reading's path: `arm` (where readings come from),
`recordings`, `scene` (what lies under the sensor), `sensor` (from scene to reading), `inference`, `nested` (evidence
and posterior: `nested.run`), `inquiry` (where to measure next), `experiment` (the loop), `calibration`, `effects`,
`diagnosis` and `investigation` (what the model leaves out), `systems` (simulators of users), `report`;
`world` is an independent simulator, `emulator` a LEGO brick in software, `proof` measures robot and diagnosis.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from typing import TYPE_CHECKING

from probewise._version import __version__
from probewise.verbs import audit, calibrate, diagnose, explore, fit, predict

if TYPE_CHECKING:
    from probewise import (  # noqa: F401
        arm,
        calibration,
        diagnosis,
        effects,
        emulator,
        errors,
        experiment,
        inference,
        inquiry,
        investigation,
        nested,
        priors,
        progress,
        proof,
        recordings,
        report,
        scene,
        sensor,
        systems,
        world,
    )
    from probewise.calibration import read_sensor
    from probewise.inquiry import Inquiry
    from probewise.investigation import investigate
    from probewise.recordings import Plan, Recording, read_plan, read_recording
    from probewise.systems import Law, Simulator, read_fitted_system, read_simulator

__all__ = [
    "Inquiry",
    "Law",
    "Plan",
    "Recording",
    "Simulator",
    "__version__",
    "audit",
    "calibrate",
    "diagnose",
    "explore",
    "fit",
    "investigate",
    "nested",
    "predict",
    "read_fitted_system",
    "read_plan",
    "read_recording",
    "read_sensor",
    "read_simulator",
]

# Names that are loaded when they are first used, by their package; packages are too.
_NAMES = {
    "calibration": ("read_sensor",),
    "inquiry": ("Inquiry",),
    "investigation": ("investigate",),
    "recordings": ("Plan", "Recording", "read_plan", "read_recording"),
    "systems": ("Law", "Simulator", "read_fitted_system", "read_simulator"),
}
_HOME = {name: home for home, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> object:
    """Load a package, or a value of one, when it is first asked for (PEP 562)."""
    if name not in _HOME and (name.startswith("_") or find_spec(f"probewise.{name}") is None):
        raise AttributeError(f"module 'probewise' has no attribute {name!r}")
    home = importlib.import_module(f"probewise.{_HOME.get(name, name)}")
    found = getattr(home, name) if name in _HOME else home
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__
