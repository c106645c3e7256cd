"""A user's own effects: an extra parameter of the simulator, with a null value at which it has no effect."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.sensor import Stage
from probewise.systems.forms.about import ReferenceFit
from probewise.systems.forms.form import Act, Form, Say

_N_VALUES = 9
_UNSEEN = 1e-7  # of the noise


def forms_of_extras(about: ReferenceFit) -> Iterator[Form]:
    """Yield a form for each extra effect of a file that changes the readings somewhere in its prior."""
    for name, extra in about.system.simulator.extra.items():
        values = np.asarray(extra.prior.from_unit((np.arange(_N_VALUES) + 0.5) / _N_VALUES))
        values = values[values != extra.null]
        act = _parameter_setter(name)
        rms = about.rms_change_in_sds(Stage.PARAMETER, act, values[:, None])
        seen = np.isfinite(rms) & (rms > _UNSEEN)
        if seen.any():
            yield Form(
                name,
                Stage.PARAMETER,
                marginals={"value": extra.prior},
                units=("",),
                covariates=("level", "time", "row"),
                act=act,
                entries=values[seen][:, None, None],
                amplitudes=(),
                says=_sentence_writer(extra.says),
                absent={0: extra.null},
            )


def _parameter_setter(name: str) -> Act:
    """Return the function that sets a parameter of the simulator to the form's value."""

    def act(value: Mapping[str, FloatArray], theta: FloatArray, table: object) -> dict[str, FloatArray]:
        return {**value, name: theta[:, :1]}

    return act


def _sentence_writer(says: str) -> Say:
    return lambda mean, sd: says.replace("{value}", value_with_sd(mean[0], sd[0], ""))
