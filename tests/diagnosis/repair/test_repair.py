"""What a repair says of its samples."""

from types import SimpleNamespace

import numpy as np

from probewise.diagnosis.repair.repair import Predicted, Repair

LAG = SimpleNamespace(name="lag", sentence=lambda mean, sd: f"it lags by {mean[0]:.0f} s")


def repair(absent=None, residuals=(1.0, np.nan)):
    model = SimpleNamespace(
        absent=absent or {},
        chain=SimpleNamespace(effects=(LAG,)),
        effect_samples=lambda name: np.array([[2.0], [2.0], [0.0], [0.0]]),
    )
    before = Predicted(np.zeros(2), np.array([1.0, np.nan]))
    return Repair(model, model, None, before, Predicted(np.zeros(2), np.array(residuals)))


def test_a_repair_that_predicts_the_same_changes_nothing():
    assert not repair().changes_predictions
    assert repair(residuals=(0.5, np.nan)).changes_predictions


def test_what_samples_lack_is_left_open_in_its_share():
    marks = {"lag": np.array([False, False, True, False]), "step": np.array([True, True, True, False])}
    assert repair(marks).combination_shares == {("lag",): 0.5, (): 0.25, ("lag", "step"): 0.25}


def test_what_is_carried_and_not_stated_is_said_of_the_samples_that_hold_it():
    marks = {"lag": np.array([False, False, True, True])}
    assert repair(marks).unstated_effects(set()) == (("lag", 0.5, "it lags by 2 s"),)
    assert repair(marks).unstated_effects({"lag"}) == ()
