"""A short search for a circle by a simulated arm, as pages of a search show it."""

from probewise.arm import SimulatedArm
from probewise.experiment import Experiment
from probewise.inference import GaussianKnown
from probewise.inquiry import Grid, ReadingEntropy
from probewise.recordings import Disc
from probewise.scene import Circle, HypothesisScene
from probewise.sensor import Chain, FixedLevels, FixedMixture
from probewise.world import Blob, World, gaussian_spot


def arm_and_experiment(truth, rng):
    """An arm over a circle (x, y, radius in mm), and a search for it."""
    world = World(gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5))]))
    hidden = Disc(truth[:2], truth[2])
    arm = SimulatedArm(lambda at, time_s, height_mm: world.read(hidden, at.x_mm, at.y_mm, time_s=time_s, rng=rng))
    circle = Circle(radius_mm=(50.0, 150.0), inside=True)
    mixture = FixedMixture([1.0], [[0.0, 1.5]], [[[16.0, 0.0], [0.0, 6.25]]])
    model = Chain(mixture, FixedLevels(10.0, 60.0), HypothesisScene(circle))
    grid = Grid(n_x=66, n_y=33)
    return arm, Experiment(circle, model, GaussianKnown(0.7), 0.7, grid, ReadingEntropy(), n_live=60, n_particles=500)
