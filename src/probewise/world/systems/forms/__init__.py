"""Every form of the vocabulary, and strangers to it, in the world's own words."""
