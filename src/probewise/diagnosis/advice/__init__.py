"""Advice on the next measurement: aliased effects, possible scans, and the most informative of them."""
