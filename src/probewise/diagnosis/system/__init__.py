"""A user's simulator over a table, as an `Apparatus`: forms, covariates, held-out runs, words."""
