"""
A robot that doubts its sensor
==============================

The sensor saturates, and its model leaves that out. A robot that trusts the model finds a circle in the wrong place and
is sure of it; one that doubts the model finds out what it leaves out, and where the circle is.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

from probewise.arm import SimulatedArm
from probewise.experiment import Experiment, Exploration, explore, left_out_after_step
from probewise.inference import GaussianKnown
from probewise.recordings import Disc
from probewise.report import exploration, plots
from probewise.scene import Circle, HypothesisScene
from probewise.sensor import Chain, FixedLevels, FixedMixture
from probewise.world import Blob, World, gaussian_spot, saturation

seed = 4
print(f"seed {seed}")
hidden = Disc((600.0, 260.0), 120.0)
spot = gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5))])
world = World(spot, black=10.0, white=60.0, noise_sd=0.7, concealed=(saturation(40.0),))

# %%
# The model: black reads 10, white 60. The converter of the true sensor stops at 40.
circle = Circle(radius_mm=(50.0, 150.0), inside=True)
mixture = FixedMixture([1.0], [[0.0, 1.5]], [[[16.0, 0.0], [0.0, 6.25]]])
model = Chain(mixture, FixedLevels(10.0, 60.0), HypothesisScene(circle))


def explored(trust):
    """Let the robot find the circle, with a prior probability `trust` that nothing is left out."""
    rng = np.random.default_rng(seed)

    def light(at, time_s, height_mm):
        return world.read(hidden, at.x_mm, at.y_mm, time_s=time_s, rng=rng)

    arm = SimulatedArm(light, scale=None)  # readings are not rounded
    experiment = Experiment(circle, model, GaussianKnown(0.7), 0.7, trust=trust)
    with arm:
        return experiment, Exploration(experiment, tuple(explore(arm, experiment, rng=rng, max_readings=30)))


# %%
# The same circle twice: with trust 1, and with trust 0.9, the default of ``probewise explore``.
runs = {trust: explored(trust) for trust in (1.0, 0.9)}
truth = np.array([*hidden.center_mm, hidden.radius_mm])
for trust, (_, found) in runs.items():
    off, sd = np.abs(found.last.mean - truth).max(), found.last.sd.max()
    print(f"trust {trust:g}: {len(found.readings)} readings, off by {off:.1f} mm, sd up to {sd:.1f} mm")

# %%
# Where each of them believes the circle to be.
fig, axes = plt.subplots(2, 1, figsize=(9, 10), layout="constrained")
for ax, (trust, (experiment, found)) in zip(axes, runs.items(), strict=True):
    places = [(r.pose.x_mm, r.pose.y_mm, r.value) for r in found.readings]
    exploration.draw_robot_view(found.last, experiment, places, levels=(10.0, 60.0), ax=ax)
    ax.add_patch(plt.Circle(hidden.center_mm, hidden.radius_mm, fill=False, linestyle=":", linewidth=2, color="white"))
    ax.set_title(f"{'trusting' if trust == 1 else 'doubting'} robot (dotted: the true circle)", loc="right")

# %%
# What the second robot believes about its sensor, reading by reading.
_, doubting = runs[0.9]
beliefs = [left_out_after_step(step, 0.9).probability for step in doubting.steps]
plots.effect_probabilities_by_reading(beliefs)
plt.show()
