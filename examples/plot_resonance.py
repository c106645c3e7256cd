"""
The peak of a resonance
=======================

Shows an inquiry over the settings of an instrument that sees no field of shapes: a signal generator whose frequency is
the setting, and a resonance with unknown centre, width, height and background. What is asked for is the centre, to
5 MHz.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

from probewise import Inquiry
from probewise.priors import Normal, Uniform

seed = 3
print(f"seed {seed}")
rng = np.random.default_rng(seed)


# %%
# The model predicts a reading from the parameters, by name, and the settings. The noise of a reading has a known sd.
def peak(p, frequency_ghz):
    return p["background"] + p["height"] / (1 + ((frequency_ghz - p["centre_ghz"]) / p["width_ghz"]) ** 2)


prior = {
    "centre_ghz": Uniform(2.0, 4.0),
    "width_ghz": Uniform(0.02, 0.2),
    "height": Uniform(0.5, 2.0),
    "background": Normal(0.0, 0.5),
}
frequencies_ghz = np.linspace(1.5, 4.5, 301)
inquiry = Inquiry(peak, prior, frequencies_ghz, 0.1, goal={"centre_ghz": 0.005}, rng=rng)

# %%
# Measure, infer, inquire. Here the instrument is the model with hidden parameters and noise.
hidden = {"centre_ghz": 3.37, "width_ghz": 0.06, "height": 1.2, "background": 0.2}
views = []
while not inquiry.settled:
    if len(inquiry.readings) in (2, 4):
        views.append((inquiry.readings, inquiry.posterior, inquiry.utility, inquiry.utility_label, inquiry.next()))
    inquiry.tell(peak(hidden, inquiry.next()) + 0.1 * rng.standard_normal())
views.append((inquiry.readings, inquiry.posterior, inquiry.utility, inquiry.utility_label, None))
print(inquiry.summary())

# %%
# What is believed (blue: 50 peaks drawn from the posterior), what was read, and what the next reading promises.
fig, axes = plt.subplots(2, len(views), figsize=(12, 5.5), sharex=True, height_ratios=[2, 1], layout="constrained")
for (readings, posterior, worth, label, chosen), (above, below) in zip(views, axes.T, strict=True):
    drawn = posterior.samples(50, rng=rng)
    curves = peak(dict(zip(posterior.names, drawn.T[:, :, None], strict=True)), frequencies_ghz)
    above.plot(frequencies_ghz, curves.T, color="tab:blue", alpha=0.15)
    true = peak(hidden, frequencies_ghz)
    above.plot(frequencies_ghz, true, "k--", linewidth=1, label="true peak, hidden from the inquiry")
    above.plot(*zip(*readings, strict=True), "o", color="tab:orange", markeredgecolor="k", label="readings")
    above.set(title=f"after {len(readings)} readings", ylim=(-0.6, 2.6))
    below.plot(frequencies_ghz, worth, color="tab:brown")
    if chosen is not None:
        for ax in (above, below):
            ax.axvline(chosen, color="tab:brown", linestyle=":", label="next")
    below.set_xlabel("frequency (GHz)")
    below.set_title(label, fontsize="small")
axes[0, 0].set_ylabel("signal (V)")
fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
