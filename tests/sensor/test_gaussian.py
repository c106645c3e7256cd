"""What a Gaussian footprint sees of every kind of region, by independent routes."""

import numpy as np
import pytest
from mixtures import mean_albedo_under_gaussians
from scipy.special import ndtr
from scipy.stats import multivariate_normal

from probewise.errors import SlowWarning
from probewise.recordings import patterns as kinds
from probewise.scene import PolygonRegion, QuadrantRegion, disc_region, region_of
from probewise.sensor import FAST_NODES, gaussian
from probewise.sensor.gaussian import normal_cdf

PATTERNS = {
    "uniform": kinds.Uniform(0.3),
    "half_plane": kinds.HalfPlane(0.4, 2.0),
    "quadrant": kinds.Quadrant((1.0, -2.0), (-1, 1)),
    "disc": kinds.Disc((3.0, 1.0), 20.0),
    "small_disc": kinds.Disc((1.0, 1.0), 3.0),
    "polygon": kinds.Polygon(((0.0, 0.0), (14.0, 2.0), (9.0, 15.0), (4.0, 6.0))),
    "star": kinds.Polygon(((0.0, 20.0), (12.0, -16.0), (-19.0, 6.0), (19.0, 6.0), (-12.0, -16.0))),
    "wide_stripes": kinds.Stripes(0.3, 30.0, 0.35, 1.0),
    "fine_stripes": kinds.Stripes(0.3, 5.0, 0.35, 1.0),
    "ramp": kinds.Ramp(0.7, 0.02),
    "image": kinds.Image(np.random.default_rng(5).random((12, 16)), 2.0, (-15.0, -11.0), "random.npy"),
}


def see(region, x, y, cov, **options):
    """One place, one Gaussian."""
    arrays = (np.reshape(value, (1, 1, 1)) for value in (x, y, cov[0][0], cov[1][1], cov[0][1]))
    return mean_albedo_under_gaussians(region, *arrays, **options)[0, 0, 0]


def covariance(sd_1, sd_2, rho):
    return np.array([[sd_1**2, rho * sd_1 * sd_2], [rho * sd_1 * sd_2, sd_2**2]])


def over_a_disc(mean, cov, center, radius):
    """Polar rule about the disc's centre: Gauss-Legendre in the radius, trapezium in the angle."""
    node, weight = np.polynomial.legendre.leggauss(160)
    rho = radius * (node + 1) / 2
    t = 2 * np.pi * np.arange(800) / 800
    x = center[0] + rho[:, None] * np.cos(t) - mean[0]
    y = center[1] + rho[:, None] * np.sin(t) - mean[1]
    inverse = np.linalg.inv(cov)
    quadratic = inverse[0, 0] * x**2 + inverse[1, 1] * y**2 + 2 * inverse[0, 1] * x * y
    ring = np.exp(-0.5 * quadratic).sum(axis=1) * 2 * np.pi / 800 * rho
    return radius / 2 * weight @ ring / (2 * np.pi * np.sqrt(np.linalg.det(cov)))


def test_the_fast_cumulative_is_the_normal_cumulative():
    z = np.concatenate([np.linspace(-12, 12, 100_001), [-np.inf, np.inf, 0.0]])
    assert np.abs(normal_cdf(z) - ndtr(z)).max() < 1e-10
    # However the array lies in memory.
    by_columns = np.asfortranarray(np.linspace(-9, 9, 3000).reshape(3, 1000))
    assert np.abs(normal_cdf(by_columns) - ndtr(by_columns)).max() < 1e-10


@pytest.fixture(scope="module", name="discs")
def _discs():
    """Discs of all sizes about the origin: mean and covariance of the footprint, radius, what is seen."""
    rng = np.random.default_rng(7)
    found = []
    for _ in range(40):
        sd = rng.uniform(3, 9, 2)
        radius = np.exp(rng.uniform(np.log(1.0), np.log(150.0)))
        cov = covariance(*sd, rng.uniform(-0.7, 0.7))
        angle, distance = rng.uniform(0, 6.3), abs(radius + rng.normal() * 2 * sd.max())
        mean = np.array([distance * np.cos(angle), distance * np.sin(angle)])
        found.append((mean, cov, radius, over_a_disc(mean, cov, (0.0, 0.0), radius)))
    return found


@pytest.mark.parametrize(("n_nodes", "tolerance"), [(64, 1e-8), (32, 5e-5), (FAST_NODES, 1e-4)])
def test_discs_of_all_sizes_hold_the_stated_error(discs, n_nodes, tolerance):
    """Against a polar rule, radii 1 to 150 mm, sd 3 to 9 mm, any correlation to 0.7."""
    for mean, cov, radius, wanted in discs:
        disc = disc_region(np.zeros((1, 2)), np.array([radius]))
        assert see(disc, *mean, cov, n_nodes=n_nodes) == pytest.approx(wanted, abs=tolerance)


@pytest.mark.parametrize("rho", [-0.95, -0.3, 0.0, 0.6, 0.95])
@pytest.mark.parametrize("corner", [(0.0, 0.0), (0.0, 2.0), (3.0, 0.0), (-2.0, 5.0), (40.0, 0.0), (-40.0, 1.0)])
def test_a_quadrant_is_the_bivariate_normal(rho, corner):
    """Against scipy's bivariate normal cumulative, in all four directions, also through the corner's axes."""
    cov = covariance(3.0, 5.0, rho)
    for dx in (-1, 1):
        for dy in (-1, 1):
            flip = np.array([dx, dy])
            region = QuadrantRegion(np.array([corner]), flip[None])
            upper = -flip * np.array(corner)
            wanted = multivariate_normal([0.0, 0.0], cov * np.outer(flip, flip), abseps=1e-11, releps=1e-11).cdf(upper)
            assert see(region, 0.0, 0.0, cov) == pytest.approx(wanted, abs=1e-8)


@pytest.mark.parametrize(
    ("width", "height", "x", "y"),
    [
        *((10.0, 4.0, *place) for place in [(0, 0), (3, 0), (3, 1), (5, 2), (10, 0), (1, 99)]),
        *((90.0, 60.0, 3 * sds, beside) for sds in (7.99, 8.0, 8.01, 9.0, 15.0) for beside in (-1.3, -1e-9, 0.4)),
    ],
)
def test_a_rectangle_under_an_upright_footprint_is_a_product(width, height, x, y):
    """Differences of cumulatives; also with the mean on an edge's line, or a corner that just comes in reach."""
    box = PolygonRegion.from_vertices(np.array([[[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]]))
    wanted = (ndtr((width - x) / 3) - ndtr(-x / 3)) * (ndtr((height - y) / 2) - ndtr(-y / 2))
    assert see(box, x, y, np.diag([9.0, 4.0])) == pytest.approx(wanted, abs=2e-15 if width == 90 else 1e-12)


@pytest.mark.parametrize("period", [3.0, 10.0, 12.4, 12.6, 60.0])
def test_stripes_are_a_sum_of_half_planes(period):
    """Against 200 explicit strips, finer and coarser than the footprint."""
    stripes = region_of(kinds.Stripes(0.5, period, 0.3, 2.0))
    cov = covariance(5.0, 5.0, 0.0)
    wanted = 0.0
    along = 7.0 * np.cos(0.5) + 1.0 * np.sin(0.5)
    for k in range(-100, 101):
        start = 2.0 + k * period
        wanted += ndtr((start + 0.3 * period - along) / 5.0) - ndtr((start - along) / 5.0)
    assert see(stripes, 7.0, 1.0, cov) == pytest.approx(wanted, abs=1e-8)


@pytest.mark.parametrize("rho", [0.0, 0.5, -0.85])
def test_an_image_of_pixels_is_the_sum_of_its_squares(rho):
    """Rows of pixels by quadrature against every pixel as a polygon of its own."""
    image = region_of(PATTERNS["image"])
    cov = covariance(1.2, 6.0, rho)
    wanted = 0.0
    n_rows = len(image.values)
    for (row, column), albedo in np.ndenumerate(image.values):
        low = np.array(image.origin_mm) + 2.0 * np.array([column, n_rows - 1 - row])
        square = low + 2.0 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        wanted += albedo * see(PolygonRegion.from_vertices(square[None]), 3.0, -2.0, cov)
    assert see(image, 3.0, -2.0, cov) == pytest.approx(wanted, abs=1e-8)


def test_over_an_image_many_gaussians_are_done_together_by_a_rule_computed_once(monkeypatch):
    """A diagnosis asks for half a million; one by one, each with its own rule, they took most of its time."""
    sizes = []
    monkeypatch.setattr(gaussian, "normal_cdf", lambda z: (sizes.append(z.size), normal_cdf(z))[1])
    image, places = region_of(PATTERNS["image"]), np.linspace(-20, 20, 2000).reshape(40, 50, 1)
    for _ in range(2):
        mean_albedo_under_gaussians(image, places, 0.0, 9.0, 9.0, 0.0)
        monkeypatch.setattr(np.polynomial.legendre, "leggauss", lambda n: pytest.fail("a rule is computed again"))
    assert len(sizes) < 2 * places.size / 5
    assert max(sizes) < 100_000  # more would not stay in the cache


@pytest.fixture(params=PATTERNS, name="pattern")
def _pattern(request):
    return PATTERNS[request.param]


def test_hypotheses_readings_and_gaussians_together_equal_one_by_one(pattern):
    rng = np.random.default_rng(3)
    region = region_of(pattern)
    x, y = rng.normal(size=(2, 3, 4, 2)) * 9
    sd_1, sd_2, rho = rng.uniform(2, 6, (3, 1, 2)), rng.uniform(2, 6, (3, 1, 2)), rng.uniform(-0.8, 0.8, (3, 1, 2))
    together = mean_albedo_under_gaussians(region, x, y, sd_1**2, sd_2**2, rho * sd_1 * sd_2)
    assert together.shape == (3, 4, 2)
    for i, j, k in np.ndindex(3, 4, 2):
        alone = see(region, x[i, j, k], y[i, j, k], covariance(sd_1[i, 0, k], sd_2[i, 0, k], rho[i, 0, k]))
        assert together[i, j, k] == pytest.approx(alone, abs=1e-9)


class Checkers:
    """A user's own region without a closed form: it has its albedo only."""

    n_regions = 1

    def albedo(self, points_mm):
        return np.where(np.floor(points_mm / 20.0).sum(axis=1) % 2 == 0, 1.0, 0.0)[None]


def test_a_region_without_a_closed_form_is_summed_over_pixels():
    """A checkerboard's closed form is a product of two square waves, each a sum of cumulatives."""
    edges = np.arange(-200, 201, 20.0)

    def wave(place, sd):
        return np.sum((-1.0) ** np.arange(len(edges) - 1) * np.diff(ndtr((edges - place) / sd)))

    wanted = 0.5 + 0.5 * wave(3.0, 4.0) * wave(-2.0, 6.0)
    with pytest.warns(SlowWarning, match="Checkers has no closed form"):
        found = see(Checkers(), 3.0, -2.0, np.diag([16.0, 36.0]))
    assert found == pytest.approx(wanted, abs=0.02)
