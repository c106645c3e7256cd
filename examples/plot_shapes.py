"""
Shapes and what the sensor reads over them
==========================================

Shows hypotheses drawn from the prior of each shape, and the readings of two sensor models along a line
across a circle: the naive sensor jumps, the sensor with a footprint tells how much of the edge it sees.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

from probewise.inquiry import Grid
from probewise.scene import Circle, Ellipse, HypothesisScene, Rectangle, RegularPolygon, outlines
from probewise.sensor import Chain, FixedLevels, FixedMixture, NaiveSensor

seed = 1
print(f"seed {seed}")
rng = np.random.default_rng(seed)
fig, axes = plt.subplots(2, 2, figsize=(9, 5), sharex=True, sharey=True, layout="constrained")
for ax, shape in zip(axes.flat, (Circle(), Ellipse(), Rectangle(), RegularPolygon(3)), strict=True):
    theta = shape.prior.from_unit_cube(rng.random((8, len(shape.prior.names))))
    for outline in outlines(shape.region(theta)):
        ax.plot(*outline.T)
    ax.set(title=type(shape).__name__, aspect="equal", xlim=(0, 1048), ylim=(0, 520))
fig.supxlabel("x (mm)")
fig.supylabel("y (mm)")

# %%
# Along the line y = 260 mm over a circle of radius 100 mm at (500, 260) mm.
grid = Grid(n_x=525, n_y=3)
plan = grid.plan("field").take(grid.places_mm[:, 1] == 260.0)
scene = HypothesisScene(Circle())
mixture = FixedMixture([1.0], [[0.0, 1.5]], [[[36.0, 0.0], [0.0, 16.0]]])
theta = np.array([[500.0, 260.0, 100.0]])
fig, ax = plt.subplots(figsize=(8, 3.5), layout="constrained")
for name, model in (
    ("naive sensor", NaiveSensor(FixedLevels(10.0, 60.0), scene)),
    ("sensor with a footprint", Chain(mixture, FixedLevels(10.0, 60.0), scene)),
):
    ax.plot(plan.x_mm, model.predict(theta, plan)[0], label=name)
ax.set(xlim=(370, 630), xlabel="x (mm)", ylabel="reading (LEGO units)")
ax.legend(frameon=False)
