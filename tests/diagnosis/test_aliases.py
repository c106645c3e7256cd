"""Aliased effects and what separates them."""

from typing import Any, cast

import numpy as np
from heater import SIMULATOR, runs

from probewise.diagnosis.advice import Alias, pairs_with_separating_scans
from probewise.diagnosis.diagnose_simulator import prepare_system
from probewise.diagnosis.evidence import Linearised
from probewise.diagnosis.fit import Model, fit
from probewise.diagnosis.noise import white_noise_of_recording

PREPARED = prepare_system(SIMULATOR, runs(rng=np.random.default_rng(3), n=20))
RECORDING, PLAN, APPARATUS = PREPARED.recording, PREPARED.recording.plan, PREPARED.apparatus
LAW = white_noise_of_recording(RECORDING)
FOUND = fit(Model(cast(Any, PREPARED.null), (), PLAN), RECORDING, cast(Any, PREPARED.null).first, LAW)
PROBLEM = Linearised.of(FOUND, LAW)
NOTHING = APPARATUS.words.settles_nothing


def advised(*names: str) -> Alias:
    entries = {name: (PREPARED.effects[name], PREPARED.effects[name].entries[0]) for name in names}
    pair = Alias(cast(Any, names), 1.0, NOTHING, 0)
    (found,) = pairs_with_separating_scans(
        [pair], PROBLEM, FOUND, entries, np.arange(len(RECORDING.readings)), APPARATUS
    )
    return found


def test_a_value_per_run_separates_nothing_that_a_start_of_each_run_absorbs():
    """An offset of each run and a start of each run are the same in a new run too, which has one of each."""
    alias = advised("offset_per_run", "depends:start_c:room_c")
    assert (alias.settle_by, alias.readings) == (NOTHING, 0)
