"""
The robot finds a circle
========================

Shows the robot's view of the field as it chooses its own measurements: what a reading would tell at each place,
50 circles drawn from the posterior, the readings, and the next place.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

from probewise.arm import SimulatedArm
from probewise.experiment import Experiment, Exploration, explore
from probewise.inference import GaussianKnown
from probewise.recordings import Disc
from probewise.report import exploration, plots
from probewise.scene import Circle, HypothesisScene
from probewise.sensor import Chain, FixedLevels, FixedMixture
from probewise.world import Blob, World, gaussian_spot

seed = 4
print(f"seed {seed}")
rng = np.random.default_rng(seed)
world = World(gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5))]))
hidden = Disc((600.0, 260.0), 120.0)

# %%
# The sensor model: its spatial sensitivity function (SSF), one Gaussian of 4 mm by 2.5 mm (sd), and the readings of
# black and white. The world above shares no code with it.
circle = Circle(radius_mm=(50.0, 150.0), inside=True)
mixture = FixedMixture([1.0], [[0.0, 1.5]], [[[16.0, 0.0], [0.0, 6.25]]])
model = Chain(mixture, FixedLevels(10.0, 60.0), HypothesisScene(circle))
experiment = Experiment(circle, model, GaussianKnown(0.7), 0.7, n_live=80)
robot = SimulatedArm(lambda at, time_s, height_mm: world.read(hidden, at.x_mm, at.y_mm, time_s=time_s, rng=rng))

# %%
# Measure, infer, inquire.
with robot:
    found = Exploration(experiment, tuple(explore(robot, experiment, rng=rng, max_readings=30)))
print(found.summary())
places = [(r.pose.x_mm, r.pose.y_mm, r.value) for r in found.readings]

# %%
# The view in the middle of the search, and at its end.
for n in (len(found.steps) // 2, len(found.steps)):
    fig, ax = plt.subplots(figsize=(9, 5.4), layout="constrained")
    exploration.draw_robot_view(found.steps[n - 1], experiment, places[:n], levels=(10.0, 60.0), ax=ax)
    plots.draw_field_legend(ax)
