"""The sensors of a challenge: five SSFs, three noise levels, noise of eight kinds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from probewise.world.concealed import (
    correlated_noise,
    drifting_noise,
    dropouts,
    heavy_tails,
    outliers,
    signal_dependent_noise,
)
from probewise.world.spots import Blob, Spot, gaussian_spot, ridge_spot, ring_spot, tailed_spot
from probewise.world.stages import Concealed
from probewise.world.world import World

_PIXEL_MM = 0.5  # resolution of the raster: an SSF may be constant over half a millimetre

NOISE_LEVELS: Mapping[str, float] = {"low": 0.4, "middle": 0.6, "high": 1.0}
"""Sd of a reading's noise, in reading units."""

OTHER_NOISE = ("ar1", "drifting", "t4", "outliers", "quantised", "signal_dependent", "dropouts")

NOISE_NAMES: Mapping[str, str] = {
    "ar1": "correlated_noise",
    "t4": "outliers",
    "outliers": "outliers",
    "signal_dependent": "signal_dependent_noise",
    "dropouts": "dropouts",
}
"""Names of noise models in the vocabulary; the other models are declared in the plan or out of vocabulary."""


def _about(rng: np.random.Generator, value: float) -> float:
    """Draw a length within 15 % of a LEGO light sensor's."""
    return value * float(rng.uniform(0.85, 1.15))


def _center(rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.uniform(-0.8, 0.8)), float(rng.uniform(0.8, 2.2))


def _draw_gaussian_spot(rng: np.random.Generator) -> Spot:
    center, sd = _center(rng), (_about(rng, 4.0), _about(rng, 2.5))
    return gaussian_spot([Blob(1.0, center, sd, float(rng.uniform(-0.4, 0.4)))], pixel_mm=_PIXEL_MM)


def _draw_two_lobed_spot(rng: np.random.Generator) -> Spot:
    (u, v), apart = _center(rng), _about(rng, 3.5)
    left = Blob(float(rng.uniform(0.5, 0.7)), (u - apart, v), (_about(rng, 2.2), _about(rng, 2.5)), 0.2)
    right = Blob(float(rng.uniform(0.3, 0.5)), (u + apart, v - 1.0), (_about(rng, 2.0), _about(rng, 3.0)), -0.2)
    return gaussian_spot([left, right], pixel_mm=_PIXEL_MM)


def _draw_ridge_spot(rng: np.random.Generator) -> Spot:
    return ridge_spot(
        _about(rng, 9.0),
        center_mm=_center(rng),
        lobes=float(rng.uniform(0.15, 0.35)),
        ridge_mm=float(rng.uniform(-4.0, -2.0)),
        ridge_width_mm=1.5,
        shadow=float(rng.uniform(0.25, 0.4)),
        pixel_mm=_PIXEL_MM,
    )


def _draw_ring_spot(rng: np.random.Generator) -> Spot:
    off_axis, radius, width = float(rng.uniform(0.2, 0.6)), _about(rng, 3.3), _about(rng, 2.0)
    return ring_spot(radius, width, center_mm=_center(rng), off_axis=off_axis, pixel_mm=_PIXEL_MM)


def _draw_skewed_spot(rng: np.random.Generator) -> Spot:
    core, center = (_about(rng, 1.6), _about(rng, 1.1)), _center(rng)
    return tailed_spot(core, center_mm=center, skew=float(rng.uniform(0.3, 0.5)), pixel_mm=_PIXEL_MM)


SSFS: Mapping[str, Callable[[np.random.Generator], Spot]] = {
    "gaussian": _draw_gaussian_spot,
    "two_lobes": _draw_two_lobed_spot,
    "ridge": _draw_ridge_spot,
    "ring": _draw_ring_spot,
    "skewed": _draw_skewed_spot,
}
"""The last three are not mixtures of Gaussians; the best mixture of four leaves a residual of lambda about 1 at the
middle noise level: a good but inexact model."""


def draw_sensor(ssf: str, noise_level: str, *, rng: np.random.Generator) -> World:
    """Draw a sensor, as a World without effects: SSF of a kind of SSFS, black, white, noise sd of NOISE_LEVELS."""
    black, white = float(rng.uniform(8, 14)), float(rng.uniform(55, 70))
    return World(SSFS[ssf](rng), black=black, white=white, noise_sd=NOISE_LEVELS[noise_level])


def with_noise_model(world: World, model: str, *, duration_s: float) -> World:
    """Return the world with noise that is "white" or a model of OTHER_NOISE; its `noise_sd` is unchanged.

    This sd is that at the start for "drifting", on black for "signal_dependent", of the core for "outliers".
    "quantised" readings are rounded to whole units, which the plan should declare.
    """
    more: Mapping[str, Concealed] = {
        "ar1": correlated_noise(0.3),
        "drifting": drifting_noise(2.0, duration_s),
        "t4": heavy_tails(4.0),
        "outliers": outliers(0.02, 8.0),
        "signal_dependent": signal_dependent_noise(2.0),
        "dropouts": dropouts(0.01, 0.0),
    }
    if model in more:
        return replace(world, concealed=(*world.concealed, more[model]))
    return replace(world, step=1.0) if model == "quantised" else world
