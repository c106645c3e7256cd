"""Scenes and shapes: what lies under the sensor, known or hypothesised.

Paper, section 2.2 (the circle's albedo, eq. 1 to 3) and section 2.6 (the patterns S_BW and S_a to S_d, eq. 12 to 16).
"""

from probewise.scene.regions import (
    EllipseRegion,
    HalfPlaneRegion,
    ImageRegion,
    PolygonRegion,
    QuadrantRegion,
    RampRegion,
    Region,
    RegionsOfMixedKinds,
    StripesRegion,
    UniformRegion,
    disc_region,
    edge_distance,
    outlines,
    region_of,
)
from probewise.scene.scenes import Card, CardedRegion, CardedScene, HypothesisScene, KnownScene, Scene
from probewise.scene.shapes import (
    SHAPES,
    AnyOf,
    Circle,
    Ellipse,
    Field,
    PlacedPrior,
    Rectangle,
    RegularPolygon,
    Shape,
    mean_angles,
    with_angles_near,
)

__all__ = [
    "SHAPES",
    "AnyOf",
    "Card",
    "CardedRegion",
    "CardedScene",
    "Circle",
    "Ellipse",
    "EllipseRegion",
    "Field",
    "HalfPlaneRegion",
    "HypothesisScene",
    "ImageRegion",
    "KnownScene",
    "PlacedPrior",
    "PolygonRegion",
    "QuadrantRegion",
    "RampRegion",
    "Rectangle",
    "Region",
    "RegionsOfMixedKinds",
    "RegularPolygon",
    "Scene",
    "Shape",
    "StripesRegion",
    "UniformRegion",
    "disc_region",
    "edge_distance",
    "mean_angles",
    "outlines",
    "region_of",
    "with_angles_near",
]
