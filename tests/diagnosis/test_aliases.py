"""Aliased effects and what separates them."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from heater import SIMULATOR, runs

from probewise.diagnosis.advice import COUNTS, Alias, pairs_with_separating_scans
from probewise.diagnosis.apparatus import MOST_ADVISED_READINGS
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
SCANS = APPARATUS.candidate_measurements(PLAN)
NEW_START = 5 / PROBLEM.sd  # of each run yet to be recorded, the prior's sd


def advised(*names: str) -> Alias:
    entries = {name: (PREPARED.effects[name], PREPARED.effects[name].entries[0]) for name in names}
    pair = Alias(cast(Any, names), 1.0, NOTHING, 0)
    (found,) = pairs_with_separating_scans(
        [pair], PROBLEM, FOUND, entries, np.arange(len(RECORDING.readings)), APPARATUS
    )
    return found


def change(name: str, plan: Any) -> np.ndarray:
    """The change of the readings by the first entry of an effect, in noise sds."""
    effect = PREPARED.effects[name]
    model = Model(FOUND.model.sensor, (effect,), plan)
    z = np.append(FOUND.z, model.z_of_last_effect(effect.entries[0][:1])[0])
    without = Model(FOUND.model.sensor, (), plan).predict(FOUND.z[None, :])[0]
    return (model.predict(z[None, :])[0] - without) / PROBLEM.sd


def nats(scan: Any, readings: int, name: str, rival: str) -> float:
    """Half the square of what of one effect, of lambda 8 before, the rival and all parameters leave."""
    n_params, weight = len(FOUND.z), np.sqrt(readings / len(scan.plan))
    _, slopes = Model(FOUND.model.sensor, (), scan.plan).predict_and_differentiate(FOUND.z)
    slopes = weight * slopes / PROBLEM.sd
    slopes[:, 2:] = 0.0  # starts of recorded runs
    prior = np.zeros(n_params)
    true, other = (
        np.concatenate([change(which, PLAN), weight * change(which, scan.plan), prior, [0.0]])
        for which in (name, rival)
    )
    start = np.concatenate([np.zeros(len(PLAN)), np.full(len(scan.plan), weight * NEW_START), prior, [1.0]])
    rows = np.concatenate([FOUND.slopes / PROBLEM.sd, slopes, np.eye(n_params), np.zeros((1, n_params))])
    detected = change(name, PLAN)
    known = np.concatenate([FOUND.slopes / PROBLEM.sd, np.eye(n_params)])
    left = np.append(detected, prior)
    left = left - known @ np.linalg.lstsq(known, left, rcond=None)[0]
    true = true * 8 / max(float(np.linalg.norm(left)), 0.05 * float(np.linalg.norm(detected)))
    fitted = np.column_stack([rows, start, other])
    return 0.5 * float(np.sum((true - fitted @ np.linalg.lstsq(fitted, true, rcond=None)[0]) ** 2))


def gained(scan: Any, readings: int, *names: str) -> float:
    each = (names, names[::-1])
    return min(nats(scan, readings, *pair) - nats(scan, 0, *pair) for pair in each)


SEPARABLE = [("gain_drift", "nonlinearity"), ("drifts:gain", "input_offset:power_w"), ("gain_drift", "drifts:tau_s")]


@pytest.mark.parametrize("names", SEPARABLE)
def test_the_advised_readings_add_three_nats_and_fewer_do_not(names):
    alias = advised(*names)
    assert 0 < alias.readings < MOST_ADVISED_READINGS
    (scan,) = (s for s in SCANS if s.description == alias.settle_by)
    assert gained(scan, alias.readings, *names) >= 3
    fewer = int(COUNTS[np.searchsorted(COUNTS, alias.readings) - 1])
    assert max(gained(s, fewer, *names) for s in SCANS) < 3


def test_a_value_per_run_separates_nothing_that_a_start_of_each_run_absorbs():
    """An offset of each run and a start of each run are the same in a new run too, which has one of each."""
    alias = advised("offset_per_run", "depends:start_c:room_c")
    assert (alias.settle_by, alias.readings) == (NOTHING, 0)
