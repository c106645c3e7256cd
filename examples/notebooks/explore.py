# %%
# # Let the robot find a circle
# The simulated arm stands over a field with a hidden circle; its readings come from a world that shares no
# code with the sensor model.
import numpy as np

from probewise.arm import SimulatedArm
from probewise.experiment import Experiment, Exploration, explore
from probewise.inference import GaussianKnown
from probewise.recordings import Disc
from probewise.scene import Circle, HypothesisScene
from probewise.sensor import Chain, FixedLevels, FixedMixture
from probewise.world import Blob, World, gaussian_spot

seed = 4
print(f"seed {seed}")
rng = np.random.default_rng(seed)
world = World(gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5))]))
hidden = Disc((600.0, 260.0), 120.0)
robot = SimulatedArm(lambda at, time_s, height_mm: world.read(hidden, at.x_mm, at.y_mm, time_s=time_s, rng=rng))

# %%
# What the robot knows: that it is a circle, and what its sensor sees.
circle = Circle(radius_mm=(50.0, 150.0), inside=True)
mixture = FixedMixture([1.0], [[0.0, 1.5]], [[[16.0, 0.0], [0.0, 6.25]]])
model = Chain(mixture, FixedLevels(10.0, 60.0), HypothesisScene(circle))
experiment = Experiment(circle, model, GaussianKnown(0.7), 0.7, n_live=80)

# %%
# Measure, infer, inquire, until every length is known to 4 mm.
with robot:
    found = Exploration(experiment, tuple(explore(robot, experiment, rng=rng, max_readings=30)))
found

# %%
# The posterior of the circle after the last reading, with its errors in a sentence.
found.posterior
