"""Effects of the light on its way, against pixels, in any order on the footprint."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import ndtr

from probewise.effects import EFFECTS, Extent
from probewise.recordings import Disc, HalfPlane, Instrumentation, Plan, Quadrant, Uniform
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels, FixedMixture, Stage

I_MIN, I_MAX, H0 = 10.0, 60.0, 12.0
PIXEL = 0.2
WEIGHTS = np.array([0.7, 0.3])
MEANS = np.array([[1.0, 2.0], [-2.0, 3.0]])
COVS = np.array([[[16.0, 3.0], [3.0, 9.0]], [[36.0, -5.0], [-5.0, 49.0]]])
NAMES = ("edge", "corner", "disc", "plain")
PATTERNS = {
    "edge": HalfPlane(0.0, 1.0),
    "corner": Quadrant((2.0, -3.0), (1, -1)),
    "disc": Disc((4.0, 0.0), 18.0),
    "plain": Uniform(0.6),
}


def plan():
    """Four scans of four readings: forth, back, along Y, and forth, turned by 0, 130, 0 and 250 degrees."""
    line = np.array([-6.0, -1.0, 3.0, 7.0])
    still = np.full(4, 1.0)
    return Plan(
        x_mm=np.concatenate([line, line[::-1], still, line]),
        y_mm=np.concatenate([still, still + 1, line, still]),
        orientation_rad=np.radians(np.repeat([0.0, 130.0, 0.0, 250.0], 4)),
        time_s=np.cumsum(np.tile([30.0, 1.0, 1.5, 0.7], 4)),
        scan=np.repeat(np.arange(4), 4),
        scan_names=("a", "b", "c", "d"),
        pattern=[0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 0, 1, 2, 3],
        pattern_names=NAMES,
        patterns=PATTERNS,
        covariates={"battery_mv": np.linspace(8300.0, 7600.0, 16)},
        instrumentation=Instrumentation(height_mm=H0),
    )


PLAN = plan()
SIGN = np.repeat([1.0, -1.0, 1.0, 1.0], 4)  # of the move, along Y in scan c
ALONG = np.repeat([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [1.0, 0.0]], 4, axis=0)


def inside(name, x, y):
    """Albedo of the patterns, written out."""
    if name == "edge":
        return (x > 1.0).astype(float)
    if name == "corner":
        return ((x > 2.0) & (y < -3.0)).astype(float)
    if name == "disc":
        return (np.hypot(x - 4.0, y) < 18.0).astype(float)
    return np.full_like(x, 0.6)


def distance(name, x, y):
    """Distance to the nearest edge, written out."""
    if name == "edge":
        return abs(x - 1.0)
    if name == "corner":
        right, down = x - 2.0, -(y + 3.0)
        below_corner, right_of_corner = max(down, 0.0), max(right, 0.0)
        return min(np.hypot(right, down - below_corner), np.hypot(right - right_of_corner, down))
    return abs(np.hypot(x - 4.0, y) - 18.0) if name == "disc" else np.inf


@dataclass(frozen=True)
class Rival:
    """The other route to the readings: each step a plain function, to be replaced by what an effect does."""

    place: Callable = lambda k, x, y: (x, y)
    turn_deg: Callable = lambda k: 0.0
    albedo: Callable = lambda k, name, x, y: inside(name, x, y)
    height: Callable = lambda k: H0
    widen: float = 0.0
    share: Callable = lambda u, k, name, x, y, see: u
    curve: Callable = lambda u: u
    gain: Callable = lambda k: 1.0
    offset: Callable = lambda k: 0.0
    finish: Callable = lambda readings: readings

    def readings(self):
        return self.finish(np.array([self.reading(k) for k in range(16)]))

    def reading(self, k):
        name = NAMES[PLAN.pattern[k]]
        x, y = self.place(k, PLAN.x_mm[k], PLAN.y_mm[k])
        angle = PLAN.orientation_rad[k] + np.radians(self.turn_deg(k))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        ratio = self.height(k) / H0

        def see(mean, cov):
            center = np.array([x, y]) + turn @ mean
            cov = turn @ cov @ turn.T
            reach = 6.5 * np.sqrt(np.diag(cov).max())
            u, v = (
                PIXEL * (np.arange(np.floor((m - reach) / PIXEL), np.ceil((m + reach) / PIXEL)) + 0.5) for m in center
            )
            u, v = np.meshgrid(u, v)
            a, b, c = np.linalg.inv(cov)[[0, 0, 1], [0, 1, 1]]
            du, dv = u - center[0], v - center[1]
            density = np.exp(-0.5 * (a * du**2 + 2 * b * du * dv + c * dv**2))
            return float(np.sum(density * self.albedo(k, name, u, v)) / np.sum(density))

        means, covs = MEANS * ratio, COVS * ratio**2 + self.widen * np.eye(2)
        own = sum(w * see(m, c) for w, m, c in zip(WEIGHTS, means, covs, strict=True))
        seen = self.curve(self.share(own, k, name, x, y, see))
        return I_MIN + (I_MAX - I_MIN) / ratio**2 * self.gain(k) * seen + self.offset(k)


X, Y, T = PLAN.x_mm, PLAN.y_mm, PLAN.time_s


def in_scan(number):
    return lambda k: float(PLAN.scan[k] == number)


def moved(k, name, x, y, by):
    """Move a pattern along its normal, +X for all of these."""
    return inside(name, x - by, y)


def held_back(readings, tau):
    out = readings.copy()
    for k in range(1, 16):
        if PLAN.scan[k] == PLAN.scan[k - 1]:
            a = np.exp(-(T[k] - T[k - 1]) / tau)
            out[k] = a * out[k - 1] + (1 - a) * readings[k]
    return out


def overshot(readings):
    """Every rise leaves a fifth of it, which decays in 5 s; falls leave nothing, and the time between scans counts."""
    out = readings.copy()
    for k in range(1, 16):
        out[k:] += 0.2 * max(readings[k] - readings[k - 1], 0.0) * np.exp(-(T[k:] - T[k]) / 5.0)
    return out


def soft(name, x, y, sd):
    """Albedo of patterns with straight edges, blurred."""
    if name == "edge":
        return ndtr((x - 1.0) / sd)
    if name == "corner":
        return ndtr((x - 2.0) / sd) * ndtr((-3.0 - y) / sd)
    return inside(name, x, y)


CASES = {
    "ambient_gradient": ((0.02, -0.05), Rival(offset=lambda k: 0.02 * X[k] - 0.05 * Y[k])),
    "ambient_step": ((1.5, 70.0), Rival(offset=lambda k: 1.5 * (T[k] > 70.0))),
    "offset_drift": ((40.0,), Rival(offset=lambda k: 40.0 * T[k] / 3600)),
    "gain_drift": ((0.1, 50.0), Rival(gain=lambda k: 1 + 0.1 * np.exp(-T[k] / 50))),
    "dark_level": ((1.5,), Rival(offset=lambda k: 1.5)),
    "gain": ((0.1,), Rival(gain=lambda k: 1.1)),
    "battery_sag": ((0.2,), Rival(gain=lambda k: 1 + 0.2 * (8.3 - 0.7 * k / 15 - 8.0))),
    "flicker": ((2.0, 0.3, 1.0), Rival(offset=lambda k: 2 * np.sin(2 * np.pi * 0.3 * T[k] + 1.0))),
    "saturation": ((45.0, 1e-9), Rival(finish=lambda readings: np.minimum(readings, 45.0))),
    "nonlinearity": ((1.3,), Rival(curve=lambda u: u**1.3)),
    "hysteresis": ((0.7,), Rival(offset=lambda k: 0.7 * SIGN[k])),
    "lag": ((0.8,), Rival(finish=lambda readings: held_back(readings, 0.8))),
    "backlash": ((1.2,), Rival(place=lambda k, x, y: (x - 0.6 * ALONG[k, 0], y - 0.6 * ALONG[k, 1]))),
    "position_scale": ((0.05, -0.1), Rival(place=lambda k, x, y: (1.05 * x, 0.9 * y))),
    "periodic_position_error": (
        (0.8, 11.0, 0.4),
        Rival(place=lambda k, x, y: (x + 0.8 * np.sin(2 * np.pi * x / 11 + 0.4), y)),
    ),
    "edge_misplacement": ((1.4,), Rival(albedo=lambda k, name, x, y: moved(k, name, x, y, 1.4))),
    "scan_misplacement": ((1.4,), Rival(albedo=lambda k, name, x, y: moved(k, name, x, y, 1.4 * in_scan(1)(k)))),
    "scan_angle_error": ((35.0,), Rival(turn_deg=lambda k: 35.0 * in_scan(1)(k))),
    "orientation_error": ((-20.0,), Rival(turn_deg=lambda k: -20.0)),
    "sensor_tilt": ((0.9, -1.3), Rival(place=lambda k, x, y: (x + 0.9, y - 1.3))),
    "height_gradient": ((0.1,), Rival(height=lambda k: H0 * (1 + 0.1 * X[k] / H0))),
    "height_offset": ((1.5,), Rival(height=lambda k: H0 + 1.5 * in_scan(1)(k))),
    "albedo_gradient": (
        (0.004, -0.007),
        Rival(albedo=lambda k, name, x, y: inside(name, x, y) * (1 + 0.004 * x - 0.007 * y)),
    ),
    "albedo_patch": (
        (-0.3, 3.0, -2.0, 5.0),
        Rival(albedo=lambda k, name, x, y: inside(name, x, y) - 0.3 * np.exp(-((x - 3) ** 2 + (y + 2) ** 2) / 50)),
    ),
    "edge_blur": ((2.5,), Rival(albedo=lambda k, name, x, y: soft(name, x, y, 2.5))),
    "edge_shadow": (
        (0.08, 4.0),
        Rival(share=lambda u, k, name, x, y, see: u - 0.08 * np.exp(-(distance(name, x, y) ** 2) / 32)),
    ),
    "halo": (
        (0.15, 12.0),
        Rival(share=lambda u, k, name, x, y, see: 0.85 * u + 0.15 * see(WEIGHTS @ MEANS, 144 * np.eye(2))),
    ),
    "arm_knock": (
        (0.9, -1.3, 20.0, 70.0),
        Rival(
            place=lambda k, x, y: (x + 0.9 * (T[k] > 70.0), y - 1.3 * (T[k] > 70.0)),
            turn_deg=lambda k: 20.0 * (T[k] > 70.0),
        ),
    ),
    "gain_jump": ((0.1, 70.0), Rival(gain=lambda k: 1 + 0.1 * (T[k] > 70.0))),
    "bent_rails": (
        (1.5, -2.0, 1.0, -0.5),
        Rival(place=lambda k, x, y: (x + 0.015 * x**2 - 0.002 * x**3, y + 0.01 * y**2 - 0.0005 * y**3)),
    ),
    "missing_tooth": ((0.7, 2.0, 0.0), Rival(place=lambda k, x, y: (x + 0.7 * (x > 2.0), y))),
    "slow_turn": ((900.0,), Rival(turn_deg=lambda k: 0.25 * T[k])),
    "slow_sinking": ((3.0,), Rival(height=lambda k: H0 * (1 + 3.0 * T[k] / 3600))),
    "overshoot": ((0.2, 5.0), Rival(finish=overshot)),
    "polarisation": (  # the law of Malus: a polarised share p of the light gives 1 - p + 2 p cos^2(psi - phi)
        (0.05 * np.cos(1.6), 0.05 * np.sin(1.6)),
        Rival(gain=lambda k: 0.95 + 0.1 * np.cos(PLAN.orientation_rad[k] - 0.8) ** 2),
    ),
    "glint": ((3.0, 2.0, 1.5, 4.0), Rival(offset=lambda k: 3 * np.exp(-((X[k] - 2) ** 2 + (Y[k] - 1.5) ** 2) / 32))),
}


def chain(*effects):
    return Chain(FixedMixture(WEIGHTS, MEANS, COVS), FixedLevels(I_MIN, I_MAX), KnownScene(PATTERNS), effects)


def effect_of(name):
    found = EFFECTS[name].for_extent(Extent(I_MIN, I_MAX, PLAN)) or EFFECTS[name]()
    return next((variant for variant in found.variants() if variant.scans == ("b",)), found)


def test_no_effect_on_the_mean_is_left_out():
    on_mean = {name for name, kind in EFFECTS.items() if kind.stage is not Stage.NOISE}
    assert set(CASES) == on_mean - {"reflection", "stick_slip"}


def test_the_plain_chain_agrees_with_pixels():
    np.testing.assert_allclose(chain().predict(np.zeros((1, 0)), PLAN)[0], Rival().readings(), atol=1e-4 * 50)


@pytest.mark.parametrize("name", CASES)
def test_an_effect_agrees_with_pixels(name):
    """Within a ten-thousandth of the span, and alone as among other hypotheses."""
    values, rival = CASES[name]
    model = chain(effect_of(name))
    theta = np.array([values, 0.5 * np.array(values), values])
    found = model.predict(theta, PLAN)
    wanted = rival.readings()
    rows = PLAN.pattern != NAMES.index("disc") if name == "edge_blur" else np.ones(16, dtype=bool)
    np.testing.assert_allclose(found[0][rows], wanted[rows], atol=1e-4 * 50)
    np.testing.assert_allclose(found[2], found[0], atol=1e-9)
    np.testing.assert_allclose(model.predict(theta[:1], PLAN)[0], found[0], atol=1e-7)
    assert np.abs(found[0] - chain().predict(np.zeros((1, 0)), PLAN)[0]).max() > 0.3


HEIGHTS = np.append(np.linspace(8.0, 22.0, 15), H0)  # the last is not commanded


@pytest.mark.parametrize(
    ("name", "values", "rival"),
    [
        ("height_gradient", (0.1,), Rival(height=lambda k: HEIGHTS[k] + 0.1 * X[k])),
        ("height_offset", (1.5,), Rival(height=lambda k: HEIGHTS[k] + 1.5 * in_scan(1)(k))),
        ("slow_sinking", (3.0,), Rival(height=lambda k: HEIGHTS[k] + 3.0 * T[k] / 3600 * H0)),
        (
            "sensor_tilt",
            (0.9, -1.3),
            Rival(
                height=lambda k: HEIGHTS[k],
                place=lambda k, x, y: (x + 0.9 * HEIGHTS[k] / H0, y - 1.3 * HEIGHTS[k] / H0),
            ),
        ),
    ],
)
def test_an_error_of_height_adds_to_the_commanded_height(name, values, rival):
    """And a tilt moves the spot in proportion to that height."""
    raised = replace(PLAN, covariates={**PLAN.covariates, "height_mm": np.append(HEIGHTS[:-1], np.nan)})
    found = chain(effect_of(name)).predict(np.array([values]), raised)[0]
    np.testing.assert_allclose(found, rival.readings(), atol=1e-4 * 50)


def test_effects_of_scene_footprint_and_pose_stack_as_physics_does():
    """A blurred, graded, stained and misplaced scene under a raised and tilted sensor, all in one pixel sum."""
    sizes = {
        "albedo_gradient": (0.004, -0.007),
        "albedo_patch": (-0.3, 3.0, -2.0, 5.0),
        "height_offset": (1.5,),
        "sensor_tilt": (0.9, -1.3),
        "edge_shadow": (0.08, 4.0),
    }
    rival = Rival(
        albedo=lambda k, name, x, y: (
            inside(name, x, y) * (1 + 0.004 * x - 0.007 * y) - 0.3 * np.exp(-((x - 3) ** 2 + (y + 2) ** 2) / 50)
        ),
        height=CASES["height_offset"][1].height,
        place=CASES["sensor_tilt"][1].place,
        share=CASES["edge_shadow"][1].share,
    )
    model = chain(*(effect_of(name) for name in reversed(sizes)))
    theta = np.array([[x for effect in model.effects for x in sizes[effect.name]]])
    np.testing.assert_allclose(model.predict(theta, PLAN)[0], rival.readings(), atol=1e-4 * 50)
