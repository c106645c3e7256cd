"""Forms of effects, in the vocabulary and outside, implemented for the simulator alone."""
