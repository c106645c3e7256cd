"""Benchmarks of nested sampling: problems with known evidence, peers, calibration over seeds, cost against size."""
