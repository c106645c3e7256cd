"""Audit of a plan before any data: undetectable effects, aliased effects, and readings that would help."""
