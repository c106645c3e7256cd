"""Residual analysis: global test, location in covariates, and basis functions for unknown effects."""
