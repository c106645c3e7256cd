"""A narrow peak above the end of a run is found; where there is none, little is spent and nothing is said."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from nested_sampling import hard, problems

from probewise.nested import check
from probewise.nested.missed import HillEstimate, MissedHills, find_missed_hills, log_evidence_of_unmet_hills
from probewise.nested.moves import SliceMove
from probewise.nested.sampler import least_live, run_once


@pytest.mark.slow
def test_a_spike_that_no_live_point_met_is_found_and_weighed() -> None:
    """Nine of ten such spikes are found, so that all three seeds miss theirs once in a thousand."""
    known = hard.spike_on_slab()
    found = []
    for seed in range(3):
        rng = np.random.default_rng([seed, 20])
        run = run_once(known, rng=rng, n_live=300)
        assert run.log_z < known.log_z - 3  # not met by the run
        missing = find_missed_hills(run, known, max_calls=run.n_calls, rng=rng)
        found.append(log_evidence_of_unmet_hills((*missing.lost, *missing.above), run))
    assert any(abs(log_z - known.log_z) < 1.5 for log_z in found)


@pytest.mark.parametrize("name", ["Gaussian 4-D", "circle", "shells 2-D"])
def test_where_there_is_no_higher_peak_nothing_is_found_for_a_third_of_the_cost(name: str) -> None:
    known = problems.problem(name)
    run = run_once(known, rng=np.random.default_rng(1), n_live=100)
    missing = find_missed_hills(run, known, max_calls=10 * run.n_calls, rng=np.random.default_rng(2))
    assert not missing.above
    assert missing.n_calls <= run.n_calls / 3


def test_with_hardly_any_evaluations_left_no_more_are_used() -> None:
    known = problems.problem("Gaussian 4-D")
    run = run_once(known, rng=np.random.default_rng(1), n_live=100)
    assert find_missed_hills(run, known, max_calls=10, rng=np.random.default_rng(2)).n_calls <= 10


@pytest.mark.parametrize(("above_it", "doubted"), [(3.0, True), (-6.0, False)])
def test_a_peak_that_holds_much_of_the_evidence_is_a_doubt(
    monkeypatch: pytest.MonkeyPatch, above_it: float, doubted: bool
) -> None:
    known = problems.problem("Gaussian 4-D")
    run = run_once(known, rng=np.random.default_rng(1), n_live=100)
    hill = SimpleNamespace(log_z=run.log_z + above_it, is_met_by=lambda _: False)
    missing = MissedHills((), (cast(HillEstimate, hill),), 77)
    monkeypatch.setattr(check, "find_missed_hills", lambda *_, **__: missing)
    result = check.check_and_repeat(
        run,
        known,
        SliceMove(),
        run_once,
        max_cost=5.0,
        max_calls=None,
        least_live=least_live(4),
        rng=np.random.default_rng(2),
    )
    assert any("narrow peak" in note for note in result.warnings) == doubted
    assert result.check is not None
    assert result.n_calls == run.n_calls + result.check.n_calls
