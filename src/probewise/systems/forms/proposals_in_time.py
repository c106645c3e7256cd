"""Proposals in time: a square wave, a wave whose frequency changes, two settlings. They count as out of vocabulary."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from probewise._arrays import FloatArray
from probewise._words import value_with_sd
from probewise.effects.waves import PHASE, sine_and_cosine_entries, starting_point_of_wave
from probewise.priors import LogUniform, Uniform
from probewise.sensor import Stage
from probewise.systems.forms.about import ReferenceFit
from probewise.systems.forms.form import Form, period_with_sd
from probewise.systems.forms.frequencies import frequency_prior, trial_frequencies_in_time
from probewise.systems.forms.origins import origin_in_words, text_rounded_to_spread, time_origin
from probewise.systems.forms.readings import settling_time_prior, time_since_start_of_run
from probewise.systems.table import RunTable

_MOST_SQUARE_WAVES = 160  # periods of a square wave that are tried
_ROWS_OF_A_WAVE = 6  # least rows per period: with fewer a square wave is not told from a sinusoid
_SOFT = 0.5  # steepness of its edges to begin with: at 1 it is nearly a sinusoid
# Mean number of waves in the recording, up to which a wave whose frequency changes is tried, in steps of a half: faster
# ones would need tens of thousands of templates, gigabytes in a long table.
_MOST_SWEPT = 40
_SWEEPS = 1.5  # changes of the frequency that are tried, per wave in the recording: phases to within a radian
_N_SETTLING, _APART = 9, 2  # time constants of two settlings, and how far apart they are in the row of those


def formula_forms_in_time(about: ReferenceFit) -> Iterator[Form]:
    """Yield proposals of a change of the reading in time: square wave, swept wave, two settlings."""
    yield from _square_wave_form(about)
    yield from _swept_wave_form(about)
    yield from _double_settling_form(about)


def _square_wave_form(about: ReferenceFit) -> Iterator[Form]:
    """Yield a shift of the reading during a share of every period: flat tops, and edges of unknown steepness."""
    own, table, origin = about.system.simulator, about.table, time_origin(about.table)
    frequencies = trial_frequencies_in_time(about, _MOST_SQUARE_WAVES, _ROWS_OF_A_WAVE)

    def act(value: FloatArray, theta: FloatArray, rows: RunTable) -> FloatArray:
        a, hz, phase, share, edge = (theta[:, k : k + 1] for k in range(5))
        inside = np.cos(2 * np.pi * (hz * (rows.time_s - origin) + phase)) - np.cos(np.pi * share)
        return np.asarray(value + 0.5 * a * (1 + np.tanh(inside / edge)))

    phases, shares = np.arange(8) / 8 - 0.5, np.array([0.25, 0.5, 0.75])
    grid = np.meshgrid(about.sd, frequencies, phases, shares, _SOFT, indexing="ij")
    entries = np.stack([each.ravel() for each in grid], axis=-1)[:, None, :]
    typical = about.typical_amplitude(Stage.OFFSET, act, entries, about.sd)
    if typical is None:
        return
    entries[:, :, 0] = typical
    since = f"({table.time} - {origin:.12g})" if origin else table.time
    text = f"while |({since} / period + phase) mod 1| < share / 2"
    yield Form(
        f"formula:reading:{own.reading}:{text}",
        Stage.OFFSET,
        marginals={
            "a": about.amplitude_prior(typical),
            "hz": frequency_prior(frequencies),
            "phase": Uniform(-1.0, 1.0),
            "share": Uniform(0.03, 0.97),
            "edge": LogUniform(0.03, 1.0),
        },
        units=(own.unit, f"1/{about.time_unit}", "1", "1", "1"),
        covariates=("time",),
        act=act,
        entries=entries,
        amplitudes=(0,),
        says=lambda mean, sd: (
            f"{own.reading} shifts by {value_with_sd(mean[0], sd[0], own.unit)} during "
            f"{value_with_sd(mean[3], sd[3], '')} of every "
            f"{period_with_sd(mean[1], sd[1], about.time_unit)}: a proposal, not a known effect"
        ),
        expression=f"a {text}",
        counted_from=origin_in_words(table.time, origin, about.time_unit),
    )


def _swept_wave_form(about: ReferenceFit) -> Iterator[Form]:
    """Yield a sinusoid in the reading whose frequency rises or falls linearly along the recording."""
    own, table = about.system.simulator, about.table
    begin, end = float(table.time_s.min()), float(table.time_s.max())
    frequencies = trial_frequencies_in_time(about, 2 * _MOST_SWEPT, _ROWS_OF_A_WAVE, most_waves=_MOST_SWEPT)
    middle, half = 0.5 * (begin + end), 0.5 * (end - begin)

    def act(value: FloatArray, theta: FloatArray, rows: RunTable) -> FloatArray:
        a, hz, sweep, phase = (theta[:, k : k + 1] for k in range(4))
        u = (rows.time_s - middle) / half
        return np.asarray(value + a * np.sin(2 * np.pi * hz * half * (u + 0.5 * sweep * u**2) + phase))

    settings = []
    for hz in frequencies:
        n = 2 * max(int(np.ceil(_SWEEPS * hz * half)), 1)
        settings += [(hz, sweep) for sweep in np.linspace(-1, 1, n)]
    entries = sine_and_cosine_entries(about.sd, *np.transpose(settings))
    typical = about.typical_amplitude(Stage.OFFSET, act, entries, about.sd)
    if typical is None:
        return
    entries[:, :, 0] = typical
    turned = f"2 pi hz (u + sweep u^2 / (2 {half:.4g})) + phase"
    text = f"sin({turned}), u = {table.time} - {text_rounded_to_spread(middle, half)}"
    yield Form(
        f"formula:reading:{own.reading}:{text}",
        Stage.OFFSET,
        marginals={
            "a": about.amplitude_prior(typical, positive=True),
            "hz": frequency_prior(frequencies),
            "sweep": Uniform(-1.2, 1.2),
            "phase": PHASE,
        },
        units=(own.unit, f"1/{about.time_unit}", "1", "rad"),
        covariates=("time",),
        act=act,
        entries=entries,
        amplitudes=(0,),
        says=lambda mean, sd: (
            f"{own.reading} oscillates with an amplitude of {value_with_sd(mean[0], sd[0], own.unit)} and a frequency "
            f"that goes from {mean[1] * (1 - mean[2]):.4g} to {mean[1] * (1 + mean[2]):.4g} per {about.time_unit}: a "
            "proposal, not a known effect"
        ),
        joined=starting_point_of_wave,
        expression=f"a {text}",
    )


def _double_settling_form(about: ReferenceFit) -> Iterator[Form]:
    """Yield a settling of the reading with two time constants from the start of each run."""
    own = about.system.simulator

    def act(value: FloatArray, theta: FloatArray, rows: RunTable) -> FloatArray:
        a, b, first, second = (theta[:, k : k + 1] for k in range(4))
        since = time_since_start_of_run(rows)
        return np.asarray(value + a * np.exp(-since / first) + b * np.exp(-since / second))

    between = settling_time_prior(about)
    taus = np.geomspace(1.5 * between.low, 0.5 * between.high, _N_SETTLING)
    entries = np.array(
        [
            [[1.0, 0.0, taus[i], taus[j]], [0.0, 1.0, taus[i], taus[j]]]
            for i in range(_N_SETTLING)
            for j in range(i + _APART, _N_SETTLING)
        ]
    )
    typical = about.typical_amplitude(Stage.OFFSET, act, entries, 1.0, (0, 1))
    if typical is None:
        return
    entries[:, :, :2] *= typical
    text = "a exp(-t / tau1) + b exp(-t / tau2), t since the start of the run"
    yield Form(
        f"formula:reading:{own.reading}:{text}",
        Stage.OFFSET,
        marginals={
            "a": about.amplitude_prior(typical),
            "b": about.amplitude_prior(typical),
            "tau1": between,
            "tau2": between,
        },
        units=(own.unit, own.unit, about.time_unit, about.time_unit),
        covariates=("time", "run"),
        act=act,
        entries=entries,
        amplitudes=(0, 1),
        says=lambda mean, sd: (
            f"{own.reading} is off by {value_with_sd(mean[0], sd[0], own.unit)} and "
            f"{value_with_sd(mean[1], sd[1], own.unit)} at the start of each run, which settle with time constants of "
            f"{value_with_sd(mean[2], sd[2], about.time_unit)} and {value_with_sd(mean[3], sd[3], about.time_unit)}: a "
            "proposal, not a known effect"
        ),
        expression=text,
        exchangeable=True,
    )
