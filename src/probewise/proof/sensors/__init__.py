"""Challenge cases: simulated recordings that conceal an effect of a known size, drawn from a secret seed.

A case's sensor, plan, noise and effect follow from the seed and its number alone; its held-out readings come from the
same world. The size lambda of an effect is the norm of its residuals after a refit of the null model, in noise sds; the
caller supplies a function for that refit.
"""
