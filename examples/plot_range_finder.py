"""
A range finder looks for a wall
===============================

Shows an inquiry with an ultrasonic range finder on a turntable: it chooses the bearing of each reading until it knows
how far a wall is and how it stands. One reading in ten is an echo of something else, and says nothing of the wall.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

from probewise import Inquiry
from probewise.inquiry import ReadingNoise
from probewise.priors import Uniform

seed = 5
print(f"seed {seed}")
rng = np.random.default_rng(seed)
RANGE_MM = 4000.0  # the greatest reading: a farther wall reads as this


# %%
# The wall is a line: its distance from the turntable, and the bearing at which it is nearest. A beam that does not meet
# it within range reads the greatest range.
def echo(p, bearing_rad):
    towards = np.cos(bearing_rad - p["normal_rad"])
    return np.minimum(p["distance_mm"] / np.maximum(towards, 1e-3), RANGE_MM)


prior = {"distance_mm": Uniform(300.0, 3000.0), "normal_rad": Uniform(-np.pi, np.pi)}
bearings_rad = np.radians(np.arange(-180.0, 180.0, 3.0))
noise = ReadingNoise(30.0, outliers=0.1, between=(0.0, RANGE_MM))
goal = {"distance_mm": 15.0, "normal_rad": np.radians(1.0)}

# %%
# Turning takes time: a second for each 60 degrees, and half a second for the reading. The utility is per second.


def seconds(last_rad):
    away = 0.0 if last_rad is None else np.abs((bearings_rad - last_rad + np.pi) % (2 * np.pi) - np.pi)
    return 0.5 + np.degrees(away) / 60.0 * np.ones(len(bearings_rad))


inquiry = Inquiry(echo, prior, bearings_rad, noise, goal=goal, cost_s=seconds, rng=rng)
hidden = {"distance_mm": 1300.0, "normal_rad": 2.1}
views, took_s = [], 0.0
while not inquiry.settled:
    if len(inquiry.readings) in (2, 4):
        views.append((inquiry.readings, inquiry.posterior, inquiry.utility, inquiry.next()))
    bearing_rad = inquiry.next()
    last_rad = inquiry.readings[-1][0] if inquiry.readings else None
    took_s += seconds(last_rad)[np.argmin(np.abs(bearings_rad - bearing_rad))]
    reading_mm = noise.draw(np.array([[echo(hidden, bearing_rad)]]), np.array([[30.0]]), rng=rng).item()
    inquiry.tell(reading_mm)
views.append((inquiry.readings, inquiry.posterior, inquiry.utility, None))
print(inquiry.summary())
print(f"{took_s:.0f} s of turning and reading")


# %%
# What is believed (blue: 50 walls drawn from the posterior), the readings, the next bearing (dotted), and the
# utility of a reading at each bearing (the ring; darker is more).
def ends(distance, normal):
    foot = distance * np.array([np.cos(normal), np.sin(normal)])
    along = 6000.0 * np.array([-np.sin(normal), np.cos(normal)])
    return np.stack([foot - along, foot + along], axis=1)


fig, axes = plt.subplots(1, len(views), figsize=(13, 4.9), layout="constrained", sharey=True)
for (readings, posterior, worth, chosen), ax in zip(views, axes, strict=True):
    for distance, normal in posterior.samples(50, rng=rng):
        ax.plot(*ends(distance, normal), color="tab:blue", alpha=0.2, linewidth=1)
    ax.plot(*ends(*hidden.values()), "k--", linewidth=1.2, label="hidden wall")
    at, read = (np.array(column) for column in zip(*readings, strict=True))
    ax.plot(read * np.cos(at), read * np.sin(at), "o", color="tab:orange", markeredgecolor="k", label="readings")
    ring = ax.scatter(3800 * np.cos(bearings_rad), 3800 * np.sin(bearings_rad), c=worth, cmap="copper_r", s=14)
    fig.colorbar(ring, ax=ax, shrink=0.8, label="utility of a reading per second")
    if chosen is not None:
        ax.plot([0, 3800 * np.cos(chosen)], [0, 3800 * np.sin(chosen)], ":", color="tab:brown", label="next")
    ax.plot(0, 0, "k^", markersize=8, label="range finder")
    ax.set(
        title=f"after {len(readings)} readings", xlabel="x (mm)", xlim=(-4100, 4100), ylim=(-4100, 4100), aspect="equal"
    )
axes[0].set_ylabel("y (mm)")
fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
