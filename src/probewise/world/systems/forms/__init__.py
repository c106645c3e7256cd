"""Every form of the vocabulary, and others outside it, implemented independently for the world."""
