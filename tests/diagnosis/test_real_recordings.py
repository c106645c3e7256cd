"""Recordings by real instruments, where they are at hand: what docs/explanation/diagnosis-measured.md says of them."""

import os
from pathlib import Path

import numpy as np
import pytest
from real_recordings import kept_back
from refitted import state_with_nulls

from probewise.diagnosis import diagnose
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.search import select_forward
from probewise.recordings import read_recording
from probewise.systems import read_simulator, read_table_for

REAL = Path(os.environ.get("PROBEWISE_REAL", Path(__file__).parents[2].parent / "shared" / "real"))


def at_hand(name):
    path = REAL / name
    if not path.exists():
        pytest.skip(f"{path} is not at hand; set PROBEWISE_REAL to the folder of the real recordings")
    return path


def real(name):
    return read_recording(at_hand(name))


@pytest.mark.slow
def test_a_bent_response_predicts_the_charts_edges_that_were_kept_back():
    plain, bent = kept_back(real("chart/chart_edges.csv"), [("nonlinearity",)])
    assert bent.rms < 0.9 * plain.rms
    assert bent.gain > 4 * bent.gain_error


@pytest.mark.slow
def test_a_soft_edge_does_not():
    _, blurred = kept_back(real("chart/chart_edges.csv"), [("edge_blur",)])
    assert blurred.gain < 2 * blurred.gain_error


@pytest.mark.slow
def test_the_knife_edge_asks_for_more_than_a_beam_of_one_gaussian_and_for_no_physics():
    """Readings in whole microwatts, of less noise than that: what rounding leaves of a smooth beam is no memory."""
    found = diagnose(real("knife_edge/knife_edge.csv"), rng=np.random.default_rng(2013))
    assert found.combination in ((), ("unknown",))
    assert found.noise.model == "white"
    assert found.unknown_probability + found.clean_probability > 0.9
    assert found.null.n_gaussians > 1
    assert found.improvement.heldout_by_scan == ()  # one scan: nothing can be kept back, and nothing is claimed


@pytest.mark.slow
def test_a_tank_that_runs_over_is_tried_though_a_random_walk_hides_it():
    """Beside the walk the upper tank is never full: about that null 32 effects lead the overflow."""
    simulator = read_simulator(at_hand("tanks/tanks.py"))
    rows = read_table_for(simulator, at_hand("tanks/tanks_fit.csv")).take(np.arange(400))
    prepared = prepare_system(simulator, rows)
    on_noise = {name: prepared.effects[name] for name in ("random_walk", "saturation")}
    state = state_with_nulls(prepared, on_noise)
    assert "random_walk" in max(state.null.evidence, key=lambda noise: state.null.evidence[noise].log_z)
    state.effects = {name: state.effects[name] for name in ("limit:upper_v", "steps:k_upper", "gain_step")}
    select_forward(state, depth=1)
    over = state.best_candidate(("limit:upper_v",))
    assert over is not None
    assert over.log_z > state.null.log_z + 20
