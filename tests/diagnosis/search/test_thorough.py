"""Nested sampling beside Laplace: the truth where it is known, agreement where it should be, and who wins."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from function_null import FunctionNull
from mixtures import fixed_mixture

from probewise import nested
from probewise.diagnosis import diagnose, diagnosis_json, weigh_thoroughly
from probewise.diagnosis.light_sensor import LightSensorApparatus
from probewise.diagnosis.prepared import Prepared
from probewise.diagnosis.search import search, thorough
from probewise.diagnosis.search.thorough import Weighing, sentence_with_agreement
from probewise.effects import EFFECTS, VOCABULARY, Extent, HeavyTailedPrior
from probewise.effects.effect import PHASE, sine_and_cosine_entries
from probewise.nested.importance import Repartitioned
from probewise.priors import Normal, Product, Uniform
from probewise.recordings import HalfPlane, Plan, Recording, paper_plan
from probewise.scene import KnownScene
from probewise.sensor import Chain, FixedLevels

LINE = FunctionNull(lambda p, plan: p["a"] + p["b"] * plan.time_s, Product({"a": Normal(0, 2), "b": Normal(0, 0.2)}))


def line_recording(step: float) -> Recording:
    """Forty readings of a line with noise of sd 0.3, and a step half way."""
    n = 40
    time = np.arange(n, dtype=np.float64)
    plan = Plan.from_arrays(x_mm=np.zeros(n), y_mm=0.0, time_s=time, patterns={"edge": HalfPlane(0.0, 0.0)}, unit="V")
    noise = 0.3 * np.random.default_rng(7).standard_normal(n)
    return Recording(plan, 1.0 + 0.05 * time + step * (time > 19.5) + noise)


def searched(recording):
    names = ("ambient_step", "hysteresis")
    effects = {name: VOCABULARY[name].for_extent(Extent.of(recording)) for name in names}
    built = {name: effect for name, effect in effects.items() if effect is not None}
    return search(Prepared(recording, built, LINE, LightSensorApparatus(), recording))


@pytest.fixture(scope="module")
def stepped():
    return searched(line_recording(0.3))


@pytest.mark.slow
def test_a_line_weighs_what_quadrature_says():
    """The noise's sd integrated out in closed form, 1/2 Gamma(n/2) (pi rss)^(-n/2), then a fine grid over a and b."""
    recording = line_recording(0.0)
    _, (null, *_) = weigh_thoroughly(searched(recording), rng=np.random.default_rng(1), n_live=50)
    a, b = np.linspace(0.0, 2.0, 401), np.linspace(0.0, 0.1, 401)
    time, n = recording.plan.time_s, len(recording.readings)
    rss = ((recording.readings - a[:, None, None] - b[:, None] * time) ** 2).sum(axis=-1)
    log_prior = -0.5 * (a[:, None] / 2) ** 2 - 0.5 * (b / 0.2) ** 2 - math.log(2 * math.pi * 2 * 0.2)
    log_post = math.lgamma(n / 2) - math.log(2) - n / 2 * np.log(math.pi * rss) + log_prior
    truth = np.log(np.exp(log_post - log_post.max()).sum() * (a[1] - a[0]) * (b[1] - b[0])) + log_post.max()
    assert null.effects == ()
    assert null.nested == pytest.approx(truth, abs=0.02 + 4 * null.error)
    assert null.error < 0.1
    assert null.agree


@pytest.mark.slow
def test_a_wave_weighs_what_quadrature_over_all_its_phases_says():
    """Both peaks of two turns of phase are in the prior that nested sampling explores, so neither counts again."""
    level = FunctionNull(lambda p, plan: p["a"] + 0 * plan.time_s, Product({"a": Normal(0, 2)}))
    plain = line_recording(0.0)
    time, n = plain.plan.time_s, len(plain)
    recording = replace(plain, readings=plain.readings - 0.05 * time + 0.4 * np.sin(2 * np.pi * 0.11 * time + 1.0))
    amp, hz = HeavyTailedPrior(0.1, positive=True), Uniform(0.1, 0.12)
    entries = sine_and_cosine_entries(0.1, np.linspace(0.1, 0.12, 10)[1:-1])
    wave = replace(EFFECTS["flicker"](), parameters={"amp": amp, "alias_hz": hz, "phase": PHASE}, entries=entries)
    found = search(Prepared(recording, {wave.name: wave}, level, LightSensorApparatus(), recording))
    candidate = next(own for own, _ in thorough._leading_hypotheses(found) if own.names == (wave.name,))
    told = thorough._weigh_by_nested_sampling(
        candidate, (), found, rng=np.random.default_rng(1), n_live=100, show=lambda _: None
    )
    # The first turn of phase, twice; of the level by the trapezium rule too.
    a, amp = np.linspace(0.5, 1.5, 61), np.linspace(0.01, 0.9, 61)
    hz, phase = np.linspace(0.1, 0.12, 41), np.linspace(0.0, 2 * np.pi, 61)[:-1]
    log_post = np.empty((len(hz), len(phase), len(amp), len(a)))
    for k, own_hz in enumerate(hz):
        shape = np.sin(2 * np.pi * own_hz * time + phase[:, None])
        rest = recording.readings - amp[:, None] * shape[:, None]
        mean, square = rest.mean(axis=-1), (rest**2).mean(axis=-1)
        rss = n * (square[..., None] - 2 * a * mean[..., None] + a**2)
        log_post[k] = math.lgamma(n / 2) - math.log(2) - n / 2 * np.log(math.pi * rss)
    log_post += wave.prior.marginals["amp"].log_prob(amp)[:, None] + Normal(0, 2).log_prob(a)
    most = log_post.max()
    ends = np.where(np.isin(hz, hz[[0, -1]]), 0.5, 1.0)[:, None, None, None]
    cell = (hz[1] - hz[0]) / 0.02 * phase[1] / (4 * np.pi) * (amp[1] - amp[0]) * (a[1] - a[0])
    truth = math.log(2 * cell * (ends * np.exp(log_post - most)).sum()) + most
    assert candidate.log_share == pytest.approx(math.log(2))
    assert told.nested == pytest.approx(truth + candidate.log_detectable, abs=0.05 + 4 * told.error)
    assert told.error < 0.1


def stub_of_the_whole_prior(monkeypatch, change):
    """Let runs of the whole prior, not those near the posterior, be changed."""

    def run(problem, **options):
        result = nested.run(problem, **options)
        return result if isinstance(problem, Repartitioned) else change(result)

    monkeypatch.setattr(thorough, "nested", SimpleNamespace(**{**vars(nested), "run": run}))


@pytest.mark.slow
def test_a_prior_that_holds_more_than_what_was_found_in_it_is_a_doubt(stepped, monkeypatch):
    """It is said where the evidences agree, too."""
    stub_of_the_whole_prior(monkeypatch, lambda result: replace(result, log_z=result.log_z + 30.0))
    found, weighings = weigh_thoroughly(stepped, rng=np.random.default_rng(2), n_live=50)
    assert all("holds more" in w.doubts[-1] for w in weighings)
    assert all(w.agree for w in weighings)
    assert found is stepped
    said = sentence_with_agreement("A reason.", weighings)
    assert "agrees to within a nat plus its standard error, but its runs gave a warning" in said


def moved(stepped, monkeypatch, gap, doubts=()):
    def weigh(candidate, noise, *_, **__):
        own = gap if candidate.names else 0.5
        return Weighing(candidate.names, candidate.n_gaussians, 0.0, own, 0.01, doubts)

    monkeypatch.setattr(thorough, "_weigh_by_nested_sampling", weigh)
    return weigh_thoroughly(stepped, rng=np.random.default_rng(0))


def odds(found):
    """Odds of a step against a clean mean, under white noise."""
    return found.posterior.probabilities[("ambient_step",), ()] / found.posterior.probabilities[(), ()]


def test_nested_sampling_wins_where_it_disagrees(stepped, monkeypatch):
    """What it finds beyond Laplace, less what it finds of the null, moves the odds by as many nats."""
    found, _ = moved(stepped, monkeypatch, 2.5)
    assert odds(found) / odds(stepped) == pytest.approx(math.exp(2.0))
    assert sum(found.posterior.probabilities.values()) == pytest.approx(1.0)


def test_a_run_with_doubts_does_not_win(stepped, monkeypatch):
    found, weighings = moved(stepped, monkeypatch, 5.0, doubts=("few effective samples",))
    assert found is stepped
    assert "left as they were, but its runs gave a warning" in sentence_with_agreement("A reason.", weighings)


def test_the_reason_says_whether_they_agree():
    near, far = Weighing(("lag",), 1, -10.0, -10.4, 0.1), Weighing((), 1, -12.0, -14.0, 0.1)
    assert sentence_with_agreement("A reason.", ()) == "A reason."
    agreed = "A reason; nested sampling agrees to within a nat plus its standard error."
    assert sentence_with_agreement("A reason.", (near,)) == agreed
    assert "clean by −2.0 nats" in sentence_with_agreement("A reason.", (near, far))
    of_column = replace(far, effects=("depends:gain:flow-in",))
    assert "depends:gain:flow-in by −2.0 nats" in sentence_with_agreement("A reason.", (near, of_column))


@pytest.mark.slow
def test_a_recording_is_weighed_alike_both_ways():
    """A third of the paper's plan by a sensor known to two per cent, with a lamp switched on half way."""
    plan = paper_plan()
    plan = plan.take(np.arange(0, len(plan), 3))
    spot = np.array([1.0, 0.0, 1.5, 1 / 72, 1 / 128, 0.0])
    exact = Chain(fixed_mixture(spot), FixedLevels(10.0, 60.0), KnownScene(plan.patterns))
    noise = 0.5 * np.random.default_rng(3).standard_normal(len(plan))
    lamp = 1.0 * (plan.time_s > np.median(plan.time_s))
    recording = Recording(plan, exact.predict(np.empty((1, 0)), plan)[0] + lamp + noise)
    seen = []

    def again(found):
        return weigh_thoroughly(
            found,
            rng=np.random.default_rng(4),
            n_live=60,
            progress=lambda stage, done=0, total=0, note="": seen.append((stage, done, total, note)),
        )

    names = (*(f"{p}_1" for p in ("a", "u", "v", "A", "B", "C")), "I_min", "I_max")
    truth = np.array([*spot, 10.0, 60.0])
    spread = np.array([0.02, 0.1, 0.1, 0.0003, 0.0002, 0.0002, 0.2, 0.2])
    samples = truth + spread * np.random.default_rng(0).standard_normal((500, 8))
    known = SimpleNamespace(names=names, samples=samples)
    found = diagnose(recording, sensor=known, thorough=again, rng=np.random.default_rng(1))
    assert "ambient_step" in {w.label for w in found.weighings}
    assert {w.label for w in found.weighings} == {
        note for stage, _, _, note in seen if note and stage.startswith("weighing hypotheses again")
    }
    assert all(w.agree for w in found.weighings)
    assert found.reason.endswith("nested sampling agrees to within a nat plus its standard error.")
    assert [w["agree"] for w in diagnosis_json(found)["thorough"]] == [True] * len(found.weighings)
    assert "thorough" not in diagnosis_json(replace(found, weighings=()))
