# %%
# # A robot that doubts its sensor
# The paper under the robot is uneven: its white fades by 30 % from the left of the field to the right. The sensor
# model leaves that out. Two robots look for the same circle: one trusts its sensor model, the other expects with
# probability 0.1 that an effect is missing from it.
import numpy as np

from probewise.arm import SimulatedArm
from probewise.experiment import Experiment, Exploration, explore, left_out_after_step
from probewise.inference import GaussianKnown
from probewise.recordings import Disc
from probewise.report import exploration, plots
from probewise.scene import Circle, HypothesisScene, outlines
from probewise.sensor import Chain, FixedLevels, FixedMixture
from probewise.world import Blob, World, gaussian_spot
from probewise.world.concealed import albedo_gradient

seed = 4
print(f"seed {seed}")
spot = gaussian_spot([Blob(1.0, (0.0, 1.5), (4.0, 2.5))])
fading = albedo_gradient(-0.3 / 1048, 0.0)  # per mm along X; the field is 1048 mm wide
world = World(spot, black=10.0, white=60.0, noise_sd=0.7, concealed=(fading,))
hidden = Disc((600.0, 260.0), 120.0)

# %%
# What both robots know: the shape is a circle, black reads 10 LEGO units and white 60, and what the sensor sees. The
# readings come from a world that shares no code with this model.
circle = Circle(radius_mm=(50.0, 150.0), inside=True)
mixture = FixedMixture([1.0], [[0.0, 1.5]], [[[16.0, 0.0], [0.0, 6.25]]])
model = Chain(mixture, FixedLevels(10.0, 60.0), HypothesisScene(circle))


def explored(trust):
    """Let the robot find the circle, with a prior probability `trust` that its sensor model is complete."""
    rng = np.random.default_rng(seed)

    def light(at, time_s, height_mm):
        return world.read(hidden, at.x_mm, at.y_mm, time_s=time_s, rng=rng)

    with SimulatedArm(light, scale=None) as arm:  # readings are not rounded
        experiment = Experiment(circle, model, GaussianKnown(0.7), 0.7, trust=trust)
        return Exploration(experiment, tuple(explore(arm, experiment, rng=rng, max_readings=30)))


trusting, doubting = explored(1.0), explored(0.9)

# %%
# The outcome of both. Each robot stops when it knows the centre and the radius to 4 mm, or after 30 readings.
truth = np.array([*hidden.center_mm, hidden.radius_mm])
for name, found in (("trusts its sensor", trusting), ("doubts its sensor", doubting)):
    off_mm, sd_mm = np.abs(found.last.mean - truth).max(), found.sd.max()
    print(f"The robot that {name}: {len(found.readings)} readings, off by {off_mm:.1f} mm, sd up to {sd_mm:.1f} mm")

# %%
# Both posteriors, side by side: blue circles drawn from the posterior, squares where the robot read. Dashed: the true
# circle.
axes = plots.grid_of_axes(1, 2, size_in=(13.0, 4.2))
outline_mm = outlines(circle.region(truth[None]))[0]
for ax, name, found in zip(axes[0], ("trusting", "doubting"), (trusting, doubting), strict=True):
    places = [(r.pose.x_mm, r.pose.y_mm, r.value) for r in found.readings]
    title = f"{name}, after {len(places)} readings"
    exploration.draw_robot_view(
        found.last, found.experiment, places, levels=(10.0, 60.0), truth_mm=outline_mm, title=title, ax=ax
    )
plots.draw_field_legend(axes)

# %%
# What the second robot believes about its sensor after each reading. A dashed line marks a reading that changed the
# most probable effect.
beliefs = [left_out_after_step(step, 0.9).probability for step in doubting.steps]
plots.effect_probabilities_by_reading(beliefs)

# %%
# The same in a sentence, with the size of the effect. What looks alike, as a fading print and a sloping table, stays
# open.
left_out_after_step(doubting.last, 0.9).sentence
