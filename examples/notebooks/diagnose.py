# %%
# # What does the sensor model leave out?
# The second recording that ships with the package conceals something.
import numpy as np

from probewise.diagnosis import diagnose
from probewise.recordings import read_recording, shipped

seed = 1
print(f"seed {seed}")
recording = read_recording(shipped("concealed"))
diagnosis = diagnose(recording, rng=np.random.default_rng(seed))
diagnosis

# %%
# The same in words, with the gain on held-out readings.
print(diagnosis.summary())
