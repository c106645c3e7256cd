# %%
# # Calibrate a sensor
# A recording becomes a sensor model. Results show themselves.
import numpy as np

from probewise.calibration import calibrate, predict
from probewise.recordings import read_recording, shipped

seed = 1
print(f"seed {seed}")
recording = read_recording(shipped("paper"))
recording

# %%
# How many Gaussians does the recording ask for? (Few live points, so that this runs in seconds.)
calibration = calibrate(recording, orders=(1, 2), n_live=40, rng=np.random.default_rng(seed))
calibration

# %%
# The chosen sensor, with its parameters.
calibration.sensor

# %%
# The nested run behind it.
calibration.chosen.result

# %%
# Predictions: chi-square per reading should be near one.
prediction = predict(calibration.sensor, recording.plan, recording.readings)
z = (recording.readings - prediction.mean) / prediction.sd
print(f"chi-square per reading {np.mean(z**2):.2f}")
