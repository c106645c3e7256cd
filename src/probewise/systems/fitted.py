"""A simulator fitted to a recording, repaired or not, and its file format."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import BoolArray, FloatArray
from probewise._kinds import checked_texts, require_kind
from probewise._posterior_samples import NamedSamples, interval_table_lines
from probewise._version import __version__
from probewise.effects import EFFECTS
from probewise.errors import FileError, ParameterError, message_of, printable, require
from probewise.recordings import parse_json_file_text, write_text_atomically
from probewise.recordings.io import read_text
from probewise.recordings.table import csv_text, number_text
from probewise.sensor import Stage
from probewise.systems.forms.reference import StoredFit
from probewise.systems.simulator import Simulator, fingerprint_of_text, run_simulator_text
from probewise.systems.table import RunTable

FORMAT = "system/1"
_WHAT = "a repaired.json or calibrated.json of `probewise diagnose --simulator`, or a fitted.json of `probewise fit`"


@dataclass(frozen=True, eq=False)
class FittedSystem(NamedSamples):
    """Posterior of a simulator's parameters and of the effects that it leaves out.

    Parameters
    ----------
    names
        Names of the columns of `samples`: the simulator's parameters, `name[run]` for those per run, then
        "<effect>.<parameter>".
    samples
        Equally weighted posterior samples, (n_samples, n_params), at least 500.
    noise_sd
        Sd of one new reading for each sample, (n_samples,), in the unit of the readings; relative if the simulator's
        `noise` names a column of sds.
    effects, absent
        Names of the effects, including noise effects; and by effect the mask of the samples without it, (n_samples,).
    level
        Smallest and largest of the readings predicted for the recording, in their unit.
    max_step, stiff
        Largest integration step, in the unit of time, infinite without a law; and whether a linearly implicit method
        takes it.
    known
        The recording and fit by which the effects were scaled and given origins; None if there are noise effects at
        most.
    best
        The point of highest posterior density in the priors' own coordinates, (n_params,), if it is known: see `mode`.
    recording, source
        Fingerprint (digest) of the recording, and the name of its file.
    notes, version
        Reasons to use the result with care; version of the package.
    """

    simulator: Simulator
    names: tuple[str, ...]
    samples: FloatArray
    noise_sd: FloatArray
    effects: tuple[str, ...] = ()
    absent: Mapping[str, BoolArray] = field(default_factory=dict)
    level: tuple[float, float] = (0.0, 1.0)
    max_step: float = math.inf
    stiff: bool = False
    known: StoredFit | None = None
    best: tuple[float, ...] = ()
    recording: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()
    version: str = __version__

    def __post_init__(self) -> None:
        self.require_sound_samples()
        simulator, known = self.simulator, {*self.names, *(name.partition("[")[0] for name in self.names)}
        for name in simulator.parameters:
            there = name in (known if name in simulator.per_run else self.names)
            require(there, "names", self.names, f"all parameters of the simulator; {name} is missing")
        checked_texts("notes", self.notes, "reasons to use the result with care")
        effects = checked_texts("effects", self.effects, "names of effects")
        if self.known is None and any(getattr(EFFECTS.get(name), "stage", None) != Stage.NOISE for name in effects):
            raise ParameterError("effects", list(self.effects), "effects on the noise alone, unless `known` is given")

    def summary(self) -> str:
        """Return a plain-text summary: simulator, effects, number of samples, noise sd, and the table of parameters."""
        own, effects = self.simulator, f", with {', '.join(self.effects)}" if self.effects else ""
        what = f"{own.source or 'a simulator'} of {own.reading} ({own.unit}){effects}; {len(self.samples)} samples"
        noise = f"noise of a new reading {np.median(self.noise_sd):.4g} {own.unit}"
        return "\n".join([what, noise, self.parameter_table()])

    def mode(self) -> dict[str, float]:
        """Return the point of highest posterior density in the priors' own coordinates, by name of the parameter.

        In its own coordinate, the value or its logarithm, a uniform or log-uniform prior is flat: with such priors it
        is the point of least squares. Of points that are equally high it is the one nearest to the middle of the prior.
        Raises ParameterError if the model is that of a diagnosis, which keeps samples only.
        """
        require(self.best, "mode", None, "a model of `probewise fit` or fit_simulator(...).fitted; take median()")
        return dict(zip(self.names, self.best, strict=True))

    def parameter_table(self) -> str:
        """Return a text table of each parameter's median and 95 % interval, and of its mode if that is known."""
        median, interval = self.median(), self.interval()
        lines = interval_table_lines([(name, median[name], interval[name]) for name in self.names])
        if self.best:
            width, modes = max(map(len, lines)), ["mode", *(f"{value:.8g}" for value in self.best)]
            lines = [f"{line:<{width}}  {mode}" for line, mode in zip(lines, modes, strict=True)]
        return "\n".join(lines)

    def to_json(self) -> str:
        """Serialise as strict JSON, format "system/1"."""
        known = self.known
        bound_about = known and {
            "time": known.table.time,
            "run": known.table.run,
            "columns": {name: _column_to_json(values) for name, values in known.table.columns.items()},
            "predicted": _column_to_json(known.predicted),
            "sd": known.sd,
            "states": {name: _column_to_json(values) for name, values in known.states.items()},
            "held": list(known.held),
        }
        document = {
            "format": FORMAT,
            "version": self.version,
            "simulator": {
                "source": self.simulator.source,
                "fingerprint": self.simulator.fingerprint,
                "reading": self.simulator.reading,
                "unit": self.simulator.unit,
                "max_step": self.max_step if math.isfinite(self.max_step) else None,
                "stiff": self.stiff,
            },
            "recording": {"fingerprint": self.recording, "source": printable(self.source)},
            "parameters": self.rows_by_parameter("mean", "median", "sd", "interval95"),
            "effects": list(self.effects),
            "absent": {name: np.flatnonzero(without).tolist() for name, without in self.absent.items()},
            "noise": {"mean": float(self.noise_sd.mean()), "sd": self.noise_sd.tolist()},
            **({"mode": self.mode()} if self.best else {}),
            "level": list(self.level),
            "bound_about": bound_about,
            "notes": list(self.notes),
            "samples": self.samples.tolist(),
        }
        return json.dumps(document, allow_nan=False) + "\n"

    @classmethod
    def from_json(
        cls, text: str, simulator: Simulator | str | os.PathLike[str], path: object = "repaired.json"
    ) -> FittedSystem:
        """Parse the text from `to_json`; error messages name `path`.

        A simulator given as its file, FILE.py, is run only if its fingerprint is that of the text. Raises FileError if
        the text is damaged, has another format, or belongs to another simulator.
        """
        document = parse_json_file_text(str(path), text, _WHAT)
        found = document.get("format") if isinstance(document, dict) else None
        if found == "sensor/1":
            raise FileError(path, "the model of a light sensor", f"{_WHAT}; for a sensor leave --simulator out")
        if found != FORMAT:
            raise FileError(path, f"format {found!r}", f"{FORMAT!r}: {_WHAT}")
        try:
            own = document["simulator"]
            if not isinstance(simulator, Simulator):
                file = Path(simulator)
                source = read_text(file, "a Python file that describes a simulator")
                _require_fingerprint(fingerprint_of_text(source), file.name, own, path)
                simulator = run_simulator_text(source, file)
            fitted_to, here = f"{own['reading']} ({own['unit']})", f"{simulator.reading} ({simulator.unit})"
            if fitted_to != here:  # simulators made in Python have no fingerprint
                raise FileError(path, f"fitted to {fitted_to}", f"a model of {here}, as the simulator predicts")
            _require_fingerprint(simulator.fingerprint, simulator.source, own, path)
            samples, bound = np.array(document["samples"], dtype=np.float64), document["bound_about"]
            known = bound and StoredFit(
                RunTable({k: _column_from_json(v) for k, v in bound["columns"].items()}, bound["time"], bound["run"]),
                _column_from_json(bound["predicted"]),
                float(bound["sd"]),
                {name: _column_from_json(values) for name, values in bound["states"].items()},
                tuple(bound["held"]),
            )
            return cls(
                simulator,
                names=tuple(each["name"] for each in document["parameters"]),
                samples=samples,
                noise_sd=np.array(document["noise"]["sd"], dtype=np.float64),
                effects=tuple(document["effects"]),
                absent={name: np.isin(np.arange(len(samples)), rows) for name, rows in document["absent"].items()},
                level=(float(document["level"][0]), float(document["level"][1])),
                max_step=math.inf if own["max_step"] is None else float(own["max_step"]),
                stiff=bool(own["stiff"]),
                known=known,
                best=tuple(float(value) for value in document.get("mode", {}).values()),
                recording=str(document["recording"]["fingerprint"]),
                source=str(document["recording"]["source"]),
                notes=tuple(document["notes"]),
                version=str(document["version"]),
            )
        except FileError:
            raise
        except (KeyError, IndexError) as error:
            raise FileError(path, f"no entry {error}", f"every entry of {_WHAT}") from error
        except Exception as error:  # effects of a damaged recording, bound to it again, may raise anything
            raise FileError(
                path, f"contents that do not fit together ({message_of(error, kind=False)})", f"undamaged: {_WHAT}"
            ) from error


def _require_fingerprint(here: str, source: str, own: Mapping[str, Any], path: object) -> None:
    if own["fingerprint"] != here:
        found = f"fitted with {own['source']} of fingerprint {own['fingerprint']}"
        raise FileError(path, found, f"that file unchanged; {source} has {here}: diagnose or fit again")


def read_fitted_system(path: str | os.PathLike[str], simulator: Simulator | str | os.PathLike[str]) -> FittedSystem:
    """Read repaired.json, calibrated.json or fitted.json, for the simulator that it was made with.

    A simulator given as its file, FILE.py, is run only if it is unchanged. Raises FileError if the file is missing or
    damaged, or was made with another simulator.
    """
    return FittedSystem.from_json(read_text(Path(path), _WHAT), simulator, path)


def write_fitted_system(fitted: FittedSystem, path: str | os.PathLike[str]) -> None:
    """Write a fitted simulator (repaired.json, calibrated.json, fitted.json) atomically."""
    require_fitted_system(fitted)
    write_text_atomically(path, fitted.to_json())


def require_fitted_system(fitted: object) -> None:
    """Raise ParameterError unless `fitted` is a FittedSystem; the message says how to obtain one."""
    made_by = "repaired_of(diagnosis), calibrated_of(diagnosis) or fit_simulator(...).fitted"
    allowed = f"a FittedSystem: {made_by}, of probewise.diagnosis"
    if isinstance(getattr(fitted, "fitted", None), FittedSystem):
        allowed = f"a FittedSystem: take its .fitted, this is the {type(fitted).__name__}"
    require_kind("fitted", fitted, FittedSystem, allowed)


def _column_to_json(values: NDArray[Any]) -> list[Any]:
    if values.dtype != np.float64:
        return [*map(str, values.tolist())]
    return [value if math.isfinite(value) else None for value in values.tolist()]


def _column_from_json(values: list[Any]) -> NDArray[Any]:
    if any(isinstance(value, str) for value in values):
        return np.array(values, dtype=np.str_)
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def samples_csv(fitted: FittedSystem) -> str:
    """Return the posterior samples as CSV text: a row per sample; a column per parameter, then `noise_sd`."""
    columns = {name: fitted.samples[:, k] for k, name in enumerate(fitted.names)}
    columns["noise_sd"] = fitted.noise_sd
    return csv_text({name: [number_text(value) for value in values] for name, values in columns.items()})
