"""Fit, diagnosis and audit of a user's simulator over a table of rows."""
