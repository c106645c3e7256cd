"""Response of a known footprint to ellipses, from the nearest point of the edge and the edge's curvature there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.inquiry.scanlines import Interval, to_single_precision
from probewise.inquiry.unit_gaussian import mass_within_curved_edge
from probewise.scene import EllipseRegion
from probewise.sensor import FixedMixture

_TINY = np.float32(1e-6)


@dataclass(frozen=True, eq=False)
class Ellipses:
    """Ellipses in the lab frame and, for each Gaussian of the footprint, in the frame in which it is the unit Gaussian.

    In the lab an ellipse is where xx dx^2 + 2 xy dx dy + yy dy^2 <= 1. dx and dy count from the place of the sensor at
    which the footprint's centre is over the ellipse's centre: `lab` (5, n_ellipses) holds x and y of that place, then
    xx, xy, yy. `growth_per_sd` is the largest increase of each ellipse's scale per sd of the footprint,
    `growth_by_offsets` the increase by the Gaussians' offsets from the centre, (n_ellipses,) each. `axes` (n_gaussians,
    2, n_ellipses) are the semi-axes, major and minor. `to_axes_frame` (n_gaussians, 2, 3, n_ellipses) maps a place to
    the semi-axes' frames: for each axis the factor of x, the factor of y, and a constant. `y_range_mm` (2, n_ellipses)
    are the lowest and the highest point, `share` (n_gaussians,) the weights of the Gaussians.
    """

    y_range_mm: FloatArray
    share: FloatArray
    lab: FloatArray
    growth_per_sd: FloatArray
    growth_by_offsets: FloatArray
    to_axes_frame: FloatArray
    axes: FloatArray

    @classmethod
    def of(cls, region: EllipseRegion, footprint: FixedMixture) -> Self:
        """Build from n_ellipses ellipses under a footprint in the lab frame."""
        cosine, sine = np.cos(region.angle_rad), np.sin(region.angle_rad)
        turn = np.stack([np.stack([cosine, sine], axis=-1), np.stack([-sine, cosine], axis=-1)], axis=1)
        form = np.einsum("nki,nk,nkj->nij", turn, region.semi_axes_mm**-2, turn)
        middle = footprint.weights @ footprint.means_mm
        root = np.linalg.cholesky(footprint.covs_mm2)
        squared, frame = np.linalg.eigh(np.einsum("gki,nkl,glj->gnij", root, form, root, optimize=True))
        to_axes_frame = np.einsum("gnki,gkj->gnij", frame, np.linalg.inv(root))
        constant = np.einsum("gnij,gnj->gni", to_axes_frame, footprint.means_mm[:, None] - region.center_mm)
        axes = squared.transpose(0, 2, 1) ** -0.5
        away = np.linalg.norm(footprint.means_mm - middle, axis=1).max()
        half_mm = np.linalg.norm(turn[:, :, 1] * region.semi_axes_mm, axis=1)
        return cls(
            to_single_precision(region.center_mm[:, 1] + np.stack([-half_mm, half_mm])),
            to_single_precision(footprint.weights),
            lab=to_single_precision(
                np.stack([*(region.center_mm - middle).T, form[:, 0, 0], form[:, 0, 1], form[:, 1, 1]])
            ),
            growth_per_sd=to_single_precision((1.0 / axes[:, 1]).max(axis=0)),
            growth_by_offsets=to_single_precision(away / region.semi_axes_mm.min(axis=1)),
            to_axes_frame=to_single_precision(
                np.concatenate([to_axes_frame, constant[..., None]], axis=-1).transpose(0, 2, 3, 1)
            ),
            axes=to_single_precision(axes),
        )

    def crossed_by_rows(self, which: IntArray, y_mm: FloatArray) -> CrossedEllipses:
        """Intersect each ellipse of `which` (by number) with a horizontal row at `y_mm`; both (n_crossings,)."""
        lab, growth_per_sd, growth_by_offsets, to_axes_frame, axes = (
            values.take(which, axis=-1)
            for values in (self.lab, self.growth_per_sd, self.growth_by_offsets, self.to_axes_frame, self.axes)
        )
        lab[1] = y_mm - lab[1]
        return CrossedEllipses(
            self.share,
            lab,
            growth_per_sd=growth_per_sd,
            growth_by_offsets=growth_by_offsets,
            slope=to_axes_frame[:, :, 0],
            base=to_axes_frame[:, :, 1] * y_mm + to_axes_frame[:, :, 2],
            axes=axes,
        )


@dataclass(frozen=True, eq=False)
class CrossedEllipses:
    """Ellipses intersected by rows: as `Ellipses`, with one crossing per entry of the last axis.

    In the frames of the semi-axes a place is `slope` x + `base`, (n_gaussians, 2, n_crossings); the second row of `lab`
    is the height of the row above the ellipse.
    """

    share: FloatArray
    lab: FloatArray
    growth_per_sd: FloatArray
    growth_by_offsets: FloatArray
    slope: FloatArray
    base: FloatArray
    axes: FloatArray

    def interval_deeper_than(self, reach: float) -> Interval:
        """Return the interval of x (both ends) deeper than `reach` sds inside; if negative, up to that far outside.

        An ellipse scaled by 1 + d / (its shortest semi-axis) contains all points within d of the ellipse; likewise
        inwards.
        """
        x_mm, up, xx, xy, yy = self.lab
        scale = 1.0 - np.float32(reach) * self.growth_per_sd - np.float32(np.sign(reach)) * self.growth_by_offsets
        room = scale * scale * xx - (xx * yy - xy * xy) * up * up
        half = np.sqrt(np.maximum(room, 0.0)) / xx
        middle = x_mm - xy / xx * up
        return np.where((room > 0) & (scale > 0), middle - half, np.inf), middle + half

    def footprint_share(self, crossing: IntArray, x_mm: FloatArray) -> FloatArray:
        """Return the share of the footprint over the ellipse, for a sensor at `x_mm` on the row, (n_pairs,).

        `crossing` are the indices of these pairs of ellipse and row, (n_pairs,).
        """
        out = to_single_precision(np.zeros(x_mm.shape))
        for share, slope, base, axes in zip(self.share, self.slope, self.base, self.axes, strict=True):
            p, q = (np.abs(s.take(crossing) * x_mm + b.take(crossing)) for s, b in zip(slope, base, strict=True))
            a, b = (axis.take(crossing) for axis in axes)
            cosine, sine = _scaled_to_unit_length(p / a, q / b)
            bent = a * a - b * b
            u, v = bent / a * (cosine * cosine * cosine), -bent / b * (sine * sine * sine)  # the centre of curvature
            ratio = _vector_length(a * cosine - u, b * sine - v) / np.maximum(_vector_length(p - u, q - v), _TINY)
            cosine, sine = _scaled_to_unit_length(
                np.maximum((p - u) * ratio + u, 0.0) / a, np.maximum((q - v) * ratio + v, 0.0) / b
            )
            steep_p, steep_q = cosine / a, sine / b
            steep = _vector_length(steep_p, steep_q)
            distance = ((a * cosine - p) * steep_p + (b * sine - q) * steep_q) / steep
            around = a * b * steep
            out = out + share * mass_within_curved_edge(distance, 1.0 / (around * around * steep))
        return out


def _vector_length(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.sqrt(x * x + y * y)


def _scaled_to_unit_length(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Scale the vectors (x, y) to unit length."""
    length = np.maximum(_vector_length(x, y), _TINY)
    return x / length, y / length
