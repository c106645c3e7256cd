"""Effects that nearly all hypotheses share: certain, although no combination of them with others is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from probewise.diagnosis.names import Names

OUT_OF_THE_QUESTION = 0.2
"""Share of a leader's probability up to which its rivals are not credible; priors differ by less."""

_NO_NAMES = ("unknown",)


def shared_effects(probabilities: Mapping[Names, float]) -> Names:
    """Return the effects that are in nearly all hypotheses at once, sorted; () if there are none.

    The hypotheses without one of them have together at most a fifth of the probability of those with all of them, so
    that no alias of one is credible. `probabilities` are by the effects of each hypothesis.
    """
    total, shared = sum(probabilities.values()), frozenset[str]()
    for name in _most_probable_first(probabilities):
        with_all = sum(p for names, p in probabilities.items() if shared | {name} <= {*names})
        if total - with_all <= OUT_OF_THE_QUESTION * with_all:
            shared |= {name}
    return tuple(sorted(shared))


def probabilities_beside(shared: Names, probabilities: Mapping[Names, float]) -> dict[Names, float]:
    """Return, most probable first, what acts beside shared effects: () for nothing more, and its probability.

    Hypotheses that lack one of the shared effects are left out.
    """
    beside = {
        tuple(name for name in names if name not in shared): p
        for names, p in probabilities.items()
        if {*shared} <= {*names}
    }
    return dict(sorted(beside.items(), key=lambda item: -item[1]))


def _most_probable_first(probabilities: Mapping[Names, float]) -> Iterator[str]:
    """Iterate over all effects, those first that are in hypotheses of the largest probability."""
    of_effect: dict[str, float] = {}
    for names, p in probabilities.items():
        for name in names if names != _NO_NAMES else ():
            of_effect[name] = of_effect.get(name, 0.0) + p
    yield from sorted(of_effect, key=lambda name: (-of_effect[name], name))
