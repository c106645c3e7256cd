"""A light sensor on an arm over printed patterns, as an `Apparatus`."""
