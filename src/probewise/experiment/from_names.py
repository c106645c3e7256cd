"""An experiment from names, as on the command line: method, sensor model, utility."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

from probewise._arrays import own_arithmetic
from probewise.calibration import FittedSensor
from probewise.errors import ParameterError
from probewise.experiment.configuration import Experiment
from probewise.experiment.paper import paper_experiment
from probewise.experiment.simulation import Model, default_trust, entropy_bin_width_of, experiment_for
from probewise.inference import Naive
from probewise.inquiry import Finishing, ReadingEntropy, Utility, utility_named
from probewise.nested import NestedStop
from probewise.scene import Card, Field, Shape

MethodName: TypeAlias = Literal["particles", "paper"]


@own_arithmetic
def experiment_from_names(
    sensor: FittedSensor,
    shape: Shape,
    field: Field,
    *,
    method: MethodName = "particles",
    model: Model = "ssf",
    utility: str | Utility | None = None,
    learn_sensor: bool = False,
    batch: int = 1,
    trust: float | None = None,
    nested_stop: NestedStop | None = None,
    naive: Naive | None = None,
    orientations_rad: tuple[float, ...] = (0.0,),
    repeats: tuple[int, ...] = (1,),
    heights_mm: tuple[float, ...] = (),
    cards: tuple[Card, ...] = (),
) -> Experiment:
    """Build an experiment; an option of None takes the default of the method.

    Parameters
    ----------
    method
        "particles": `experiment_for`, sequential Monte Carlo; "paper": `paper_experiment`, which has its own utility,
        assumes a complete sensor model, and chooses one reading at a time.
    utility
        Utility, or its name (see `inquiry.utility_named`).
    nested_stop, naive
        Only for the method "paper"; see `paper_experiment`.
    sensor, shape, field, model, learn_sensor, batch, trust, orientations_rad, repeats, heights_mm, cards
        See `experiment_for`.

    Raises
    ------
    ParameterError
        If a name is unknown, or an option does not go with the method.
    """
    bin_width = entropy_bin_width_of(sensor)
    chosen = utility_named(utility, bin_width=bin_width) if isinstance(utility, str) else utility
    if method == "paper":
        refused = (
            (
                "utility",
                utility,
                chosen is None or isinstance(chosen, ReadingEntropy),
                "entropy, which is the paper's,",
            ),
            ("learn_sensor", learn_sensor, not learn_sensor, "False, since the sensor is known,"),
            ("batch", batch, batch == 1, "1, since each reading is chosen by all before it,"),
            ("cards", cards, not cards, "none, since its scene is the shape alone,"),
            ("trust", trust, trust in (None, 1), "1, since the sensor model is taken for complete,"),
        )
        for name, value, fits, allowed in refused:
            if not fits:
                raise ParameterError(name, value, f"{allowed} with the paper's method")
        return paper_experiment(
            sensor,
            shape,
            field,
            model=model,
            nested_stop=nested_stop or "change",
            naive=naive,
            orientations_rad=orientations_rad,
            repeats=repeats,
            heights_mm=heights_mm,
        )
    if method != "particles":
        raise ParameterError("method", method, " or ".join(map(repr, get_args(MethodName))))
    for name, given in (("nested_stop", nested_stop), ("naive", naive)):
        if given is not None:
            raise ParameterError(name, given, "None, but with the paper's method")
    chosen = Finishing() if chosen is None else chosen
    usual = default_trust(shape, model=model, learn_sensor=learn_sensor, utility=chosen)
    return experiment_for(
        sensor,
        shape,
        field,
        model=model,
        utility=chosen,
        learn_sensor=learn_sensor,
        batch=batch,
        trust=usual if trust is None else trust,
        orientations_rad=orientations_rad,
        repeats=repeats,
        heights_mm=heights_mm,
        cards=cards,
    )
