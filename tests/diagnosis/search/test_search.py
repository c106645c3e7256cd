"""Stepwise selection of effects, and pruning."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.noise import white_noise
from probewise.diagnosis.search import UnknownEffects, prune_out_of_vocabulary, search
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


N = 50
NAME, PUSH = ("sensor_tilt",), ("arm_knock",)


@dataclass(frozen=True, eq=False)
class Held:
    """As much of a candidate as is asked here: its names, its log evidence, what it leaves of every reading."""

    names: tuple[str, ...]
    log_z: float
    left: float = 0.0
    log_share: float = 0.0
    n_gaussians: int = 1
    weights: dict = field(default_factory=dict)
    law = white_noise(N)

    @property
    def evidence(self):
        return {(): SimpleNamespace(log_z=self.log_z)}

    @property
    def log_z_by_noise(self):
        return {(): self.log_z}

    whitened_sd = 1.0

    @property
    def found(self):
        return SimpleNamespace(residuals=np.full(N, self.left))

    def with_variant_factor_and_weights(self, log_share, _):
        return replace(self, log_z=self.log_z + log_share - self.log_share, log_share=log_share)


NOISES = SimpleNamespace(average_log_evidence=lambda log_z: log_z.get((), -np.inf))


def by_key(*candidates):
    return {(c.n_gaussians, c.names): c for c in candidates}


@pytest.mark.parametrize(("behind", "goes"), [(2.0, False), (4.0, True)])
def test_what_is_poorer_than_something_left_out_for_a_name_is_left_out_too(behind, goes):
    """A log that a curve follows is that curve; an exponential that follows neither must not lead in its place."""
    poorer = Held(("reflection",), -behind, left=1.0)
    fits = by_key(Held((), -50.0), Held(NAME, -9.0), Held(PUSH, 0.0, left=0.3), poorer)
    assert prune_out_of_vocabulary(fits, NOISES)[1] == ({PUSH, poorer.names} if goes else {PUSH})


@pytest.mark.parametrize(
    ("name", "beside", "speaks"),
    [(-1.0, 0.0, True), (-1.0, 2.5, False), (-4.0, -4.0, False)],
    ids=["as much, and nothing left", "something left", "far behind"],
)
def test_a_name_speaks_for_bases_that_explain_no_more_and_find_nothing_beside_it(name, beside, speaks):
    state = SimpleNamespace(refits=SimpleNamespace(noises=NOISES), effects_in_vocabulary=[NAME])
    unknown = UnknownEffects(state, None, (), {(1, (), ()): 0.0, (1, NAME, ()): beside})
    unknown.drop_superfluous([Held((), -50.0), Held(NAME, name)])
    assert ((1, (), ()) not in unknown.log_z) == speaks
    assert (1, NAME, ()) in unknown.log_z
