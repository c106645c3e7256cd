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
# How many Gaussians does the recording ask for? (With 200 live points the error is well below the difference.)
calibration = calibrate(recording, orders=(1, 2), n_live=200, rng=np.random.default_rng(seed))
one, two = calibration.orders
print(f"ln(Z1 / Z2) = {one.log_z - two.log_z:.1f} ± {np.hypot(one.log_z_error, two.log_z_error):.1f}")
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
