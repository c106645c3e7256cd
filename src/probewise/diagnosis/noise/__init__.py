"""The law of the noise: normal or with a tail, remembering or rounded, and the models that lay such laws out."""
