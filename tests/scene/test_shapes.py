"""Shapes, their priors, and the set of shapes."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest

from probewise.errors import ParameterError, ShapeError
from probewise.priors import Product, Uniform
from probewise.recordings import patterns as kinds
from probewise.scene import SHAPES as NAMED
from probewise.scene import (
    AnyOf,
    Circle,
    Ellipse,
    Field,
    HypothesisScene,
    KnownScene,
    Rectangle,
    RegularPolygon,
    StripesRegion,
    mean_angles,
    outlines,
    with_angles_near,
)

SHAPES = {
    **{name: shape(Field()) for name, shape in NAMED.items()},
    "circle_inside": Circle(inside=True),
    "ellipse_inside": Ellipse(inside=True),
    "rectangle_inside": Rectangle(inside=True),
    "hexagon_inside": RegularPolygon(6, inside=True),
    "any": AnyOf({"circle": Circle(), "rectangle": Rectangle(), "hexagon": RegularPolygon(6)}, (0.5, 0.3, 0.2)),
    "any_inside": AnyOf({"circle": Circle(inside=True), "ellipse": Ellipse(inside=True)}),
}


@pytest.fixture(params=SHAPES, name="shape")
def _shape(request):
    return SHAPES[request.param]


def draws(shape, n, seed=0):
    return shape.prior.from_unit_cube(np.random.default_rng(seed).random((n, len(shape.prior.names))))


def test_the_density_is_the_slope_of_the_map_from_the_unit_cube(shape):
    """Change of variables: log density = -log |d theta / d u|, by central differences."""
    n_params = len(shape.prior.names)
    u = np.random.default_rng(4).uniform(0.05, 0.95, (20, n_params))
    step = 1e-6
    slopes = np.empty((20, n_params, n_params))
    for k in range(n_params):
        up, down = u.copy(), u.copy()
        up[:, k] += step
        down[:, k] -= step
        slopes[:, :, k] = (shape.prior.from_unit_cube(up) - shape.prior.from_unit_cube(down)) / (2 * step)
    wanted = -np.linalg.slogdet(slopes)[1]
    assert np.allclose(shape.prior.log_prob(shape.prior.from_unit_cube(u)), wanted, atol=1e-4)


def test_regions_are_one_a_hypothesis_and_equal_one_by_one(shape):
    theta = draws(shape, 12)
    points = np.random.default_rng(1).uniform(0, 1, (200, 2)) * [1048, 520]
    whole = shape.region(theta)
    assert whole.n_regions == 12
    for i in range(12):
        one = shape.region(theta[i : i + 1])
        assert np.array_equal(whole.albedo(points)[i], one.albedo(points)[0])


def test_parameters_with_turned_angles_describe_the_same_shapes(shape):
    """Rectangles swap their sides with every odd turn; a point at an edge may fall on either side of it."""
    rng = np.random.default_rng(2)
    theta, points = draws(shape, 40), rng.uniform(0, 1, (300, 2)) * [1048, 520]
    angles = np.where(["angle_rad" in name for name in shape.prior.names], rng.uniform(4, 9, theta.shape[1]), np.nan)
    turned = with_angles_near(shape, theta, angles)
    assert np.mean(shape.region(turned).albedo(points) != shape.region(theta).albedo(points)) < 1e-3
    assert np.array_equal(turned, theta) != np.isfinite(angles).any()


def test_angles_at_both_ends_of_their_range_have_a_mean_between_them():
    """An upright rectangle: half its samples turn by 0.02, the others, with the sides swapped, by pi/2 - 0.02."""
    theta = np.array([[500.0, 250.0, 80.0, 120.0, 0.02], [500.0, 250.0, 120.0, 80.0, np.pi / 2 - 0.02]])
    weight = np.array([0.5, 0.5])
    near = with_angles_near(Rectangle(), theta, mean_angles(Rectangle(), theta, weight))
    sides = {tuple(row) for row in near[:, 2:4].tolist()}
    assert sides in ({(80.0, 120.0)}, {(120.0, 80.0)})
    assert np.ptp(near[:, 4]) == pytest.approx(0.04)


@pytest.mark.parametrize("name", [name for name in SHAPES if "inside" in name])
def test_a_shape_kept_inside_stays_on_the_field(name):
    shape = SHAPES[name]
    for trace in outlines(shape.region(draws(shape, 300))):
        assert trace.min() >= -1e-9
        assert (trace <= np.array([1048.0, 520.0]) + 1e-9).all()


def test_a_set_of_shapes_takes_each_with_its_weight():
    """10 000 draws: binomial sd 0.005, so 0.02 is passed by chance less than once in 10 000."""
    shape = SHAPES["any"]
    which = shape.shape_index(draws(shape, 10_000))
    share = {label: Counter(which.tolist())[k] / 10_000 for k, label in enumerate(shape.shape_names)}
    assert share == pytest.approx({"circle": 0.5, "rectangle": 0.3, "hexagon": 0.2}, abs=0.02)


@dataclass(frozen=True)
class Bands:
    """A user's own shape: stripes whose phase is unknown."""

    prior = Product({"phase_mm": Uniform(0.0, 30.0)})

    def region(self, theta):
        n = len(theta)
        return StripesRegion(np.zeros(n), np.full(n, 30.0), np.full(n, 0.5), theta[:, 0])


def test_a_new_shape_is_one_short_class_and_joins_the_set():
    shape = AnyOf({"circle": Circle(), "bands": Bands()})
    assert shape.prior.names == ("shape", "circle.x_mm", "circle.y_mm", "circle.radius_mm", "bands.phase_mm")
    theta = draws(shape, 40)
    assert np.isfinite(shape.prior.log_prob(theta)).all()
    points = np.array([[10.0, 5.0], [20.0, 5.0]])
    bands = shape.shape_index(theta) == 1
    assert np.array_equal(shape.region(theta).albedo(points)[bands], Bands().region(theta[bands, 4:]).albedo(points))


def test_the_circle_is_white_up_to_its_radius():
    """Paper, eq. 1: albedo 1 where the distance is at most the radius."""
    region = Circle().region(np.array([[500.0, 200.0, 30.0]]))
    assert region.albedo(np.array([[530.0, 200.0], [530.01, 200.0], [500.0, 170.0]])).tolist() == [[1.0, 0.0, 1.0]]


def test_scenes_name_their_parameters_and_give_their_regions():
    known = KnownScene({"disc": kinds.Disc((0.0, 0.0), 5.0)})
    assert known.names == ()
    assert known.regions(np.zeros((3, 0)))["disc"].n_regions == 1
    guessed = HypothesisScene(Circle())
    theta = draws(Circle(), 3)
    assert guessed.names == ("x_mm", "y_mm", "radius_mm")
    regions = guessed.regions(theta)
    assert regions["any name"] is regions["another"]
    assert regions["field"].n_regions == 3
    assert (list(regions), len(regions)) == (["hypothesis"], 1)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Circle(radius_mm=(0.0, 5.0)), "radius_mm"),
        (lambda: Circle(radius_mm=(20.0, 300.0), inside=True), "less than the field's 1048 x 520 mm"),
        (lambda: RegularPolygon(2), "n_sides is 2; allowed: a whole number, 3 or more"),
        (lambda: Field(width_mm=-1.0), "width_mm is -1.0"),
        (lambda: AnyOf({}), "one shape or more"),
        (lambda: AnyOf({"circle": Circle()}, (0.0,)), "1 numbers greater than 0"),
        (lambda: Circle().prior.from_unit_cube(np.zeros((2, 4))), r"\(n_samples, 3\)"),
        (lambda: SHAPES["any"].prior.from_unit_cube(np.zeros((2, 4))), r"\(n_samples, 9\)"),
    ],
)
def test_a_space_of_shapes_that_cannot_be_is_named(build, message):
    with pytest.raises((ParameterError, ShapeError), match=message):
        build()
