"""What real recordings gain from what a diagnosis finds in them, on edges that were kept back.

    python benchmarks/real_recordings.py FOLDER/chart/chart_edges.csv [--free-form] [EFFECT+EFFECT ...]

Each group of scans over one pattern is kept back in turn; the sensor, plain and with effects, is fitted to the
others and predicts it. The gain is in nats a reading, the noise Gaussian, with the standard error over the scans
kept back: readings of one scan remember each other, scans do not.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.noise import white_noise
from probewise.diagnosis.sensors import (
    default_sensor,
    starts_of_one_gaussian,
    starts_with_more_gaussians,
    with_free_form,
)
from probewise.effects import VOCABULARY, Extent
from probewise.inference import sd_floor
from probewise.recordings import Recording, read_recording


@dataclass(frozen=True)
class Gain:
    """One set of effects: rms on what was kept back, and the gain over the plain sensor in nats a reading."""

    effects: tuple[str, ...]
    rms: float
    gain: float
    gain_error: float


def kept_back(recording: Recording, combinations: list[tuple[str, ...]], *, free_form: bool = False) -> list[Gain]:
    """Keep the scans over each pattern back in turn, and compare sets of effects on them; () comes first.

    The sensor's SSF is of two Gaussians, or of free form.
    """
    plan, usable = recording.plan, recording.usable
    misses: dict[tuple[str, ...], np.ndarray] = {}
    scores: dict[tuple[str, ...], np.ndarray] = {}
    for names in dict.fromkeys([(), *combinations]):
        miss, score = np.full(len(plan), np.nan), np.full(len(plan), np.nan)
        for code in np.unique(plan.pattern):
            out = plan.pattern == code
            readings = np.where(out, np.nan, recording.readings)
            found = _fitted(Recording(plan, readings), names, free_form)
            rows = np.flatnonzero(out & usable)
            miss[rows] = recording.readings[rows] - found.model.predict(found.z[None, :])[0, rows]
            score[rows] = -0.5 * (miss[rows] / found.sd) ** 2 - np.log(found.sd)
        misses[names], scores[names] = miss, score
    out_gains = []
    for names, miss in misses.items():
        rows = np.flatnonzero(np.isfinite(miss))
        gained = (scores[names] - scores[()])[rows]
        by_scan = np.array([gained[plan.scan[rows] == k].mean() for k in np.unique(plan.scan[rows])])
        rms, error = np.sqrt(np.mean(miss[rows] ** 2)), by_scan.std(ddof=1) / np.sqrt(len(by_scan))
        out_gains.append(Gain(names, float(rms), float(gained.mean()), float(error)))
    return out_gains


def _fitted(recording: Recording, names: tuple[str, ...], free_form: bool):
    extent, law = Extent.of(recording), white_noise(int(recording.usable.sum()), least=sd_floor(recording))
    one = default_sensor(extent, 1)
    found = _best(Model(one, (), recording.plan), recording, starts_of_one_gaussian(one), law)
    if free_form:
        wanted = with_free_form(one)
        starts = np.pad(found.z, (0, wanted.n_params - one.n_params))[None, :]
    else:
        wanted = default_sensor(extent, 2)
        starts = starts_with_more_gaussians(found.model.sensor, found.z, wanted)
    found = _best(Model(wanted, (), recording.plan), recording, starts, law)
    for name in names:
        model = found.model.with_effect(VOCABULARY[name].for_extent(extent))
        own = np.zeros(model.n_params - found.model.n_params)
        starts = np.stack([np.concatenate([found.z, own + shift]) for shift in (-0.5, 0.1, 0.5)])
        found = _best(model, recording, starts, law)
    return found


def _best(model, recording, starts, law):
    return min((fit(model, recording, start, law, max_steps=40) for start in starts), key=lambda f: f.objective)


if __name__ == "__main__":
    made = read_recording(Path(sys.argv[1]))
    asked = [tuple(text.split("+")) for text in sys.argv[2:] if text != "--free-form"]
    usual = [("nonlinearity",), ("nonlinearity", "ambient_gradient")]
    for found in kept_back(made, asked or usual, free_form="--free-form" in sys.argv):
        label = "+".join(found.effects) or "plain sensor"
        print(f"{label:40s} rms {found.rms:.3f}  gain {found.gain:+.3f} ± {found.gain_error:.3f} nats a reading")
