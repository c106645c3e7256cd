"""Simulated systems with concealed effects, for challenges; the code is independent of the library's systems.

It produces what a user would provide (a table and a short simulator file) and, separately, the truth; it implements
the integration of laws, the effects and the fits a second time.
"""
