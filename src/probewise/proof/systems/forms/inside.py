"""Forms inside a system: parameters that vary, and terms missing from the rates of a law."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from probewise.proof.systems.forms import modulations
from probewise.proof.systems.forms.form import Form
from probewise.proof.systems.forms.modulations import Modulation, start_values_of_single_member
from probewise.proof.systems.forms.true_system import TrueSystem

_N_WAVES = 20


def forms_of_parameters(true: TrueSystem) -> Iterator[Form]:
    """Yield the forms by which each parameter may vary: in a step, a drift, from run to run, with a column."""
    common = {"steps": modulations.step_at_change_point(true)}
    if true.table.time is not None:
        common["drifts"] = modulations.linear_drift(true)
    for name in true.kind.priors:
        own = dict(common)
        if name not in true.kind.per_run and true.kind.run is not None and len(true.table.rows_by_run) > 1:
            own["differs"] = modulations.value_per_run(true)
        if name in true.kind.per_run and true.kind.law is not None:
            own = {}  # initial values do not vary within a run
        for kind, how in own.items():
            yield varying_parameter_form(true, f"{kind}:{name}", name, how)
        if not (name in true.kind.per_run and true.kind.law is not None):
            for column in true.varying_columns:
                yield varying_parameter_form(
                    true, f"depends:{name}:{column}", name, modulations.proportional_to_column(true, column)
                )


def varying_parameter_form(true: TrueSystem, name: str, target: str, how: Modulation) -> Form:
    """Return the form `name` by which the parameter `target` varies as the modulation `how`, e.g. a step."""
    first = 0.003 * float(np.abs(true.parameters[target]).mean()) / how.reach
    return Form(
        name,
        "parameter",
        act=how.value_at,
        of_amplitude=how.of_amplitude,
        draw=how.draw,
        bank=how.bank(0.1 * first),
        start_values=how.start_values,
        steps=how.steps(first),
        first=first,
        limit=200 * first,
        covariates=how.covariates,
        target=target,
        uses=how.uses,
        breaks=how.breaks,
    )


def rate_term_form(
    true: TrueSystem,
    name: str,
    state: str,
    push: Callable[[Any, Any, Any], Any],
    size: float,
    covariates: tuple[str, ...],
    uses: tuple[str, ...] = (),
    shape: str = "",
    signed: bool = True,
) -> Form:
    """Return the form of a term a push(states, now, parameters) in the rate of a state; `size`: push's magnitude."""
    first = 0.01 * true.rms_rate(state) / size
    return Form(
        name,
        "rate",
        act=lambda s, now, v: v["a"] * push(s, now, v),
        of_amplitude=lambda a, drawn: {"a": a},
        draw=lambda rng: {},
        bank=[[{"a": 0.1 * first}]],
        start_values=start_values_of_single_member,
        steps={"a": first},
        first=first,
        limit=300 * first,
        covariates=covariates,
        target=state,
        uses=uses,
        shape=shape,
        signed=signed,
    )


def forms_of_rates(true: TrueSystem) -> Iterator[Form]:
    """Yield the terms that may be missing from the rate of each state, dry friction and an upper bound included."""
    if true.kind.law is None:
        return
    for state, values in true.states.items():
        size = float(np.abs(values).max())
        own = (f"state:{state}", "time")
        yield rate_term_form(
            true, f"damping:{state}", state, _make_term_of_state(state, lambda r: -r), size, own, signed=False
        )
        drags = _make_term_of_state(state, lambda r: -np.abs(r) * r)
        yield rate_term_form(true, f"drag:{state}", state, drags, size**2, own, signed=False)
        yield rate_term_form(
            true, f"forcing:{state}", state, _make_term_of_state(state, lambda r: 1.0 + 0.0 * r), 1.0, ("time", *own)
        )
        for other, there in true.states.items():
            most = float(np.abs(there).max())
            seen = (f"state:{other}", "time")
            yield rate_term_form(
                true, f"cubic:{state}:{other}", state, _make_term_of_state(other, lambda r: -(r**3)), most**3, seen
            )
            yield rate_term_form(
                true, f"quadratic:{state}:{other}", state, _make_term_of_state(other, lambda r: -(r**2)), most**2, seen
            )
            if other != state:
                yield rate_term_form(
                    true, f"coupling:{state}:{other}", state, _make_term_of_state(other, lambda r: -r), most, seen
                )
        yield _periodic_forcing_form(true, state)
        yield from _friction_and_bound_forms(true, state)


def _make_term_of_state(state: str, term: Callable[[Any], Any]) -> Callable[[Any, Any, Any], Any]:
    """Return a `push` for `rate_term_form` that is a function `term` of one state."""
    return lambda s, now, v: term(s[state])


def _periodic_forcing_form(true: TrueSystem, state: str) -> Form:
    how = modulations.sinusoid_in_time(true, _N_WAVES)
    first = 0.02 * true.rms_rate(state)
    return Form(
        f"periodic_forcing:{state}",
        "rate",
        act=lambda s, now, v: how.value_at(now, v),
        of_amplitude=how.of_amplitude,
        draw=how.draw,
        bank=how.bank(0.1 * first),
        start_values=how.start_values,
        steps=how.steps(first),
        first=first,
        limit=100 * first,
        covariates=how.covariates,
        signed=False,
        target=state,
    )


def _friction_and_bound_forms(true: TrueSystem, state: str) -> Iterator[Form]:
    speed, values = true.rms_rate(state), true.states[state]
    sizes = speed * np.geomspace(1e-3, 0.3, 4)
    yield Form(
        f"friction:{state}",
        "rate",
        act=lambda s, now, v: 0.0,
        of_amplitude=lambda a, drawn: {"a": a},
        draw=lambda rng: {},
        bank=[[{"a": float(size)}] for size in sizes],
        start_values=lambda group, amounts: dict(group[0]),
        steps={"a": 0.01 * speed},
        first=0.02 * speed,
        limit=2 * speed,
        covariates=(f"state:{state}", "level"),
        signed=False,
        target=state,
        sticks=True,
    )
    low, high = float(values.min()), float(values.max())
    levels = high - (high - low) * np.array([0.01, 0.04, 0.12, 0.3])
    yield Form(
        f"limit:{state}",
        "rate",
        act=lambda s, now, v: 0.0,
        of_amplitude=lambda a, drawn: {"level": high - a},
        draw=lambda rng: {},
        bank=[[{"level": float(level)}] for level in levels],
        start_values=lambda group, amounts: dict(group[0]),
        steps={"level": 0.01 * (high - low)},
        first=0.05 * (high - low),
        limit=0.6 * (high - low),
        covariates=(f"state:{state}", "level"),
        signed=False,
        target=state,
        stops=True,
    )
