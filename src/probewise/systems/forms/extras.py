"""A user's own effects: an extra parameter of the simulator, with a null value at which it has no effect."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from probewise._arrays import FloatArray
from probewise.sensor import Stage
from probewise.systems.forms.about import About
from probewise.systems.forms.form import Act, Form, Say, with_unit

_N_VALUES = 9
_UNSEEN = 1e-7  # of the noise


def forms_of_extras(about: About) -> Iterator[Form]:
    """Bind each extra effect of a file that changes the readings somewhere in its prior."""
    for name, extra in about.system.simulator.extra.items():
        values = np.asarray(extra.prior.from_unit((np.arange(_N_VALUES) + 0.5) / _N_VALUES))
        values = values[values != extra.null]
        act = _set_to(name)
        rms = about.rms(Stage.PARAMETER, act, values[:, None])
        seen = np.isfinite(rms) & (rms > _UNSEEN)
        if seen.any():
            yield Form(
                name,
                Stage.PARAMETER,
                {"value": extra.prior},
                ("",),
                ("level", "time", "row"),
                act,
                values[seen][:, None, None],
                (),
                _sentence_with_value(extra.says),
                absent={0: extra.null},
            )


def _set_to(name: str) -> Act:
    def act(value: Mapping[str, FloatArray], theta: FloatArray, table: object) -> dict[str, FloatArray]:
        return {**value, name: theta[:, :1]}

    return act


def _sentence_with_value(says: str) -> Say:
    return lambda mean, sd: says.replace("{value}", with_unit(mean[0], sd[0], ""))
