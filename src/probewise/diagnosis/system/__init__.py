"""A person's simulator over a plain table, as an apparatus: its forms, covariates, held-out runs, words."""
