"""Distributions of the noise (normal, heavy-tailed, correlated, rounded), and noise models built from effects."""
