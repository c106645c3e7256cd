"""An inquiry over any settings: its posterior against a closed form, its choices, its forms, what it refuses."""

import math
import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest
from scipy import stats

from probewise.errors import ParameterError
from probewise.inquiry import Inquiry
from probewise.priors import LogUniform, Normal, Uniform

LINE = {"slope": Normal(0.0, 1.0), "offset": Normal(0.0, 2.0)}
PLACES = np.linspace(0.0, 2.0, 5)


def line(p, x):
    return p["offset"] + p["slope"] * x


def line_of_numbers(p, x):
    return math.fsum([p["offset"], p["slope"] * x])


def inquiry(*, seed=0, model=line, prior=LINE, settings=PLACES, noise=0.3, **options):
    options = {"n_samples": 1000, "n_live": 100, **options}
    return Inquiry(model, prior, settings, noise, rng=np.random.default_rng(seed), **options)


def follow(asked, read, n):
    for _ in range(n):
        asked.tell(read(asked.next()))
    return asked


def closed_form(readings):
    """Mean, covariance and log evidence of the line with noise of 0.3."""
    x, y = (np.array(column, dtype=float) for column in zip(*readings, strict=True))
    design, before = np.stack([x, np.ones_like(x)], axis=1), np.diag([1.0, 4.0])
    covariance = np.linalg.inv(np.linalg.inv(before) + design.T @ design / 0.09)
    mean = covariance @ design.T @ y / 0.09
    predictive = stats.multivariate_normal(np.zeros(len(x)), design @ before @ design.T + 0.09 * np.eye(len(x)))
    return mean, np.sqrt(np.diag(covariance)), predictive.logpdf(y)


def test_posterior_and_evidence_of_a_line_are_the_closed_form():
    """Kalman's update; samples are reweighted, and drawn anew at least once on the way."""
    noise = np.random.default_rng(5)
    found = follow(inquiry(n_samples=4000), lambda x: 1.5 * x - 1.0 + 0.3 * noise.standard_normal(), 12)
    mean, sd, log_z = closed_form(found.readings)
    np.testing.assert_allclose(found.posterior.mean(), mean, atol=0.1 * sd.min())
    np.testing.assert_allclose(found.posterior.sd(), sd, rtol=0.08)
    assert found.evidence[0] == pytest.approx(log_z, abs=5 * found.evidence[1] + 0.01)
    assert found.evidence[1] < 0.1
    assert found.doubt is None


@pytest.mark.parametrize("model", [line, line_of_numbers])
def test_a_pickled_inquiry_goes_on_as_it_would(model):
    asked = follow(inquiry(model=model), lambda x: 0.5, 2)
    again = pickle.loads(pickle.dumps(asked))
    assert follow(again, lambda x: 0.7, 2).readings == follow(asked, lambda x: 0.7, 2).readings


def test_a_surprising_reading_starts_nested_sampling_anew():
    """Far outside what any sample of the prior predicts, and yet the posterior is the closed form."""
    found = inquiry(noise=0.3, prior={"slope": Normal(0.0, 1.0), "offset": Normal(0.0, 2.0)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found.tell(9.5, 0.0)
    mean, sd, log_z = closed_form(found.readings)
    assert (np.abs(found.posterior.mean() - mean) < 4 * sd / math.sqrt(found.posterior.n_eff)).all()
    assert found.evidence[0] == pytest.approx(log_z, abs=5 * found.evidence[1] + 0.05)


@np.errstate(all="raise")  # which is the caller's, and ends no run
def test_the_first_reading_of_a_line_is_taken_where_the_predictions_differ_most():
    asked = inquiry()
    bits = 0.5 * np.log2(1 + (4.0 + PLACES**2) / 0.09)
    np.testing.assert_allclose(asked.utility, bits, atol=0.1)
    assert asked.next() == 2.0
    assert asked.next() == 2.0
    assert asked.utility_label == "expected information (bits)"


def test_readings_are_chosen_for_what_the_goal_names():
    """The offset alone: read at zero. The slope alone, with the offset known: read at the far end."""
    asked = inquiry(goal={"offset": 0.9})
    assert asked.next() == 0.0
    assert "sd / goal" in asked.utility_label
    known = {"slope": Normal(0.0, 1.0), "offset": Normal(0.0, 0.01)}
    far = inquiry(goal={"slope": 0.4}, prior=known, noise=1.0)
    assert far.next() == 2.0


def test_an_inquiry_is_settled_when_every_sd_is_reached():
    asked = inquiry(goal={"offset": 0.2, "slope": 0.2})
    assert not asked.settled
    while not asked.settled:
        asked.tell(line({"slope": 0.5, "offset": 1.0}, asked.next()))
    assert (asked.posterior.sd() <= 0.2).all()
    assert 2 < len(asked.readings) < 20


def test_no_more_readings_than_parameters_settle_nothing():
    asked = inquiry(goal={"slope": 10.0})
    for _ in range(3):
        assert not asked.settled
        asked.tell(line({"slope": 0.5, "offset": 1.0}, asked.next()))
    assert asked.settled
    assert "data:image/png;base64" in asked._repr_html_()


def test_seconds_count():
    """Twice the information at the far end is not worth ten times the seconds; travel counts from the last setting."""
    assert inquiry(cost_s=[1, 1, 1, 1, 10.0]).next() == 1.5
    asked = inquiry(cost_s=lambda last: np.ones(5) if last is None else 0.01 + 100 * np.abs(PLACES - last))
    asked.tell(0.3, 1.0)
    assert asked.next() == 1.0
    assert asked.utility_label.endswith("per second")


def test_a_reading_without_its_setting_is_taken_once_for_each_choice():
    asked = inquiry()
    for _ in range(2):
        with pytest.raises(ParameterError, match=r"setting is None; allowed: .* tell\(reading, setting\)"):
            asked.tell(0.5)
        asked.next()
        asked.tell(0.5)
    assert len(asked.readings) == 2


def test_the_way_to_the_second_of_two_readings_begins_at_the_first():
    """Each move costs more than it is worth, so both are taken at one place."""
    together = inquiry(cost_s=lambda last: np.ones(5) if last is None else 0.01 + 100 * np.abs(PLACES - last))
    first, second = together.several(2)
    assert first == second


FORMS = {
    "several knobs": (np.array([[0.0, 1.0], [1.0, 0.5], [2.0, 2.0]]), lambda p, s: p["a"] * s[0] + s[1]),
    "knobs by name": (
        {"gain": np.array([0.0, 1.0, 2.0]), "bias": np.array([1.0, 0.5, 2.0])},
        lambda p, s: p["a"] * s["gain"] + s["bias"],
    ),
    "names": (["off", "half", "full"], lambda p, s: p["a"] * (1.0 * (s == "half") + 2.0 * (s == "full"))),
}


@pytest.mark.parametrize("name", FORMS)
def test_settings_come_back_in_the_form_they_were_given(name):
    settings, model = FORMS[name]
    asked = inquiry(model=model, prior={"a": Uniform(-1.0, 1.0)}, settings=settings, noise=0.05)
    setting = asked.next()
    asked.tell(float(model({"a": 0.5}, setting)))
    np.testing.assert_equal(
        setting,
        {"several knobs": np.array([2.0, 2.0]), "knobs by name": {"gain": 2.0, "bias": 2.0}, "names": "full"}[name],
    )
    assert asked.posterior.mean()[0] == pytest.approx(0.5, abs=0.05)


def test_what_a_person_or_the_model_does_to_an_array_changes_no_setting_reading_or_prediction():
    """The arrays handed out are converted in place, and the model fills the same array at each call."""
    frame = pytest.importorskip("pandas").DataFrame
    filled = np.empty(len(PLACES))

    def in_place(p, x):
        out = np.broadcast_shapes(np.shape(p["slope"]), np.shape(x[0]))
        here = filled if out == filled.shape else np.empty(out)
        np.multiply(p["slope"], x[0], out=here)
        return here

    table = frame({"x": PLACES})
    for settings, model in ((PLACES[:, None], in_place), (table, lambda p, x: in_place(p, [x["x"]]))):
        asked = inquiry(model=model, prior={"slope": Normal(0.0, 1.0)}, settings=settings)
        chosen = asked.next()
        chosen[0 if settings is not table else "x"] *= 1000
        asked.tell(1.0)
        assert np.max([*asked.readings[0][0].values()] if settings is table else asked.readings[0][0]) <= 2.0
        assert asked.posterior.mean()[0] == pytest.approx(0.49, abs=0.02)
    with pytest.raises(ParameterError, match="columns is 'a'; allowed: each name once"):
        inquiry(settings=frame([[1, 2]], columns=["a", "a"]))


def plain_root(p, x):
    """Takes numbers, not arrays: of one sample, at one setting."""
    return p["offset"] + math.sqrt(x) if x > 0.5 else p["offset"] + p["slope"] * x


def test_a_function_of_numbers_alone_is_asked_setting_by_setting():
    asked = inquiry(model=plain_root, n_samples=400)
    asked.tell(2.0, 1.0)
    assert asked.posterior.mean()[1] == pytest.approx(1.0, abs=0.1)


def test_an_unknown_sd_is_inferred():
    noise = np.random.default_rng(2)
    asked = inquiry(noise=LogUniform(0.05, 5.0), n_samples=4000)
    for k in range(10):
        asked.tell(float(0.4 * noise.standard_normal()), PLACES[k % 5])
    assert asked.posterior.names[-1] == "noise.sd"
    low, high = asked.posterior.interval(0.99)[:, -1]
    assert low < 0.4 < high < 1.2


def test_readings_that_no_hypothesis_explains_are_doubted():
    asked = inquiry(noise=0.2)
    for x in PLACES:
        asked.tell(3.0 * (x - 1) ** 2, x)
    assert "no hypothesis explains the readings" in asked.doubt
    assert "doubtful: no hypothesis" in asked.summary()


def test_the_choice_of_many_settings_is_the_best_of_all_of_them():
    """A few samples pick the settings worth a closer look; the offset alone is read at zero, in the middle."""
    asked = inquiry(goal={"offset": 0.9}, settings=np.linspace(-2.0, 2.0, 401), n_samples=2000)
    at = asked.next()
    assert abs(at) < 0.15
    assert asked.utility[np.argmin(np.abs(np.linspace(-2.0, 2.0, 401) - at))] > 0.98 * asked.utility.max()


def test_an_inquiry_loads_neither_fields_of_shapes_nor_simulators():
    """They take longer to load than a dozen readings to choose."""
    heavy = "'probewise.scene', 'probewise.effects', 'probewise.systems', 'scipy.spatial', 'scipy.interpolate'"
    code = f"import sys; from probewise import Inquiry; sys.exit(' '.join({{{heavy}}} & {{*sys.modules}}) or 0)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_summary_names_readings_evidence_and_goal():
    said = inquiry(goal={"slope": 0.1}).summary()
    assert said.startswith("0 readings, log Z 0.00 ± 0.00")
    assert "asked for 0.1" in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"model": 3.0}, r"model is 3.0; allowed: a function model\(parameters, settings\)"),
        ({"prior": {"slope": 1.0, "offset": Normal(0, 1)}}, "slope.* is 1.0; allowed: Uniform"),
        ({"prior": [0, 1]}, "allowed: Uniform"),
        ({"settings": []}, "settings is .*; allowed: one knob"),
        ({"settings": [("low", 1.0), ("high", 2.0)]}, "settings is .*; allowed: one knob"),
        ({"settings": {"a": ["low", 1.0]}}, "settings.* is .*; allowed: one knob"),
        ({"settings": [0.0, np.nan]}, "settings is nan; allowed: finite numbers"),
        ({"settings": {"a": [1, 2], "b": [1]}}, "settings is {'a': 2, 'b': 1}; allowed: one knob"),
        ({"noise": -1.0}, "noise sd is -1.0; allowed: a number greater than 0"),
        ({"goal": {"slop": 0.1}}, "goal is 'slop'; allowed: parameters among slope, offset; did you mean slope"),
        ({"goal": {"slope": 0.0}}, r"goal\['slope'\] is 0.0; allowed: greater than 0"),
        ({"prior": {"slope": (0, 10**400), "offset": Normal(0, 1)}}, r"'slope'\].*allowed: \(low, high\)"),
        ({"goal": 0.1}, "goal is 0.1; allowed: posterior sds by parameter"),
        ({"cost_s": [1, 1, 1, 1, 0.0]}, "allowed: seconds greater than 0"),
        ({"n_samples": 10}, "n_samples is 10; allowed: a whole number, 400 or more"),
    ],
)
def test_what_cannot_be_asked_is_refused_in_words(arguments, said):
    with pytest.raises(ParameterError, match=said):
        inquiry(**arguments)


@pytest.mark.parametrize(
    ("told", "said"),
    [
        *(((reading,), "allowed: a finite number") for reading in (np.nan, np.inf, None, "3", [1.0, 2.0])),
        *(((1.0, setting), "setting") for setting in ("far", [1.0, 2.0], {"x": 1.0})),
    ],
)
def test_what_is_no_reading_or_no_setting_is_not_taken_in(told, said):
    asked = inquiry()
    with pytest.raises(ParameterError, match=said):
        asked.tell(*told)
    assert asked.readings == ()


def test_a_prediction_that_is_not_finite_is_named():
    def holed(p, x):
        with np.errstate(divide="ignore"):
            return p["offset"] + 0 * p["slope"] / (x - 3.0) + np.where(x == 3.0, np.inf, 0.0)

    asked = inquiry(model=holed)
    with pytest.raises(ParameterError, match=r"the model at slope = .*, offset = .*, setting 3.0 is (nan|inf)"):
        asked.tell(1.0, 3.0)
    assert asked.readings == ()
