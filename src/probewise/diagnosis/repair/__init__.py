"""The repaired model: posterior samples of one hypothesis, or averaged over hypotheses."""
