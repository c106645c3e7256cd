"""What a verdict says of the next readings: only what they do."""

import numpy as np
import pytest

from probewise.diagnosis import TO_SEPARATE, diagnose_system
from probewise.diagnosis.advice import Rival, measurement_separating_rivals
from probewise.systems import Noise, RunTable, Simulator


def simulate(p, data):
    return p["off"] + p["slope"] * data["x"]


SIMULATOR = Simulator(
    reading="y_v",
    unit="V",
    run="day",
    parameters={"slope": (-10, 10), "off": ("normal", 0, 10)},
    per_run=("off",),
    noise=Noise(sd=0.1),
    simulate=simulate,
)


def table() -> RunTable:
    """Three days of twelve readings, which the temperature shifts: so does an offset that depends on it."""
    rng = np.random.default_rng(3)
    x, temp_c = rng.uniform(0, 3, 36), 20 + 2 * rng.standard_normal(36)
    y_v = np.repeat([1.0, 1.3, 0.7], 12) + 2 * x + 0.3 * (temp_c - 20) + 0.1 * rng.standard_normal(36)
    return RunTable({"day": np.repeat(["a", "b", "c"], 12), "x": x, "temp_c": temp_c, "y_v": y_v}, run="day")


COMPARED: list[Rival] = []


@pytest.fixture(scope="module")
def diagnosis():
    def compare(rivals, *rest):
        COMPARED.extend(rivals)
        return measurement_separating_rivals(rivals, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("probewise.diagnosis.advice.measurement_separating_rivals", compare)
        return diagnose_system(SIMULATOR, table(), rng=np.random.default_rng(1))


def test_where_no_readings_separate_the_named_hypotheses_the_verdict_says_so(diagnosis):
    nothing = diagnosis.apparatus.words.settles_nothing
    assert diagnosis.verdict == "cannot_tell"
    assert TO_SEPARATE not in diagnosis.reason
    for name in ("off that depends on temp_c", "readings that depend on temp_c"):
        assert f"{name} (0.49)" in diagnosis.reason
    assert diagnosis.reason.endswith(f"; {nothing}.")
    assert diagnosis.next_measurement is None


def test_aliases_promise_no_readings_where_the_fit_absorbs_all_that_they_change(diagnosis):
    aliases = {alias.effects: alias for alias in diagnosis.judged.aliases}
    absorbed = [("depends:off:temp_c", "sensitivity:temp_c"), ("differs:slope", "input_gain:x")]
    for effects in absorbed:
        assert (aliases[effects].settle_by, aliases[effects].readings) == (
            diagnosis.apparatus.words.settles_nothing,
            0,
        )


def test_the_offset_of_a_new_day_is_not_known_to_any_rival(diagnosis):
    assert len(COMPARED) > 1
    for rival in COMPARED:
        assert {*rival.of_run} >= {1, 2, 3}
