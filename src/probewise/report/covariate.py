"""Covariates of a diagnosis: their names in words, units, and values, one per reading."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import UNITS as UNITS_OF_NAMES
from probewise._words import unit_after_number, unit_of_name
from probewise.diagnosis import Diagnosis, Place
from probewise.diagnosis.simulator_rows import SimulatorApparatus

UNITS = {"place": "mm", "time": "s", "orientation": "degree", "edge_distance": "mm"}
DIRECTIONS = {-1.0: "backwards", 0.0: "at rest", 1.0: "forwards"}
"""Names of the signs of motion."""
WORDS = {
    "level": "predicted reading",
    "slope": "slope of the predicted reading along the motion",
    "place": "place along the scans",
    "direction": "direction of motion",
    "orientation": "orientation of the sensor",
    "edge_distance": "distance from the edge",
}


def covariate_in_words(name: str) -> str:
    """Return a covariate's name in words, without its unit: "battery" for battery_mv."""
    stem, _, suffix = name.rpartition("_")
    own = stem if stem and suffix in UNITS_OF_NAMES else name
    return WORDS.get(name, own.replace("column:", "column ").replace("_", " "))


def term_family_in_words(family: str) -> str:
    """Write a family of bases in words: "time, scan by scan (locally)" for "time within scans, locally"."""
    name, _, how = family.partition(", ")
    stem = name.removesuffix(" within scans")
    said = covariate_in_words(stem) + (", scan by scan" if stem != name else "")
    return f"{said} ({how})" if how else said


def covariate_unit(name: str, unit: str) -> str:
    """Return the unit of a covariate, "" if none is known; `unit` is the readings' unit."""
    known = {**UNITS, "level": unit_after_number(unit), "slope": f"{unit_after_number(unit)} per mm"}
    return known.get(name, unit_of_name(name))


def covariate_in_words_and_unit(diagnosis: Diagnosis, name: str) -> tuple[str, str]:
    """Return a covariate's name in words, and its unit, "" if none is known."""
    unit, apparatus = diagnosis.recording.plan.instrumentation.unit, diagnosis.apparatus
    if not isinstance(apparatus, SimulatorApparatus):
        return ("scan" if name == "scan" else covariate_in_words(name)), covariate_unit(name, unit)
    units = {"time": apparatus.system.simulator.time_unit, "level": unit, "previous": unit}
    return apparatus.words.covariate_in_words(name), units.get(name, unit_of_name(name))


def axis_label(diagnosis: Diagnosis, name: str, scan: str | None = None) -> str:
    """Return an axis label: the covariate in words, the scan (or run) if one is given, and the unit in brackets."""
    said, unit = covariate_in_words_and_unit(diagnosis, name)
    run = diagnosis.apparatus.words.run
    said += f", {run} {scan}" if scan is not None and name != run else ""
    return said + (f" ({unit_after_number(unit)})" if unit else "")


def covariate_values_by_place(diagnosis: Diagnosis) -> dict[str, FloatArray]:
    """Return the covariate's values (n_points,) of each place in `diagnosis.where`, by the place's figure file name.

    A place is a window of a covariate, or a scan, with significant residuals. Values are those the diagnosis used; NaN
    in unusable rows and where undefined.
    """
    usable, out = np.flatnonzero(diagnosis.recording.usable), {}
    for place in diagnosis.where:
        out[place.figure_name] = np.full(len(diagnosis.recording), np.nan)
        if place.values is not None:
            out[place.figure_name][usable] = place.values
    return out


def category_name_by_value(diagnosis: Diagnosis, place: Place) -> dict[float, str] | None:
    """Return the names, by value, of a place's covariate if it is scan, run, direction, or up to 24 orientations.

    Values ascend. None for other covariates; of a simulator's covariates, only the run has names.
    """
    if place.covariate == diagnosis.apparatus.words.run:
        return {float(k): name for k, name in enumerate(diagnosis.recording.plan.scan_names)}
    if isinstance(diagnosis.apparatus, SimulatorApparatus):
        return None  # a table's column may be called as a covariate of a light sensor is
    there = [] if place.values is None else np.unique(place.values[np.isfinite(place.values)]).tolist()
    match place.covariate:
        case "direction":
            return {sign: DIRECTIONS[sign] for sign in there}
        case "orientation":
            return {angle: f"{angle:g}°" for angle in there} if len(there) <= 24 else None
        case _:
            return None
