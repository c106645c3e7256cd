"""
What does the model leave out?
==============================

Shows how a recording that the sensor model without effects does not explain is diagnosed: which physics is missing,
where it shows, and what the repaired model gains on held-out readings.
"""

# %%
import matplotlib.pyplot as plt
import numpy as np

from probewise.diagnosis import diagnose
from probewise.recordings import read_recording, shipped
from probewise.report import plots

seed = 1
print(f"seed {seed}")
recording = read_recording(shipped("concealed"))
diagnosis = diagnose(recording, rng=np.random.default_rng(seed))
print(diagnosis.summary())

# %%
# The hypotheses with a probability above 0.001; all together sum to one.
fig, ax = plt.subplots(figsize=(8, 4))
likely = [h for h in diagnosis.hypotheses if h.probability > 1e-3]
plots.hypothesis_probabilities([h.label for h in likely], [h.probability for h in likely], ax=ax)
fig.tight_layout()

# %%
# Residuals against the predicted reading, before and after the repair.
before, after = diagnosis.before, diagnosis.after
axes = plots.residuals_against_covariates(
    [("predicted reading (LEGO units)", before.readings)],
    [("as calibrated", before.residuals), ("repaired", after.residuals)],
    unit="LEGO units",
)
