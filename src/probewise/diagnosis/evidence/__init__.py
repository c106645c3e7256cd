"""What a fit is worth, and what could be added to it: Laplace's evidence, templates and their Bayes factors."""
