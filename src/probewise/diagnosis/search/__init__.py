"""Which hypotheses are true: prior odds, refits, what has been weighed, and the second weighing by nested sampling."""
