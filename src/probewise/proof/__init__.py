"""What proves the package: studies of the robot and challenges of the diagnosis, each a campaign of many runs.

A study (paper, section 4, "Results") counts the readings that the robot needs, over many circles. A challenge conceals
effects in simulated sensors and systems, lets the diagnosis see the recordings alone, and scores what it says. Nothing
else of the package imports this one but the two verbs.
"""
