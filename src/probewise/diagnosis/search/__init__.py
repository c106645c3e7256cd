"""Search for the best hypotheses: refits, evidences, and a second evidence by nested sampling."""
