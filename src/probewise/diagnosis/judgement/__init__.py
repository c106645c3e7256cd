"""The global test of the null, and the verdict."""
