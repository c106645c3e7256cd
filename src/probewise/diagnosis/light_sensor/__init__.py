"""A light sensor on an arm, over printed patterns: what the engine asks of the apparatus behind its readings."""
