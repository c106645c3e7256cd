"""
A sensor model from a recording
===============================

Shows a sensor model of one Gaussian fitted to the shipped recording (simulated with the paper's plan), and how well it
predicts the readings. The sensor's spatial sensitivity function (SSF) is the weight of each point below it in a
reading. The figures follow the paper's: the data, the SSF, the predictions.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

from probewise.calibration import calibrate, predict
from probewise.recordings import read_recording, shipped
from probewise.report import plots

seed = 1
print(f"seed {seed}")
recording = read_recording(shipped("paper"))
fig, ax = plt.subplots()
plots.readings_by_orientation(recording, ax=ax)

# %%
# One Gaussian, with few live points so that it runs in seconds. The defaults, `orders=(1, 2, 3, 4)` and `n_live=300`,
# compare one to four Gaussians by their evidence.
calibration = calibrate(recording, orders=(1,), n_live=50, rng=np.random.default_rng(seed))
print(calibration.summary())
fig, ax = plt.subplots()
plots.spatial_sensitivity(calibration.sensor.field, ax=ax)

# %%
# Standardised residuals: 95 % should lie between the dashed lines.
prediction = predict(calibration.sensor, recording.plan, recording.readings)
fig, ax = plt.subplots(figsize=(8, 3), layout="constrained")
plots.standardised_residuals(recording, prediction.mean, prediction.sd, ax=ax)
