"""Recordings by real instruments, where they are at hand: what docs/explanation/diagnosis-measured.md says of them."""

import os
from pathlib import Path

import numpy as np
import pytest
from real_recordings import kept_back

from probewise.diagnosis import diagnose
from probewise.recordings import read_recording

REAL = Path(os.environ.get("PROBEWISE_REAL", Path(__file__).parents[2].parent / "shared" / "real"))


def real(name):
    path = REAL / name
    if not path.exists():
        pytest.skip(f"{path} is not at hand; set PROBEWISE_REAL to the folder of the real recordings")
    return read_recording(path)


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
