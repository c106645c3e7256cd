"""Analysis of residuals: p-values, places in covariates, and basis functions for unknown effects."""
