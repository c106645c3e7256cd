"""A fitted sensor and its file, sensor.json, which prediction, robot and diagnosis read."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from probewise._arrays import BoolArray, FloatArray
from probewise._kinds import checked_path, require_kind
from probewise._posterior_samples import NamedSamples, interval_table_lines
from probewise._version import __version__
from probewise.calibration.fields import QuantitySummary, ScanNoise, posterior_mean_ssf_field, ssf_quantities
from probewise.calibration.priors import PriorRow
from probewise.effects import EFFECTS, OTHER_FORMS, Extent, Origin
from probewise.effects.noise import noise_sd
from probewise.effects.optics import edge_shadow, edge_shadow_of_patterns
from probewise.effects.reference import ZERO
from probewise.errors import FileError, ProbewiseError, printable, require, shown
from probewise.recordings import Instrumentation, parse_json_file_text, read_text, write_text_atomically
from probewise.scene import KnownScene, Scene
from probewise.sensor import (
    AnyEffect,
    Chain,
    FixedMixture,
    FreeLevels,
    FreeMixture,
    SSFField,
    Stage,
    footprint_of,
    is_free_form,
    merged_mean_mixture,
    mixture_of_field,
    mixture_parameter_names,
)

FORMAT = "sensor/1"
_ALLOWED = "a sensor.json as `probewise calibrate` writes"
# Effects that explain the recording but do not apply to new scans: of single scans or mountings; and another noise sd
# than at an earlier calibration, which the sensor's own sd is.
NOT_OF_NEW_SCANS = frozenset({"height_offset", "scan_angle_error", "scan_misplacement", noise_sd.name})
_FOR_A_FREE_FORM = 4  # Gaussians that approximate a free-form SSF where a mixture is required
# Effects that may be restricted to some patterns.
_BOUND_TO_PATTERNS = frozenset({edge_shadow.name})


@dataclass(frozen=True)
class OrderEvidence:
    """One row of the paper's table: log evidence of an order, its error, and the counts 6 N and 6 N + 2."""

    n_gaussians: int
    log_z: float
    log_z_error: float

    @property
    def n_ssf_parameters(self) -> int:
        """Number of parameters of the SSF, as in the paper's table: 6 N."""
        return 6 * self.n_gaussians

    @property
    def n_parameters(self) -> int:
        """Number of estimated parameters, with I_min and I_max: 6 N + 2."""
        return 6 * self.n_gaussians + 2


@dataclass(frozen=True, eq=False)
class FittedSensor(NamedSamples):
    """A calibrated sensor: posterior samples, noise, and mean SSF field.

    Attributes
    ----------
    names
        Parameter names, one per column of `samples`: a_1 ... C_N, I_min, I_max, then "<effect>.<parameter>".
    samples
        Equally weighted posterior samples, (n_samples, n_params), at least 500. `calibrate` sorts the Gaussians of each
        sample by mass, greatest first.
    n_gaussians
        Order N of the SSF.
    noise_sd
        Noise sd of a reading in a new scan for each sample, pooled over scans, (n_samples,).
    field
        Posterior mean of the SSF fields: the paper's discrete SSF (eq. 9). The robot uses `mean_mixture()`.
    effects
        Names of the effects in the model, in the order of their columns.
    forms, patterns
        By effect, which of its formulas it has (`OTHER_FORMS`), others have the vocabulary's; and the names of the
        patterns to which it is restricted, others act on all.
    absent
        By effect, a mask of the samples without the effect, (n_samples,), where a diagnosis is uncertain whether it is
        present; other effects act in all samples.
    origins
        By effect, the time and position from which it counts, where it was found in a recording far from 0; others
        count from 0.
    scan_noise, fingerprint, source
        Of the recording: noise of each scan, hash of its content, and its file name.
    orders
        Log evidence of every order tried.
    notes
        Reasons to use the result with care; empty if there are none.
    """

    names: tuple[str, ...]
    samples: FloatArray
    n_gaussians: int
    noise_sd: FloatArray
    field: SSFField
    instrumentation: Instrumentation
    effects: tuple[str, ...] = ()
    forms: Mapping[str, str] = dataclasses.field(default_factory=dict)
    patterns: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    absent: Mapping[str, BoolArray] = dataclasses.field(default_factory=dict)
    origins: Mapping[str, Origin] = dataclasses.field(default_factory=dict)
    scan_noise: tuple[ScanNoise, ...] = ()
    fingerprint: str = ""
    source: str = ""
    orders: tuple[OrderEvidence, ...] = ()
    priors: tuple[PriorRow, ...] = ()
    notes: tuple[str, ...] = ()
    version: str = __version__

    def __post_init__(self) -> None:
        for name in self.effects:
            require(name in EFFECTS, "effects", name, ", ".join(sorted(EFFECTS)))
        can_have: dict[str, Callable[[str], bool]] = {
            "forms": lambda name: (name, self.forms.get(name)) in OTHER_FORMS,
            "patterns": _BOUND_TO_PATTERNS.__contains__,
            "origins": lambda name: bool(getattr(EFFECTS[name], "counts", "")),
        }
        for key, able in can_have.items():
            stray = [name for name in getattr(self, key) if name not in self.effects or not able(name)]
            able_ones = [name for name in self.effects if able(name)]
            require(not stray, key, next(iter(stray), ""), f"effects of the model among {able_ones}")
        self.require_sound_samples()
        n, most = self.n_gaussians, len(self.names) // 6
        require(1 <= n <= most, "n_gaussians", n, f"1 to {most}, for {len(self.names)} parameters")
        wanted = (*mixture_parameter_names(n), "I_min", "I_max")
        require(self.names[: len(wanted)] == wanted, "names", self.names, f"{wanted} first, for n_gaussians = {n}")
        owners = {name.partition(".")[0] for name in self.names[len(wanted) :]}
        columns = {f"{effect.name}.{p}" for effect in self.effects_on_new_scans for p in effect.prior.names}
        allowed = f"after I_max the columns of the effects {self.effects}: {sorted(columns)}"
        require(owners == set(self.effects) and columns <= set(self.names), "names", self.names, allowed)
        a, b, c = (self.samples[:, k : 6 * self.n_gaussians : 6] for k in (3, 4, 5))
        det = np.where(a > 0, a * b - c * c, -np.inf)
        require((det > 0).all(), "A B - C^2 of a Gaussian", float(det.min()), "greater than 0 in every sample")

    @property
    def effects_on_new_scans(self) -> tuple[AnyEffect, ...]:
        """The effects that also apply to new scans, as objects: all but those in `NOT_OF_NEW_SCANS`."""
        return tuple(self._build_effect(name) for name in self.effects if name not in NOT_OF_NEW_SCANS)

    def _build_effect(self, name: str) -> AnyEffect:
        if name in self.patterns:
            return edge_shadow_of_patterns(edge_shadow, Extent.usual(ZERO), self.patterns[name])
        kind = OTHER_FORMS[name, self.forms[name]] if name in self.forms else EFFECTS[name]
        return kind(self.origins.get(name, ZERO))

    @property
    def samples_for_new_scans(self) -> FloatArray:
        """Samples of the parameters of SSF, levels and effects, (n_samples, n), without effects of single scans."""
        return self.samples[:, [self.names.index(name) for name in self.chain(KnownScene({})).names]]

    def chain(self, scene: Scene) -> Chain:
        """Build the model that predicts new readings over a scene, with the effects that apply to new scans.

        Its parameters are the columns of `samples_for_new_scans`; those of a scene come before the effects'. Readings
        of a plan that declares another height than the calibration are predicted at the plan's.
        """
        return Chain(
            FreeMixture(self.n_gaussians),
            FreeLevels(),
            scene,
            self.effects_on_new_scans,
            calibrated_height_mm=self.instrumentation.height_mm,
        )

    @property
    def is_free_form(self) -> bool:
        """Whether its SSF is a free form (`probewise.sensor.ssf`) rather than a mixture of a few Gaussians."""
        return is_free_form(self.samples[:, : 6 * self.n_gaussians])

    def mean_mixture(self, n_gaussians: int | None = None) -> FixedMixture:
        """Return the mean SSF as a `FixedMixture` of at most `n_gaussians` Gaussians, merged from all samples.

        By default one for N = 1, else 4 N; of a free form always four, fitted to its field.
        """
        n = self.n_gaussians
        if self.is_free_form:
            return mixture_of_field(self.field, n_gaussians=_FOR_A_FREE_FORM)
        most = (1 if n == 1 else 4 * n) if n_gaussians is None else n_gaussians
        return merged_mean_mixture(footprint_of(self.samples[:, : 6 * n], n), n_gaussians=most)

    def with_leading_effects(self) -> FittedSensor:
        """Return the sensor with the most probable combination of effects, where a diagnosis left several possible.

        The samples of that combination are repeated to the original number. If there is only one combination, return
        the sensor itself.
        """
        if not self.absent:
            return self
        without = np.stack(list(self.absent.values()), axis=1)
        sets, which, counts = np.unique(without, axis=0, return_inverse=True, return_counts=True)
        rows = np.resize(np.flatnonzero(which.reshape(-1) == np.argmax(counts)), len(self.samples))
        left_out = {name for name, out in zip(self.absent, sets[np.argmax(counts)], strict=True) if out}
        kept = [k for k, name in enumerate(self.names) if name.partition(".")[0] not in left_out]
        samples = self.samples[rows][:, kept]
        of_effects: dict[str, Any] = {
            key: {name: own for name, own in getattr(self, key).items() if name not in left_out}
            for key in ("forms", "patterns", "origins")
        }
        return dataclasses.replace(
            self,
            names=tuple(self.names[k] for k in kept),
            samples=samples,
            noise_sd=self.noise_sd[rows],
            field=posterior_mean_ssf_field(samples[:100], self.n_gaussians, pixel_mm=self.field.pixel_mm),
            effects=tuple(name for name in self.effects if name not in left_out),
            **of_effects,
            absent={},
        )

    def ssf_quantities(self) -> tuple[QuantitySummary, ...]:
        """Summarise the SSF by centre, widths and angle, and each Gaussian too, unless the SSF is a free form."""
        return ssf_quantities(self.samples, self.n_gaussians, each=not self.is_free_form)

    def summary(self) -> str:
        """Describe the sensor in plain text."""
        unit, n = self.instrumentation.unit, self.n_gaussians
        # Twenty Gaussians would not be readable.
        bending = frozenset(mixture_parameter_names(n)[6:] if self.is_free_form else ())
        form = "an SSF of free form" if bending else f"{n} Gaussian{'s' if n > 1 else ''}"
        lines = [
            f"{form}, {len(self.samples)} posterior samples"
            + (
                f", with {', '.join(self._effect_with_share_of_samples(name) for name in self.effects)}"
                if self.effects
                else ""
            ),
            f"noise of a new reading  {self.noise_sd.mean():.4g} ± {self.noise_sd.std():.2g} {unit}",
        ]
        if self.orders:
            lines.append("Gaussians  parameters  of the SSF   log evidence")
            best = max(self.orders, key=lambda order: order.log_z)
            lines += [
                f"{o.n_gaussians:>9}  {o.n_parameters:>10}  {o.n_ssf_parameters:>10}  "
                f"{o.log_z:>10.2f} ± {o.log_z_error:.2f}{'  most probable' if o is best else ''}"
                for o in self.orders
            ]
        told = [name for name in self.names if name not in bending]
        median, interval = self.median(), self.interval()
        rows = [(q.name, q.median, q.interval95) for q in self.ssf_quantities()]
        rows += [(name, median[name], interval[name]) for name in told]
        return "\n".join([*lines, *interval_table_lines(rows), *(f"note: {note}" for note in self.notes)])

    def _effect_with_share_of_samples(self, effect: str) -> str:
        share = 1.0 - self.absent[effect].mean() if effect in self.absent else 1.0
        return effect if share == 1.0 else f"{effect} in {share:.0%} of them"

    def to_json(self) -> str:
        """Return the sensor as strict JSON, format "sensor/1"."""
        mean, sd, rows = self.mean(), self.sd(), self.rows_by_parameter("mean", "sd", "median", "interval95")
        acting = [effect.name for effect in self.effects_on_new_scans if effect.stage is Stage.NOISE]
        known = [name.replace("_", " ") for name in acting]
        plain = "Gaussian, one sd pooled over scans; one value per sample"
        document = {
            "format": FORMAT,
            "version": self.version,
            "recording": {"fingerprint": self.fingerprint, "source": printable(self.source)},
            "instrumentation": asdict(self.instrumentation),
            "n_gaussians": self.n_gaussians,
            "parameters": [{"name": row["name"], "unit": self.unit_of_parameter(row["name"]), **row} for row in rows],
            "ssf": [asdict(quantity) for quantity in self.ssf_quantities()],
            "levels": {n: {"mean": mean[n], "sd": sd[n]} for n in ("I_min", "I_max")},
            "effects": list(self.effects),
            **({"forms": dict(self.forms)} if self.forms else {}),
            "patterns": {name: list(patterns) for name, patterns in self.patterns.items()},
            "origins": {name: asdict(origin) for name, origin in self.origins.items()},
            "absent": {name: np.flatnonzero(without).tolist() for name, without in self.absent.items()},
            "noise": {
                "model": f"{plain}; with {' and '.join(known)}" if known else f"independent {plain}",
                "mean": float(self.noise_sd.mean()),
                "scans": [asdict(scan) for scan in self.scan_noise],
                "sd": self.noise_sd.tolist(),
            },
            "orders": [
                asdict(o) | {"n_ssf_parameters": o.n_ssf_parameters, "n_parameters": o.n_parameters}
                for o in self.orders
            ],
            "priors": [asdict(row) for row in self.priors],
            "notes": list(self.notes),
            "field": {
                "pixel_mm": float(self.field.pixel_mm),
                "origin_mm": [float(x) for x in self.field.origin_mm],
                "rows": "from low to high y', columns from low to high x'",
                "values": self.field.values.tolist(),
            },
            "samples": self.samples.tolist(),
        }
        return json.dumps(document, allow_nan=False) + "\n"

    @classmethod
    def from_json(cls, text: str, path: str | os.PathLike[str] = "sensor.json") -> FittedSensor:
        """Parse the text written by `to_json`; `path` is its name in error messages.

        Raises
        ------
        FileError
            If the text is damaged, incomplete, or of another format or version.
        """
        document = parse_json_file_text(path, text, _ALLOWED)
        found = document.get("format") if isinstance(document, dict) else None
        if found != FORMAT:
            raise FileError(
                path, f"format {shown(found)}", f"{FORMAT!r}; calibrate the recording anew with this version"
            )
        read = _read(path, {"forms": {}, "patterns": {}, "absent": {}, "origins": {}} | document, _FORM)
        samples, field = read["samples"], read["field"]
        try:
            u_mm, v_mm = field["origin_mm"]
            return cls(
                names=tuple(each["name"] for each in read["parameters"]),
                samples=samples,
                n_gaussians=read["n_gaussians"],
                noise_sd=read["noise"]["sd"],
                field=SSFField(field["values"], field["pixel_mm"], (float(u_mm), float(v_mm))),
                instrumentation=Instrumentation(**read["instrumentation"]),
                effects=read["effects"],
                forms=read["forms"],
                patterns=read["patterns"],
                absent={name: _mask_of_rows(rows, len(samples)) for name, rows in read["absent"].items()},
                origins={name: Origin(**place) for name, place in read["origins"].items()},
                scan_noise=tuple(ScanNoise(**each) for each in read["noise"]["scans"]),
                **read["recording"],
                orders=tuple(OrderEvidence(**each) for each in read["orders"]),
                priors=tuple(PriorRow(**each) for each in read["priors"]),
                notes=read["notes"],
                version=read["version"],
            )
        except (ProbewiseError, ValueError, TypeError) as error:
            raise FileError(
                path, f"inconsistent contents ({error})", "an undamaged sensor.json; calibrate the recording anew"
            ) from error

    def unit_of_parameter(self, name: str) -> str:
        """Return the unit of a parameter, by its name; "" where it is unknown."""
        if "." in name:
            owner, _, parameter = name.partition(".")
            effect = EFFECTS[owner]() if owner in EFFECTS else None
            return "" if effect is None else dict(zip(effect.prior.names, effect.units, strict=True)).get(parameter, "")
        if name in ("I_min", "I_max"):
            return self.instrumentation.unit
        return {"a": "1", "u": "mm", "v": "mm"}.get(name[0], "mm^-2")


def write_sensor(sensor: FittedSensor, path: str | os.PathLike[str]) -> None:
    """Write a fitted sensor to the file `path` (sensor.json), atomically; FileError if it cannot be written."""
    require_fitted_sensor(sensor)
    path = checked_path("path", path)
    write_text_atomically(path, sensor.to_json())


def read_sensor(path: str | os.PathLike[str]) -> FittedSensor:
    """Read a fitted sensor from the file `path` (sensor.json).

    FileError if the file is missing, damaged, or of another format.
    """
    path = checked_path("path", path, "the name of a sensor.json file; a FittedSensor needs no reading")
    return FittedSensor.from_json(read_text(path, _ALLOWED), path)


def require_fitted_sensor(sensor: object, more: str = "") -> None:
    """Raise ParameterError unless `sensor` is a FittedSensor; the message says how to get one, and `more`."""
    allowed = "a FittedSensor: read_sensor('sensor.json') of probewise.calibration, or the .sensor of a Calibration"
    if isinstance(sensor, str) or hasattr(sensor, "__fspath__"):
        allowed += "; of a simulator read_fitted_system('fitted.json', simulator) of probewise.systems"
    if isinstance(getattr(sensor, "sensor", None), FittedSensor):
        allowed = f"a FittedSensor: take its .sensor, this is the {type(sensor).__name__}"
    elif hasattr(sensor, "repaired"):
        allowed = "a FittedSensor: of a diagnosis found it is found.repaired.fitted_sensor(found.recording, rng=rng)"
    elif hasattr(sensor, "fitted_sensor"):
        allowed = "a FittedSensor: take its .fitted_sensor(recording, rng=rng), of the recording that was diagnosed"
    require_kind("sensor", sensor, FittedSensor, f"{allowed}{', ' if more else ''}{more}")


_NUMBERS, _ROWS = 1, 2  # forms of arrays, by their dimensions
_FORM = {
    "version": str,
    "recording": {"fingerprint": str, "source": str},
    "instrumentation": {
        **dict.fromkeys(("unit", "sensor", "description"), str),
        **dict.fromkeys(("min", "max", "step", "height_mm"), None),
        "controls": [str],
    },
    "n_gaussians": int,
    "parameters": [{"name": str}],
    "effects": [str],
    "forms": {...: str},
    "patterns": {...: [str]},
    "origins": {...: {...: float}},
    "absent": {...: _NUMBERS},
    "noise": {"sd": _NUMBERS, "scans": [{"scan": str, "n_readings": int, "mean": float, "sd": float}]},
    "orders": [{"n_gaussians": int, "log_z": float, "log_z_error": float}],
    "priors": [dict.fromkeys(("parameter", "unit", "distribution", "reason"), str)],
    "notes": [str],
    "field": {"pixel_mm": float, "origin_mm": _NUMBERS, "values": _ROWS},
    "samples": _ROWS,
}
"""What a sensor.json must hold: objects by key (`...`: any), lists, arrays, texts, numbers; None: a number or null."""


def _read(path: object, value: Any, form: Any, place: str = "") -> Any:
    """Return what a parsed document holds of `form`; FileError names the first place that differs."""
    if isinstance(form, dict):
        if isinstance(value, dict):
            keys = value if ... in form else form
            missing = [key for key in keys if key not in value]
            if missing:
                lacking = f"{place}{'.' if place else ''}{missing[0]}"
                raise FileError(path, f"no {lacking}", "every entry that `probewise calibrate` writes")
            places = {key: f"{place}{'.' if place else ''}{key}" for key in keys}
            return {key: _read(path, value[key], form.get(key, form.get(...)), at) for key, at in places.items()}
        allowed = "an object"
    elif isinstance(form, list):
        if isinstance(value, list):
            return tuple(_read(path, each, form[0], place) for each in value)
        allowed = "a list"
    elif form in (_NUMBERS, _ROWS):
        allowed = f"finite numbers in {form} equal dimensions"
        with contextlib.suppress(TypeError, ValueError):
            array = np.array(value, dtype=np.float64)
            if array.ndim == form and np.isfinite(array).all():
                return array
    elif form in (str, int):
        allowed = "a text" if form is str else "a whole number"
        if isinstance(value, form) and not isinstance(value, bool):
            return value
    else:
        allowed = "a finite number"
        if form is None and value is None:
            return None
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    raise FileError(path, f"{place} is {shown(value)}", allowed)


def _mask_of_rows(rows: FloatArray, n: int) -> BoolArray:
    require(np.isin(rows, np.arange(n)).all(), "absent", rows.tolist(), f"whole numbers from 0 to {n - 1}")
    return np.isin(np.arange(n), rows)
