"""Check that the arm can do what an experiment may choose: turn its sensor, read at other heights."""

from __future__ import annotations

from probewise.arm.instrument import Instrument
from probewise.errors import ParameterError
from probewise.experiment.configuration import Experiment


def require_turns_and_lifts(instrument: Instrument, experiment: Experiment) -> None:
    """Check that an instrument, already entered, can take the orientations and heights that may be chosen.

    An instrument that takes a pose's orientation and height without following it would record readings wrongly; so it
    has to declare `turns` and `lifts`. A single height needs no `lifts` if the instrument reads at that height.

    Raises
    ------
    ParameterError
        If the instrument does not declare what the experiment needs.
    """
    turns_rad, heights_mm = experiment.orientations_rad, experiment.heights_mm
    if turns_rad != (0.0,) and not getattr(instrument, "turns", False):
        raise ParameterError(
            "orientations_rad (--orientations)",
            turns_rad,
            _undeclared("turn its sensor to pose.orientation_rad: turns"),
        )
    own_mm = getattr(instrument, "read_height_mm", None)
    if set(heights_mm) - {own_mm} and not getattr(instrument, "lifts", False):
        raise ParameterError("heights_mm (--heights)", heights_mm, _undeclared("read at pose.height_mm: lifts"))


def _undeclared(what: str) -> str:
    return f"none with an instrument that does not declare that it can {what} = True"
