"""Every effect of the vocabulary, built for one system."""

from __future__ import annotations

from probewise.proof.systems.forms.form import Form
from probewise.proof.systems.forms.inputs import forms_of_inputs
from probewise.proof.systems.forms.inside import forms_of_parameters, forms_of_rates
from probewise.proof.systems.forms.readings import forms_of_readings
from probewise.proof.systems.forms.true_system import TrueSystem

FAMILIES = (
    "offset_drift",
    "offset_step",
    "offset_per_run",
    "gain_drift",
    "gain_step",
    "gain_per_run",
    "nonlinearity",
    "saturation",
    "hysteresis",
    "lag",
    "delay",
    "settling",
    "interference",
    "sensitivity",
    "input_offset",
    "input_gain",
    "input_delay",
    "input_saturation",
    "dead_zone",
    "periodic_error",
    "backlash",
    "clock_drift",
    "drifts",
    "steps",
    "differs",
    "depends",
    "damping",
    "drag",
    "friction",
    "forcing",
    "periodic_forcing",
    "cubic",
    "quadratic",
    "coupling",
    "limit",
)
"""Names of forms without targets."""


def forms_of(true: TrueSystem) -> list[Form]:
    """Return every form of the vocabulary, once for each of its possible targets in this system."""
    of_rates = forms_of_rates(true) if true.kind.defines_states else ()
    return [*forms_of_readings(true), *forms_of_inputs(true), *forms_of_parameters(true), *of_rates]
