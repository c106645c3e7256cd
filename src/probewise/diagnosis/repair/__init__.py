"""The repaired model: posterior samples of one hypothesis, or of all that the readings leave open."""
