"""The sensor's height is one more thing that the robot may choose."""

from dataclasses import replace

import numpy as np
import pytest

from probewise.arm import Pose
from probewise.errors import ParameterError, ReachError
from probewise.experiment import arm_over, explore, read_journal
from probewise.inference import GaussianKnown
from probewise.inquiry import Grid
from probewise.recordings import Disc, Instrumentation, Plan
from probewise.scene import Circle, Field, HypothesisScene
from probewise.sensor import FAST_NODES, Chain, FixedLevels, FixedMixture
from probewise.world import Blob, World, gaussian_spot

FIELD = Field(300.0, 200.0)
CIRCLE = Circle(FIELD, (40.0, 80.0), inside=True)
TRUTH = np.array([140.0, 100.0, 60.0])
MIXTURE = FixedMixture(np.ones(1), np.array([[1.0, 1.5]]), np.array([[[16.0, 2.0], [2.0, 9.0]]]))
CHAIN = Chain(MIXTURE, FixedLevels(10.0, 60.0), HypothesisScene(CIRCLE), n_nodes=FAST_NODES)
WORLD = World(
    gaussian_spot([Blob(1.0, (1.0, 1.5), (4.0, 3.0), 1 / 6)], pixel_mm=0.5), black=10.0, white=60.0, noise_sd=0.0
)
DISC = Disc((140.0, 100.0), 60.0)
HEIGHTS = (12.0, 21.0)


def asked(small, **changes):
    options = {
        "shape": CIRCLE,
        "model": CHAIN,
        "likelihood": GaussianKnown(1.0),
        "grid": Grid(300.0, 200.0, 13, 9),
        "n_particles": 300,
        "heights_mm": HEIGHTS,
        "calibrated_height_mm": 14.0,
    }
    return small.experiment(**(options | changes))


@pytest.mark.parametrize("height_mm", HEIGHTS)
def test_world_and_chain_agree_on_what_another_height_does(height_mm):
    """Sums over pixels against closed forms: a footprint h/h0 as large, a signal (h0/h)^2 as strong."""
    angle = np.linspace(0.0, 6.0, 7)
    away_mm = 60.0 + 2.0 * np.sin(3.0 * angle)
    x_mm, y_mm = 140.0 + away_mm * np.cos(angle), 100.0 + away_mm * np.sin(angle)
    zeros = np.zeros(len(x_mm), dtype=np.int64)
    plan = Plan(
        x_mm,
        y_mm,
        *np.zeros((2, len(x_mm))),
        zeros,
        ("0",),
        zeros,
        ("field",),
        covariates={"height_mm": np.full(len(x_mm), height_mm)},
        instrumentation=Instrumentation(height_mm=14.0),
    )
    read = [WORLD.read(DISC, x, y, time_s=0.0, rng=None, height_mm=height_mm) for x, y in zip(x_mm, y_mm, strict=True)]
    assert CHAIN.predict(TRUTH[None], plan)[0] == pytest.approx(np.array(read), abs=0.5)


def test_every_height_is_a_design_and_the_lowest_signal_is_strongest(small):
    experiment = asked(small)
    assert [design.settings for design in experiment.designs.setting_combinations] == [
        (("height_mm", h),) for h in HEIGHTS
    ]
    arm = arm_over(replace(WORLD, noise_sd=1.0), DISC, FIELD, seed=1)
    with arm:
        first = next(explore(arm, experiment, rng=np.random.default_rng(1)))
    best = first.map.values.reshape(len(HEIGHTS), -1).max(axis=1)
    assert best[0] > best[1]
    assert first.reading.covariates["height_mm"] == first.reading.pose.height_mm


@pytest.mark.slow
def test_a_run_with_heights_finds_the_circle_and_is_resumed(small, tmp_path):
    path = tmp_path / "journal.jsonl"

    def run(n):
        taken = read_journal(path).readings if path.exists() else ()
        with arm_over(replace(WORLD, noise_sd=1.0), DISC, FIELD, seed=1, taken=taken) as arm:
            return list(explore(arm, asked(small), rng=np.random.default_rng(2), max_readings=n, journal=path))

    begun, whole = run(2), run(20)
    assert [step.reading for step in whole[:2]] == [step.reading for step in begun]
    assert whole[-1].stop_reason == "every length is known to better than 4 mm"
    assert np.abs(whole[-1].mean - TRUTH).max() < 4 * whole[-1].sd.max()
    assert all(step.reading.pose.height_mm in HEIGHTS for step in whole)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"calibrated_height_mm": None}, "calibrated_height_mm"),
        ({"heights_mm": ()}, "calibrated_height_mm"),
        ({"heights_mm": (0.0, 14.0)}, "heights_mm"),
        ({"heights_mm": (14.0, 1e9)}, "heights_mm is .* 1000000000.0.*calibrated at"),
    ],
)
def test_heights_that_mean_nothing_are_refused(small, change, name):
    with pytest.raises(ParameterError, match=name):
        asked(small, **change)


def test_an_arm_without_that_height_says_so():
    arm = arm_over(WORLD, DISC, FIELD, seed=1)
    with arm, pytest.raises(ReachError, match=r"height_mm is -1.0; allowed: above the surface"):
        arm.measure(Pose(140.0, 100.0, height_mm=-1.0))
