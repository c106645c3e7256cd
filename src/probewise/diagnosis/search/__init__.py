"""Search for the combinations of effects that explain a recording: refits, evidences, probabilities."""
