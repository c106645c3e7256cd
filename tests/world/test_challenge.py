"""Challenge cases: what they hold follows from seed and number, and is what the truth says."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from probewise.effects import VOCABULARY
from probewise.errors import NotConvergedError
from probewise.proof.sensors import (
    INSIDE,
    NEEDS_SENSOR,
    NOISE_NAMES,
    OUTSIDE,
    PLANS,
    SAMPLERS,
    SINGLES,
    SSFS,
    WHEEL,
    CleanSetup,
    CovariateRegion,
    draw_case,
    draw_plan_with_displaced_patterns,
    draw_sensor,
    held_out_recordings,
    stratum_of,
)
from probewise.recordings import fingerprint, read_recording, write_recording


def left_by_levels(clean, changed):
    """A null model that may change its two levels alone: quick, and enough to draw by."""
    line = np.polyfit(clean.readings, changed.readings, 1)
    return float(np.linalg.norm(changed.readings - np.polyval(line, clean.readings)))


def number_of(kind, *, skip=0, **wanted):
    """Number of the first case of this stratum, after some."""
    numbers = (
        k
        for k in range(100 * len(WHEEL))
        for stratum, turn in [stratum_of(k)]
        if stratum.kind == kind and turn >= skip and all(getattr(stratum, key) == v for key, v in wanted.items())
    )
    return next(numbers)


def draw(number, seed=11):
    return draw_case(seed, number, norm_after_refit=left_by_levels)


case = functools.cache(draw)


@pytest.mark.parametrize("number", [number_of("clean", other_noise=True), number_of("single", size=20.0, skip=1)])
def test_seed_and_number_alone_make_the_case(number):
    first, again, other = case(number), draw(number), draw(number, seed=12)
    assert fingerprint(first.recording) == fingerprint(again.recording)
    assert first.hidden == again.hidden
    assert fingerprint(first.recording) != fingerprint(other.recording)
    once, twice = held_out_recordings(first), held_out_recordings(first)
    for name, recording in held_out_recordings(again).items():
        np.testing.assert_array_equal(recording.readings, once[name].readings)
        np.testing.assert_array_equal(recording.readings, twice[name].readings)


def test_a_single_case_conceals_its_effect_at_its_size():
    made = case(number_of("single", size=12.0))
    (hidden,) = made.hidden
    assert hidden.name == SINGLES[0]
    assert made.combination == (hidden.name,)
    assert hidden.size_lambda == pytest.approx(12.0, rel=0.02)
    # Second route: the worlds with and without it, by hand.
    plan = made.recording.plan
    clean, changed = (replace(made.world, concealed=c).simulate(plan, rng=None) for c in ((), (hidden.effect,)))
    assert left_by_levels(clean, changed) / made.world.noise_sd == pytest.approx(12.0, rel=0.02)
    noise = (made.recording.readings - changed.readings) / made.world.noise_sd
    assert abs(noise.std() - 1) < 4 / np.sqrt(2 * len(noise))


def test_a_pair_is_two_effects_that_can_be_told_apart():
    truth = case(number_of("pair"))
    assert len(truth.combination) == 2
    assert all(hidden.size_lambda == pytest.approx(12.0, rel=0.1) for hidden in truth.hidden)
    assert abs(truth.cosine) < 0.5


@pytest.mark.slow
def test_an_alias_is_what_three_nats_cannot_tell_apart():
    made = case(number_of("alias", skip=3))
    assert made.plan == "paper"
    assert made.alias is not None
    assert 144 * (1 - made.cosine**2) / 2 < 3
    assert made.alias not in made.combination


@pytest.mark.slow
def test_an_effect_outside_the_vocabulary_is_unknown_and_one_gaussian_more_is_clean():
    assert case(number_of("outside")).combination == ("unknown",)
    trap = case(number_of("ssf_order"))
    assert trap.combination == ()
    assert trap.ssf == "gaussian"
    assert trap.hidden[0].name == "ssf_order"


def test_no_null_model_sees_what_cannot_be_seen():
    with pytest.raises(NotConvergedError):
        draw_case(1, number_of("single"), norm_after_refit=lambda clean, changed: 0.0)


def test_the_recording_does_not_tell(tmp_path):
    made = case(number_of("single", size=8.0, skip=SINGLES.index("scan_angle_error")))
    (hidden,) = made.hidden
    assert hidden.name == "scan_angle_error"
    assert set(hidden.effect.parameters) == {"deg", "scans"}
    assert hidden.covariates == ("scan", "orientation")
    assert hidden.region.scans == hidden.effect.parameters["scans"]
    path = tmp_path / "case.csv"
    write_recording(made.recording, path)
    assert fingerprint(read_recording(path)) == fingerprint(made.recording)
    text = path.with_suffix(".json").read_text()
    assert not any(name in text for name in (*INSIDE, *OUTSIDE, *SSFS))


@pytest.mark.parametrize("ssf", SSFS)
def test_every_ssf_is_about_as_large_as_a_lego_sensors(ssf):
    mean, covariance = SSFS[ssf](np.random.default_rng(3)).moments()
    assert np.abs(mean).max() < 4
    assert 1 < np.sqrt(np.linalg.eigvalsh(covariance)).min() < np.sqrt(np.linalg.eigvalsh(covariance)).max() < 6


@pytest.fixture(scope="module", params=list(PLANS))
def setup(request):
    rng = np.random.default_rng(5)
    plan = draw_plan_with_displaced_patterns(request.param, rng=rng)
    return CleanSetup(plan, draw_sensor("gaussian", "middle", rng=rng), left_by_levels)


def test_a_local_effect_is_found_where_it_is(setup):
    def region(name, amplitude):
        return setup.region(INSIDE[name].draw(setup, np.random.default_rng(8))(amplitude))

    glint = INSIDE["glint"].draw(setup, np.random.default_rng(8))(2.0).parameters
    found = region("glint", 2.0)
    # Half as strong at 1.18 sd, seen along y = 0, to the millimetre of the plan.
    half = glint["r"] * np.sqrt(2 * np.log(2))
    assert found.covariate == "place"
    assert found.low == pytest.approx(glint["x"] - half, abs=1.01)
    assert found.high == pytest.approx(glint["x"] + half, abs=1.01)
    step = region("ambient_step", 1.0)
    assert (step.covariate, step.high) == ("time", setup.plan.time_s[-1])
    assert region("scan_misplacement", 1.0).scans
    assert region("backlash", 1.0) is None
    assert isinstance(region("saturation", 0.1), CovariateRegion)


@pytest.mark.slow
def test_every_single_and_outsider_can_be_drawn_at_its_size():
    """One turn through all names: with a null model this simple, everything that is in the mean survives."""
    for kind, size, names in [("single", 8.0, SINGLES), ("outside", 12.0, list(OUTSIDE))]:
        for turn, name in enumerate(names):
            truth = case(number_of(kind, size=size, other_noise=False, skip=turn))
            assert truth.hidden[0].name == name
            if SAMPLERS[name].limit > SAMPLERS[name].first:
                assert truth.hidden[0].size_lambda == pytest.approx(size, rel=0.1)
    assert not NEEDS_SENSOR & set(SINGLES)
    since_calibration = {"dark_level", "gain", "noise_sd"}
    assert {*VOCABULARY} - {*INSIDE} == since_calibration


@pytest.mark.slow
def test_the_name_of_the_noise_is_part_of_the_truth():
    clean = number_of("clean", other_noise=True)
    named = [k for k in range(clean, clean + 120) if stratum_of(k)[0] == stratum_of(clean)[0]]
    truths = [case(k) for k in named]
    assert len({truth.noise_model for truth in truths}) > 3
    for truth in truths:
        assert truth.combination == ((NOISE_NAMES[truth.noise_model],) if truth.noise_model in NOISE_NAMES else ())
