"""The share of a turned square pixel that lies on the inner side of an edge, or inside a polygon."""

from __future__ import annotations

import numpy as np

from probewise._arrays import FloatArray


def share_inside_half_plane(distance_mm: FloatArray, angle_rad: FloatArray, pixel_mm: float) -> FloatArray:
    """Return the share of each square pixel on the positive side of a straight edge.

    Parameters
    ----------
    distance_mm
        Signed distance of the pixel's centre from the edge, positive inside.
    angle_rad
        Angle between the edge's normal and a side of the square; broadcasts with the distance.
    pixel_mm
        Side of the square.

    Returns
    -------
    Share, 0 to 1: the cumulative of the square's projection on the normal, a trapezium.
    """
    cosine, sine = np.abs(np.cos(angle_rad)), np.abs(np.sin(angle_rad))
    wide = 0.5 * pixel_mm * np.maximum(cosine, sine)
    narrow = 0.5 * pixel_mm * np.minimum(cosine, sine)
    t = np.abs(distance_mm)
    left_over = np.maximum(wide + narrow - t, 0.0)
    # The corner's triangle has area left_over^2 / (8 wide narrow) of the square; without a
    # corner (narrow = 0) the flank alone decides.
    corner = left_over**2 / (8 * wide * np.maximum(narrow, 1e-12 * pixel_mm))
    flank = 0.5 - 0.5 * t / wide
    outside = np.where(t <= wide - narrow, flank, corner)
    outside = np.minimum(outside, 0.5)
    return np.where(distance_mm >= 0, 1 - outside, outside)


def share_inside_polygon(
    edges_mm: FloatArray, centers_mm: FloatArray, pixel_mm: float, turn_rad: FloatArray
) -> FloatArray:
    """Return the share of each square inside a polygon, exactly.

    Green's theorem on the polygon clipped to the square: the sum over directed edges (inside
    on their left) of the area between the edge, clamped to the square, and its lower side.

    Parameters
    ----------
    edges_mm
        Directed edges, shape (n_regions, n_edges, 2 ends, 2).
    centers_mm
        Centres of the pixels, shape (n_points, 2).
    pixel_mm
        Side of the square.
    turn_rad
        Angle by which each square is turned, shape (n_points,).

    Returns
    -------
    Share, shape (n_regions, n_points).
    """
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    total = np.zeros((len(edges_mm), len(centers_mm)))
    for k in range(edges_mm.shape[1]):
        ends = []
        for end in (edges_mm[:, k, 0], edges_mm[:, k, 1]):
            dx = end[:, :1] - centers_mm[:, 0]
            dy = end[:, 1:] - centers_mm[:, 1]
            ends.append(((cosine * dx + sine * dy) / pixel_mm, (cosine * dy - sine * dx) / pixel_mm))
        (x1, y1), (x2, y2) = ends
        run = x2 - x1
        upright = np.abs(run) < 1e-12
        slope = (y2 - y1) / np.where(upright, 1.0, run)
        a, b = np.clip(x1, -0.5, 0.5), np.clip(x2, -0.5, 0.5)
        ya, yb = y1 + slope * (a - x1), y1 + slope * (b - x1)
        rise = yb - ya
        flat = np.abs(rise) < 1e-9
        mean_height = np.where(
            flat,
            np.clip(0.5 * (ya + yb), -0.5, 0.5),
            (_integral_of_clip(yb) - _integral_of_clip(ya)) / np.where(flat, 1.0, rise),
        )
        total -= np.where(upright, 0.0, (b - a) * (mean_height + 0.5))
    return np.clip(total, 0.0, 1.0)


def _integral_of_clip(y: FloatArray) -> FloatArray:
    """Return the antiderivative of clip(y, -1/2, 1/2) that is 0 at 0."""
    inner = np.clip(y, -0.5, 0.5)
    return 0.5 * inner**2 + 0.5 * np.abs(y - inner)
