"""What a fit says of a prior that the readings contradict."""

import numpy as np
import pytest

from probewise.diagnosis import fit_simulator
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.systems import Noise, Simulator, table_for

X = np.linspace(1, 20, 40)
SLOPE, SD = 1.8, 1.0


def _notes(prior, *, slope=SLOPE, seed=3):
    rng = np.random.default_rng(seed)
    simulator = Simulator(
        "strain_ue", "ue", {"per_n": prior}, simulate=lambda p, data: p["per_n"] * data["pull_n"], noise=Noise(sd=SD)
    )
    table = {"pull_n": X, "strain_ue": slope * X + rng.normal(0, SD, len(X))}
    prepared = prepare_system(simulator, table_for(simulator, table), with_effects=False)
    return [note for note in prepared.recording.notes if "prior" in note]


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        ((0, 1), "per_n is at the upper end of its prior, uniform 0 to 1, but the readings ask for a larger value"),
        ((3, 9), "per_n is at the lower end of its prior, uniform 3 to 9, but the readings ask for a smaller value"),
        (("log", 0.1, 1), "upper end"),
        (("normal", 1.0, 0.1), "sds above the mean of its prior, normal 1 ± 0.1"),
    ],
)
def test_a_prior_that_excludes_what_the_readings_say_is_told(prior, words):
    (note,) = _notes(prior)
    assert words in note


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("prior", "slope"), [((0, 100), 0.1), ((0, 1.8), SLOPE), (("normal", 1.6, 0.1), SLOPE), ((0, 5), 0.0)]
)
def test_a_wide_prior_and_one_that_ends_at_the_truth_are_not(prior, slope, seed):
    """By chance a best value is four sds beyond an end at the truth in 3e-5 of recordings, by far the most of these."""
    assert not _notes(prior, slope=slope, seed=seed)


@pytest.mark.parametrize(("declared", "told"), [(0.5, True), (2.0, True), (SD, False), (None, False)])
def test_a_noise_that_is_not_as_it_was_declared_is_told(declared, told):
    """Of 400 readings the sd is known to a thirtieth."""
    rng, x = np.random.default_rng(8), np.linspace(1, 20, 400)
    simulator = Simulator(
        "strain_ue",
        "ue",
        {"per_n": (0, 5)},
        simulate=lambda p, data: p["per_n"] * data["pull_n"],
        noise={"sd": declared},
    )
    table = {"pull_n": x, "strain_ue": SLOPE * x + rng.normal(0, SD, len(x))}
    notes = fit_simulator(simulator, table, rng=rng).recording.notes
    assert sum("the noise sd of a reading is " in note and "was declared" in note for note in notes) == told
