"""The same seed gives the same repaired model in every process."""

from types import SimpleNamespace

import numpy as np

from probewise.diagnosis.repair import ensemble
from probewise.diagnosis.repair.ensemble import HypothesisSamples


def test_rivals_of_equal_probability_are_averaged_in_their_order(monkeypatch):
    """Before, they were taken from a set, whose order Python chooses anew in every process, and with it the draws."""
    names = [(f"depends:p{k}:c",) for k in range(12)]
    asked = []

    def candidate(own):
        model = SimpleNamespace(effects=())
        return SimpleNamespace(
            names=own, found=SimpleNamespace(model=model), evidence={(): SimpleNamespace(log_z=0.0)}, n_gaussians=0
        )

    def candidates_of_same_form(best, own):
        asked.append(own)
        return [candidate(own)]

    cached = SimpleNamespace(
        noise=(),
        rng=np.random.default_rng(0),
        searched=SimpleNamespace(nulls=[None], prepared=SimpleNamespace(recording=SimpleNamespace(plan=None))),
        averaged_over_orders=lambda own: SimpleNamespace(n_gaussians=0),
        _candidates_of_same_form=candidates_of_same_form,
    )
    monkeypatch.setattr(ensemble, "mix_over_hypotheses", lambda parts, *args, **options: len(parts))
    probabilities = dict.fromkeys(names, 1 / 12)
    assert HypothesisSamples.averaged_over_hypotheses(cached, candidate(names[3]), probabilities) == 6
    assert asked == [names[k] for k in (0, 1, 2, 4, 5)]
