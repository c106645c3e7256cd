"""The settings of an instrument as a user gives them: one knob, several, or knobs by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from probewise._arrays import IntArray
from probewise.errors import ParameterError

Column: TypeAlias = NDArray[Any]

_ALLOWED = (
    "one knob: numbers or names (n,); several: numbers (n, n_knobs), a row for each setting; or a dict of columns (n,) "
    "by name, all of one length"
)


@dataclass(frozen=True, eq=False)
class Settings:
    """Settings as columns (n,) by name; `form` is how the user gave them, and how user and model get them back.

    `form`: "one" knob, an array (n,); "several" knobs, an array (n, n_knobs); or knobs by "name", a dict of columns.
    """

    columns: Mapping[str, Column]
    form: str

    @classmethod
    def of(cls, given: Any) -> Settings:
        """Read settings in any of their forms; ParameterError for anything else."""
        if isinstance(given, Settings):
            return given
        if isinstance(given, Mapping):
            columns = {str(name): _checked_column(f"settings[{name!r}]", values) for name, values in given.items()}
            if not columns or len({len(column) for column in columns.values()}) != 1:
                sizes = {name: len(column) for name, column in columns.items()}
                raise ParameterError("settings", sizes, _ALLOWED)
            return cls(columns, "name")
        try:
            array = np.asarray(given)
        except ValueError as error:
            raise ParameterError("settings", given, _ALLOWED) from error
        if array.ndim == 2 and array.shape[1] >= 1 and len(array):
            _require_texts_given("settings", given, array)
            columns = {str(k): _checked_column("settings", column) for k, column in enumerate(array.T)}
            return cls(columns, "several")
        return cls({"setting": _checked_column("settings", array)}, "one")

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def take(self, rows: IntArray) -> Settings:
        """Return the settings with these indices."""
        return Settings({name: column[rows] for name, column in self.columns.items()}, self.form)

    def joined(self, other: Settings) -> Settings:
        """Return these settings, then `other`."""
        return Settings({n: np.concatenate([c, other.columns[n]]) for n, c in self.columns.items()}, self.form)

    def in_model_form(self, columns: Mapping[str, Column]) -> Any:
        """Return `columns` in the form of these settings; several knobs as (n_knobs, n), to be unpacked."""
        if self.form == "one":
            return columns["setting"]
        return np.stack(list(columns.values())) if self.form == "several" else dict(columns)

    def __getitem__(self, row: int) -> Any:
        """Return one setting: a number or a name, an array (n_knobs,), or a dict by name."""
        own = {name: _plain_value(column[row]) for name, column in self.columns.items()}
        if self.form == "one":
            return own["setting"]
        return np.array(list(own.values())) if self.form == "several" else own

    def checked_setting(self, setting: Any) -> Settings:
        """Parse one setting given in the form of `self[row]` as Settings of length 1; it need not be one of these.

        ParameterError if it is not of that form.
        """
        if self.form == "name":
            if not isinstance(setting, Mapping) or setting.keys() != self.columns.keys():
                raise ParameterError("setting", setting, f"a dict of {', '.join(self.columns)}")
            columns = {name: [setting[name]] for name in self.columns}
        elif self.form == "one":
            columns = {"setting": [setting]}
        else:
            if np.shape(setting) != (len(self.columns),):
                raise ParameterError("setting", setting, f"{len(self.columns)} numbers, one for each knob")
            columns = {name: [value] for name, value in zip(self.columns, setting, strict=True)}
        made = {name: _checked_column("setting", values) for name, values in columns.items()}
        for name, column in made.items():
            if (column.dtype.kind == "U") != (self.columns[name].dtype.kind == "U"):
                kind = "a name" if self.columns[name].dtype.kind == "U" else "a number"
                raise ParameterError("setting", setting, f"{kind}, as in settings")
        return Settings(made, self.form)


def _checked_column(name: str, values: Any) -> Column:
    """Convert the values of one knob to a read-only column of finite numbers or of names, (n,)."""
    array = np.asarray(values)
    if array.ndim != 1 or not array.size or array.dtype.kind not in "biufU":
        raise ParameterError(name, values, _ALLOWED)
    _require_texts_given(name, values, array)
    if array.dtype.kind != "U":
        array = array.astype(np.float64)
        if not np.isfinite(array).all():
            raise ParameterError(name, float(array[~np.isfinite(array)][0]), "finite numbers")
    array = array.copy()
    array.flags.writeable = False
    return array


def _require_texts_given(name: str, values: Any, array: Column) -> None:
    """Raise ParameterError where `array`, of `values`, has numbers among names, which NumPy has made texts."""
    if array.dtype.kind == "U" and not all(isinstance(one, str) for one in np.asarray(values, dtype=object).flat):
        raise ParameterError(name, values, _ALLOWED)


def _plain_value(value: Any) -> float | str:
    return str(value) if isinstance(value, str) else float(value)
