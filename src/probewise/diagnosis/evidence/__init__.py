"""Evidence of fits by Laplace's approximation, and Bayes factors of effects to add, by templates."""
