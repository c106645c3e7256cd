"""The region where a local effect acts, which a diagnosis should locate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from probewise._arrays import BoolArray
from probewise.proof.sensors.sizing import EffectSizer
from probewise.world.concealed import (
    AlbedoPatch,
    AmbientStep,
    Concealed,
    EdgeShadow,
    Glint,
    HeightOffset,
    PlaceStep,
    Saturation,
    ScanAngleError,
    ScanMisplacement,
)


@dataclass(frozen=True)
class CovariateRegion:
    """The interval `low` to `high` of `covariate`, in its unit; for the covariate "scan", the names `scans` instead."""

    covariate: str
    low: float | None = None
    high: float | None = None
    scans: tuple[str, ...] = ()


def region_of_effect(effect: Concealed, sizer: EffectSizer) -> CovariateRegion | None:
    """Return the region of a local effect, or None for any other.

    Effects on named scans: those scans. Ambient step: from the step to the last reading. Saturation: its level to the
    largest reading. Edge shadow: distances at which it is at least half its maximum. Stain, glint, step in X: the range
    of X in which it changes readings of scans along X by at least half its maximum.
    """
    plan, clean = sizer.clean_recording.plan, sizer.clean_recording.readings
    match effect:
        case ScanMisplacement():
            return CovariateRegion("scan", scans=(effect.scan,))
        case ScanAngleError() | HeightOffset():
            return CovariateRegion("scan", scans=effect.scans)
        case AmbientStep():
            return CovariateRegion("time", effect.at_s, float(plan.time_s[-1]))
        case Saturation():
            return CovariateRegion("level", effect.level, float(clean.max()))
        case EdgeShadow():
            return CovariateRegion("edge_distance", 0.0, effect.w * math.sqrt(2 * math.log(2)))
        case AlbedoPatch() | Glint() | PlaceStep():
            along_x: BoolArray = np.abs(plan.direction_of_motion[:, 0]) > 0
            strength = np.where(along_x, np.abs(sizer.recording_with_effects(effect).readings - clean), 0.0)
            there = plan.x_mm[strength >= strength.max() / 2]
            return CovariateRegion("place", float(there.min()), float(there.max()))
        case _:
            return None
