"""Pairs of effects neither of which explains anything by itself, found with noise that hides both."""

import numpy as np
import pytest

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.search.search import search
from probewise.systems import Noise, Simulator, table_for

N_ROWS = 160
SD = 0.01
LINE = Simulator(
    reading="y",
    unit="V",
    parameters={"offset": (-5, 10), "gain": (0, 1)},
    simulate=lambda p, u: p["offset"] + p["gain"] * u["x"],
    time="t_s",
    noise=Noise(sd=SD),
)


def _readings_and_columns(rng, *, slow, amplitude):
    """A heat flux: the reading grows with the difference of two temperatures, which rise and fall together."""
    common = np.cumsum(rng.normal(0, 0.2, N_ROWS))
    own = np.cumsum(rng.normal(0, 0.1, N_ROWS)) if slow else rng.normal(0, 0.1, N_ROWS)
    room, wall, x = 20 + common, 18 + common + own, rng.normal(size=N_ROWS)
    y = 3 + 0.2 * x + amplitude * (wall - room) + SD * rng.normal(size=N_ROWS)
    return {"t_s": np.arange(float(N_ROWS)), "x": x, "room_c": room, "wall_c": wall, "y": y}, own


def _probability_of_both_columns(columns):
    found = search(prepare_system(LINE, table_for(LINE, columns)))
    both = {"room_c", "wall_c"}
    return sum(
        p for names, p in found.posterior.marginal_over_noise.items() if both == {n.split(":")[-1] for n in names}
    )


def test_a_difference_of_two_columns_is_found_where_neither_column_explains_anything():
    columns, _ = _readings_and_columns(np.random.default_rng(1), slow=False, amplitude=0.1)
    assert _probability_of_both_columns(columns) > 0.9


@pytest.mark.slow
def test_it_is_found_where_a_walk_of_the_noise_hides_it_and_seven_other_columns_explain_more_alone():
    rng = np.random.default_rng(4)
    columns, own = _readings_and_columns(rng, slow=True, amplitude=0.05)
    others = {f"column_{k}": own + np.cumsum(rng.normal(0, 0.12, N_ROWS)) for k in range(7)}
    assert _probability_of_both_columns(columns | others) > 0.9
