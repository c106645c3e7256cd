"""Every sampler by its name: this project's own, and the peers, whose libraries are not imported unasked."""

from __future__ import annotations

from importlib import import_module

from nested_sampling import ours, peers
from nested_sampling.sampler import Sampler

SAMPLERS = ours.SAMPLERS | peers.SAMPLERS
NAMES = tuple(SAMPLERS)


def sampler(name: str) -> Sampler:
    """Find a sampler by its name, and import its libraries.

    Raises
    ------
    ValueError
        If there is none of that name.
    """
    if name not in SAMPLERS:
        raise ValueError(f"sampler is {name!r}; allowed: {', '.join(NAMES)}")
    for library in SAMPLERS[name].libraries:
        import_module(library)
    return SAMPLERS[name]
