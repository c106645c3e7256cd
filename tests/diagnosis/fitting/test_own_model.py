"""A model that has nothing to do with light, diagnosed by the same machinery."""

import dataclasses
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import pytest

from probewise.diagnosis import OwnModel, Parameters, diagnose, diagnosis_json
from probewise.effects import VOCABULARY, Backlash, Extent, Known, NamedEffect, OffsetDrift, Saturation
from probewise.errors import NotConvergedError, ParameterError, ShapeError
from probewise.priors import LogUniform, Normal, Product
from probewise.recordings import Instrumentation, Plan, Recording
from probewise.sensor import Stage

PRIOR = Product({"start": LogUniform(10.0, 100.0), "tau_s": LogUniform(10.0, 1000.0)})


def cooling(parameters: Parameters, plan: Plan) -> np.ndarray:
    """Newton's law, towards 0 degrees unless something else is around."""
    around = parameters.get("around", np.zeros((1, 1)))
    return around + (parameters["start"] - around) * np.exp(-plan.time_s / parameters["tau_s"])


@dataclass(frozen=True)
class WarmRoom(NamedEffect[Parameters]):
    """What stands around is not at 0 degrees: a user's own effect, on the parameters."""

    name: ClassVar[str] = "warm_room"
    stage: ClassVar[Stage] = Stage.SCENE
    units: ClassVar[tuple[str, ...]] = ("degree",)
    covariates: ClassVar[tuple[str, ...]] = ("time",)
    amplitudes: ClassVar[tuple[int, ...]] = (0,)

    @classmethod
    def for_extent(cls, extent: Extent) -> Self | None:
        return cls()

    @property
    def prior(self) -> Product:
        return Product({"degree": LogUniform(0.1, 30.0)})

    def apply(self, value: Parameters, theta: np.ndarray, plan: Plan) -> Parameters:
        return {**value, "around": theta[:, :1]}

    def bank(self) -> np.ndarray:
        return np.full((1, 1, 1), 3.0)

    def sentence(self, mean: np.ndarray, sd: np.ndarray) -> str:
        return f"it cools to {mean[0]:.1f} degrees, not to 0"


def plan_of(n: int = 96) -> Plan:
    return Plan(
        x_mm=np.zeros(n),
        y_mm=np.zeros(n),
        orientation_rad=np.zeros(n),
        time_s=6.0 * np.arange(n),
        scan=np.arange(n) * 4 // n,
        scan_names=("a", "b", "c", "d"),
        pattern=np.zeros(n, dtype=int),
        pattern_names=("room",),
        instrumentation=Instrumentation(unit="degree"),
    )


def recording(truth: Parameters, seed: int = 1) -> Recording:
    plan = plan_of()
    noise = 0.2 * np.random.default_rng(seed).standard_normal(len(plan))
    return Recording(plan, cooling({k: np.array([[v]]) for k, v in truth.items()}, plan)[0] + noise)


def diagnosed(truth):
    return diagnose(
        recording(truth),
        null=OwnModel(cooling, PRIOR),
        effects={**VOCABULARY, "warm_room": WarmRoom},
        rng=np.random.default_rng(0),
    )


@pytest.mark.slow
def test_a_users_own_effect_is_named_with_its_size():
    found = diagnosed({"start": 60.0, "tau_s": 120.0, "around": 8.0})
    assert found.verdict == "named"
    assert found.combination == ("warm_room",)
    (degree,) = found.effects[0].parameters
    assert degree.interval95[0] < 8.0 < degree.interval95[1]
    assert found.improvement.heldout_log_density_per_reading > 0
    assert found.next_measurement is None  # nothing moves: there is no scan to repeat
    assert diagnosis_json(found)["format"] == "diagnosis/1"
    assert found.repaired.chain.names == ("start", "tau_s", "warm_room.degree")


def test_a_users_own_model_that_is_right_is_clean():
    found = diagnosed({"start": 60.0, "tau_s": 120.0})
    assert found.verdict == "clean"
    assert "Gaussian" not in found.reason
    np.testing.assert_allclose(found.null.theta.mean(axis=0), (60.0, 120.0), rtol=0.02)


def test_lost_readings_that_show_only_beside_a_large_effect_are_named_with_it():
    """About the null they are no farther off than the rest: a noise model that it cannot have was taken for it."""
    plan = dataclasses.replace(plan_of(), instrumentation=Instrumentation(unit="degree", min=0.0, max=200.0))
    readings = np.where(np.arange(96) < 50, 40.0, 100.0) + 0.2 * np.random.default_rng(1).standard_normal(96)
    readings[[7, 20, 33, 60, 81]] = 0.0
    level = OwnModel(lambda p, plan: p["level"] * np.ones((1, len(plan))), Product({"level": Normal(60.0, 40.0)}))
    known = {name: VOCABULARY[name] for name in ("ambient_step", "dropouts")}
    found = diagnose(Recording(plan, readings), null=level, effects=known, rng=np.random.default_rng(0))
    assert found.combination == ("ambient_step", "dropouts")
    assert found.null.effects == ()
    assert np.isfinite(found.improvement.log_evidence)


def test_effects_act_in_the_order_of_their_stages_on_parameters_and_readings():
    """By hand: the room's temperature into the law, then the drift, then the ceiling."""
    plan = plan_of(5)
    effects = (Known(Saturation(), (50.0, 1e-3)), Known(OffsetDrift(1.0), (3600.0,)), WarmRoom())
    chain = OwnModel(cooling, PRIOR).chain(plan, effects, n_nodes=8)
    assert chain.names == ("start", "tau_s", "warm_room.degree")
    theta = np.array([[60.0, 120.0, 8.0], [30.0, 60.0, 4.0]])
    law = theta[:, 2:] + (theta[:, :1] - theta[:, 2:]) * np.exp(-plan.time_s / theta[:, 1:2])
    np.testing.assert_allclose(chain.predict(theta, plan), np.minimum(law + plan.time_s, 50.0), atol=1e-2)


def test_an_effect_that_only_a_light_sensor_has_is_refused():
    model = OwnModel(cooling, PRIOR)
    assert not model.admits(Backlash())
    with pytest.raises(ParameterError, match="backlash"):
        model.chain(plan_of(5), (Backlash(),), n_nodes=8)


def test_a_simulator_of_the_wrong_shape_is_told_the_right_one():
    chain = OwnModel(lambda parameters, plan: plan.time_s, PRIOR).chain(plan_of(5), (), n_nodes=8)
    with pytest.raises(ShapeError, match="samples x readings"):
        chain.predict(np.ones((3, 2)), plan_of(5))


def test_a_model_that_predicts_no_numbers_did_not_converge():
    broken = OwnModel(lambda parameters, plan: parameters["start"] * np.full(len(plan), np.nan), PRIOR)
    with pytest.raises(NotConvergedError, match="are not finite"):
        diagnose(recording({"start": 60.0, "tau_s": 120.0}), null=broken, rng=np.random.default_rng(0))


def test_a_sensor_and_a_null_together_are_refused():
    known = type("Known", (), {"names": ("a",), "samples": np.ones((5, 1))})()
    with pytest.raises(ParameterError, match="one of them"):
        diagnose(
            recording({"start": 60.0, "tau_s": 120.0}),
            sensor=known,
            null=OwnModel(cooling, PRIOR),
            rng=np.random.default_rng(0),
        )
