"""Doubt in a run whose arm reads at another height than that of the sensor's calibration.

Without heights to choose from, every reading counts as one at the calibrated height. An arm that reads elsewhere makes
the footprint wider or narrower and the signal weaker or stronger than modelled, and the shape wrong.
"""

from __future__ import annotations

from probewise.arm.instrument import Reading
from probewise.experiment.configuration import Experiment
from probewise.experiment.journal import covariates_with_height

_MOST_OFF = 0.01  # share of the calibrated height, which changes the signal by 2 %


def height_of_reading_mm(reading: Reading) -> float | None:
    """Return the height of a reading above the surface, if the arm says it; NaN if it says that it is missing."""
    return covariates_with_height(reading).get("height_mm")


def doubt_about_height(experiment: Experiment, height_mm: float | None) -> str | None:
    """Describe why a run with readings at this height is doubtful; None if it is not, or either height is not known.

    Readings at heights that may be chosen (`Experiment.heights_mm`) count as what they are, and leave no doubt.
    """
    calibrated_mm = experiment.calibrated_height_mm
    if experiment.heights_mm or calibrated_mm is None or height_mm is None:
        return None
    if not abs(height_mm - calibrated_mm) > _MOST_OFF * calibrated_mm:  # NaN: the height is not known
        return None
    return (
        f"the arm reads {height_mm:g} mm above the surface, and the sensor was calibrated at {calibrated_mm:g} mm: "
        f"every reading counts as one at {calibrated_mm:g} mm, so the shape may be wrong by more than its sds; "
        f"calibrate the sensor at {height_mm:g} mm, or name the height (heights_mm, --heights {height_mm:g})"
    )
