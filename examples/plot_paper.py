"""
The paper's method: from a recording to the found circle
========================================================

Shows the paper's steps in its order, by its method alone: the spatial sensitivity function (SSF) of a sensor is
estimated from a recording, then a robot arm finds a circle. Each step is one file that opens with the paper's section.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

from probewise.arm import SimulatedArm
from probewise.calibration import estimate_ssf
from probewise.experiment import find_shape
from probewise.experiment.paper import student_t_likelihood
from probewise.inquiry import Grid, entropy_map
from probewise.recordings import Disc, read_recording, shipped
from probewise.report import plots
from probewise.scene import Circle, HypothesisScene, outlines
from probewise.sensor import Chain, FixedLevels, FixedMixture
from probewise.world import Blob, World, gaussian_spot

seed = 4
print(f"seed {seed}")
rng = np.random.default_rng(seed)

# %%
# "Estimating SSF MoG Model Parameters": one Gaussian, with few live points so that it runs in seconds.
recording = read_recording(shipped("paper"))
((_, posterior, field),) = estimate_ssf(recording, orders=(1,), n_live=50, rng=rng)
print(f"log evidence of one Gaussian {posterior.log_z:.1f} ± {posterior.log_z_error:.1f}")
fig, ax = plt.subplots()
plots.spatial_sensitivity(field, ax=ax)

# %%
# "Robotic Arm Test Bed" and "Models Describing a Light Sensor": an arm over a white circle; its sensor's SSF.
world, hidden = World(gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5))])), Disc((600.0, 260.0), 120.0)
arm = SimulatedArm(lambda at, time_s, height_mm: world.read(hidden, at.x_mm, at.y_mm, time_s=time_s, rng=rng))
circle, levels = Circle(radius_mm=(50.0, 150.0), inside=True), FixedLevels(10.0, 60.0)
model = Chain(FixedMixture([1.0], [[0.0, 1.5]], [[[16.0, 0.0], [0.0, 6.25]]]), levels, HypothesisScene(circle))

# %%
# "The Machine Learning System": measure, infer (nested sampling, fifty circles), inquire (the entropy of what they
# predict), until every length is known to 4 mm.
grid = Grid(n_x=66, n_y=33)
with arm:
    steps = list(find_shape(arm, circle, model, student_t_likelihood(levels, 1.0), grid, bin_width=1.0, rng=rng))
print(f"{len(steps)} readings:", steps[-1][1].summary(), sep="\n")

# %%
# The entropy of the next reading, the fifty circles, and the readings: in the middle, and at the end.
for readings, _, circles in (steps[len(steps) // 2], steps[-1]):
    entropy = entropy_map(model, circles, grid, grid.plan("field"), reachable=arm.reachable(grid.places_mm))
    fig, ax = plt.subplots(figsize=(9, 4.6), layout="constrained")
    shown = ax.imshow(entropy.image, origin="lower", extent=(0, 1048, 0, 520), cmap="viridis")
    fig.colorbar(shown, label=entropy.label)
    for outline in outlines(circle.region(circles)):
        ax.plot(*outline.T, color="white", linewidth=0.5)
    ax.scatter(*np.array([(r.pose.x_mm, r.pose.y_mm) for r in readings]).T, color="tab:red", zorder=3)
    ax.set(xlabel="x (mm)", ylabel="y (mm)", title=f"after {len(readings)} readings")
