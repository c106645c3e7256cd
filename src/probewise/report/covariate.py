"""The covariates of a diagnosis as people read them, and their values row by row."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise.diagnosis import Diagnosis, Place
from probewise.diagnosis.system.apparatus import PersonsSystem
from probewise.report.words import unit_name

__all__ = [
    "category_names",
    "covariate_label",
    "covariate_unit",
    "covariate_values",
    "covariate_words",
    "family_words",
    "label_of",
    "words_and_unit",
]

UNITS = {"place": "mm", "time": "s", "orientation": "degree", "edge_distance": "mm"}
SUFFIXES = {"mv": "mV", "v": "V", "mm": "mm", "s": "s", "deg": "degree", "c": "°C", "k": "K", "percent": "%"}
"""Units by the last part of a column's own name, such as battery_mv."""
WORDS = {
    "level": "predicted reading",
    "slope": "slope of the predicted reading along the move",
    "place": "place along the scans",
    "direction": "direction of the move",
    "orientation": "orientation of the sensor",
    "edge_distance": "distance from the edge",
}


def covariate_label(name: str, unit: str, scan: str | None = None) -> str:
    """Name a covariate with its unit; `unit` is the reading's."""
    said, own = covariate_words(name), covariate_unit(name, unit)
    if scan is not None and name != "scan":
        said += f", scan {scan}"
    return said + (f" ({own})" if own else "")


def covariate_words(name: str) -> str:
    """Name a covariate."""
    stem, _, suffix = name.rpartition("_")
    return WORDS.get(name, (stem if stem and suffix in SUFFIXES else name).replace("_", " "))


def family_words(family: str) -> str:
    """Name what something unknown depends on: a covariate, in all or within each scan, and how."""
    name, _, how = family.partition(", ")
    stem = name.removesuffix(" within scans")
    said = covariate_words(stem) + (", scan by scan" if stem != name else "")
    return f"{said} ({how})" if how else said


def covariate_unit(name: str, unit: str) -> str:
    """Name its unit, "" where it has none that is known; `unit` is the reading's."""
    known = {**UNITS, "level": unit_name(unit), "slope": f"{unit_name(unit)} per mm"}
    return known.get(name, SUFFIXES.get(name.rpartition("_")[2], ""))


def words_and_unit(diagnosis: Diagnosis, name: str) -> tuple[str, str]:
    """Name a covariate of a diagnosis, and its unit, "" where it has none that is known."""
    unit, apparatus = diagnosis.recording.plan.instrumentation.unit, diagnosis.apparatus
    if not isinstance(apparatus, PersonsSystem):
        return ("scan" if name == "scan" else covariate_words(name)), covariate_unit(name, unit)
    own = apparatus.system.simulator
    known = {
        "time": (own.time or "time", own.time_unit),
        "row": ("row of the table", ""),
        "level": (f"predicted {own.reading}", unit),
        "previous": (f"change of {own.reading} since the row before", unit),
    }
    return known.get(name, (name.replace("state:", "state "), ""))


def label_of(diagnosis: Diagnosis, name: str, scan: str | None = None) -> str:
    """Label an axis with a covariate of a diagnosis and its unit."""
    said, unit = words_and_unit(diagnosis, name)
    run = diagnosis.apparatus.words.run
    said += f", {run} {scan}" if scan is not None and name != run else ""
    return said + (f" ({unit_name(unit)})" if unit else "")


def covariate_values(diagnosis: Diagnosis) -> dict[str, FloatArray]:
    """Give each row's value of the covariate of each place, (n_points,), by the place's witness.

    NaN for rows that a place does not speak of. They are the values in which the place was found: a window of three
    readings holds others where a slope is worked out from another estimate of the same sensor.
    """
    usable, out = np.flatnonzero(diagnosis.recording.usable), {}
    for place in diagnosis.where:
        out[place.witness] = np.full(len(diagnosis.recording), np.nan)
        if place.values is not None:
            out[place.witness][usable] = place.values
    return out


def category_names(diagnosis: Diagnosis, place: Place) -> dict[float, str] | None:
    """Name the values of a covariate that has no scale: scans, directions, orientations; None for all others."""
    match place.covariate:
        case "scan" | "run":
            return {float(k): name for k, name in enumerate(diagnosis.recording.plan.scan_names)}
        case "direction":
            return {-1.0: "backwards", 1.0: "forwards"}
        case "orientation":
            angles = np.unique(np.round(np.degrees(diagnosis.recording.plan.orientation_rad), 6))
            return {float(angle): f"{angle:g}°" for angle in angles} if len(angles) <= 24 else None
        case _:
            return None
