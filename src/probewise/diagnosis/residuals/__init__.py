"""Analysis of residuals: p-values, ranges of covariates where they show, and basis functions for unknown effects."""
