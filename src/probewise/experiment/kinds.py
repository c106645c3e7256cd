"""The kinds of hypotheses that a run compares: a shape, with an effect that the sensor model leaves out or none."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray, read_only_floats
from probewise.effects import Estimated
from probewise.errors import ParameterError
from probewise.experiment.pace import DescribedEffect
from probewise.experiment.rivals import SensorModelRival
from probewise.inference.problem import Likelihood, SensorProblem
from probewise.inquiry import TabulatedChain
from probewise.priors import Joint, Prior
from probewise.recordings.plan import Plan, Recording
from probewise.scene.albedo import Shape
from probewise.scene.any_of import AnyOf
from probewise.sensor import Chain
from probewise.sensor.stages import SensorModel


@dataclass(frozen=True, eq=False)
class HypothesisKind:
    """A model with its own parameters and evidence; one of several that a run compares.

    Attributes
    ----------
    shape
        Name of the model's shape in a set of shapes; "" for a single shape.
    left_out
        Name of the effect that the sensor model leaves out; "" if none.
    log_prior
        Natural log of the model's prior probability.
    prior, model, likelihood
        Prior, model and likelihood of the model's own parameters.
    to_whole_theta
        Function of the model's parameters, (n, n_own), and a random generator; returns the parameters of the whole
        experiment, (n, n_params): missing ones are drawn from the prior, the effect's are dropped.
    whole_names
        Names of the experiment's parameters.
    effect
        The effect left out, if it acts on the noise-free reading; its parameters are the last ones.
    """

    shape: str
    left_out: str
    log_prior: float
    prior: Prior
    model: SensorModel
    likelihood: Likelihood
    to_whole_theta: Callable[[FloatArray, np.random.Generator], FloatArray]
    whole_names: tuple[str, ...]
    effect: DescribedEffect | None = None

    def problem(self, recording: Recording) -> SensorProblem:
        """Set up the inference of this kind from a recording."""
        return SensorProblem(self.prior, self.model, self.likelihood, recording)


def kinds_of(
    shape: Shape,
    sensor_prior: Prior | None,
    prior: Prior,
    models: tuple[SensorModel, SensorModel],
    likelihood: Likelihood,
    *,
    trust: float = 1.0,
    rivals: Sequence[SensorModelRival] = (),
) -> tuple[HypothesisKind, ...]:
    """Return the kinds of hypotheses of an experiment: for every shape, the sensor model alone and with each rival.

    Parameters
    ----------
    shape
        The possible shape; each shape of a set has kinds of its own.
    sensor_prior
        Prior of the sensor's parameters, which come before the shape's in every kind; None: the sensor is known.
    prior, likelihood
        Prior and likelihood of all parameters of the experiment.
    models
        The sensor model, from tables where possible, for kinds without effects; the chain to which effects are added.
    trust
        Prior probability that the sensor model is complete, below 1 if there are rivals, which share the rest equally.
        Below 1, the kinds without a rival also infer the effects that a repair of the sensor estimated.
    rivals
        Effects that the sensor model may leave out, and other likelihoods; those of one name share one probability.

    Raises
    ------
    ParameterError
        If an effect is to be added to a sensor model that is no `Chain`.
    """
    quick, chain = models
    ways = Counter(rival.name for rival in rivals)
    kinds = []
    for part in _member_shapes(shape, sensor_prior, prior):
        own, log_prior = part.prior, math.log(part.share)
        plain = log_prior + math.log(trust)
        whole, model = _prior_and_model_with_estimated_effects(own, chain, quick) if trust < 1 else (own, quick)
        kinds.append(
            HypothesisKind(
                part.label,
                "",
                log_prior=plain,
                prior=whole,
                model=part.restrict_model(model),
                likelihood=likelihood,
                to_whole_theta=part.to_whole_theta,
                whole_names=prior.names,
            )
        )
        for rival in rivals:
            log_p = log_prior + math.log((1.0 - trust) / (len(ways) * ways[rival.name]))
            if rival.effect is None:
                model, law = part.restrict_model(quick), rival.likelihood or likelihood
                kinds.append(
                    HypothesisKind(
                        part.label,
                        rival.name,
                        log_prior=log_p,
                        prior=own,
                        model=model,
                        likelihood=law,
                        to_whole_theta=part.to_whole_theta,
                        whole_names=prior.names,
                    )
                )
                continue
            if not isinstance(chain, Chain):
                raise ParameterError("rivals", rival.name, "none beside a sensor model that is no Chain")
            both = Joint((own, _PrefixedPrior(rival.name, rival.effect.prior)))
            acting = chain.with_effects(rival.effect)
            model = part.restrict_model(TabulatedChain.of(acting, quick) or acting)
            kinds.append(
                HypothesisKind(
                    part.label,
                    rival.name,
                    log_prior=log_p,
                    prior=both,
                    model=model,
                    likelihood=likelihood,
                    to_whole_theta=part.to_whole_theta,
                    whole_names=prior.names,
                    effect=rival.effect,
                )
            )
    return tuple(kinds)


def _prior_and_model_with_estimated_effects(
    own: Prior, chain: SensorModel, quick: SensorModel
) -> tuple[Prior, SensorModel]:
    """Return prior and model with parameters for the effects that a repair of the sensor estimated, if any."""
    estimated = [e for e in chain.effects if isinstance(e, Estimated)] if isinstance(chain, Chain) else []
    if not estimated or not isinstance(chain, Chain):
        return own, quick
    informed = [effect.informed for effect in estimated]
    known = tuple(effect for effect in chain.effects if not isinstance(effect, Estimated))
    acting = replace(chain, effects=(*known, *informed))
    both = Joint((own, *(_PrefixedPrior(effect.name, effect.prior) for effect in informed)))
    return both, TabulatedChain.of(acting, quick) or acting


@dataclass(frozen=True, eq=False)
class _MemberShape:
    """One shape of a set, or the single one: `prior` of the sensor's and its parameters, and their columns of theta.

    `share` is the shape's prior probability, `whole` the experiment's prior, `number` the shape's index in the set (for
    a single shape, None), `n_sensor` the number of columns of the sensor's parameters, which come first.
    """

    label: str
    share: float
    prior: Prior
    whole: Prior
    columns: IntArray
    number: int | None
    n_sensor: int

    def to_whole_theta(self, theta: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return the experiment's parameters for own ones, (n, n_own); draw those missing, drop the effect's."""
        if self.number is None:
            return theta[:, : len(self.columns)]
        u = rng.random((len(theta), len(self.whole.names)))
        full = self.whole.from_unit_cube(u)
        full[:, self.n_sensor] = self.number + u[:, self.n_sensor]
        full[:, self.columns] = theta[:, : len(self.columns)]
        return np.asarray(full)

    def restrict_model(self, whole: SensorModel) -> SensorModel:
        """Restrict a model of all parameters, and perhaps an effect's after these, to the parameters of this shape."""
        if self.number is None:
            return whole
        middle = self.whole.from_unit_cube(np.full((1, len(self.whole.names)), 0.5))[0]
        middle[self.n_sensor] = self.number + 0.5
        more = whole.names[len(middle) :]
        columns = np.concatenate([self.columns, np.arange(len(middle), len(whole.names))])
        others = read_only_floats(np.concatenate([middle, np.zeros(len(more))]))
        return _RestrictedModel(whole, (*self.prior.names, *more), columns, others)


def _member_shapes(shape: Shape, sensor_prior: Prior | None, prior: Prior) -> list[_MemberShape]:
    """Return the shapes of a set, or the single shape, each with the sensor's parameters before its own."""
    if not isinstance(shape, AnyOf):
        return [
            _MemberShape(
                "", 1.0, prior=prior, whole=prior, columns=np.arange(len(prior.names)), number=None, n_sensor=0
            )
        ]
    n_sensor = 0 if sensor_prior is None else len(sensor_prior.names)
    parts = []
    for k, (name, member) in enumerate(shape.shapes.items()):
        columns = np.concatenate([np.arange(n_sensor), n_sensor + shape.prior.columns_by_shape[k]])
        own = member.prior if sensor_prior is None else Joint((sensor_prior, member.prior))
        parts.append(
            _MemberShape(name, shape.weights[k], prior=own, whole=prior, columns=columns, number=k, n_sensor=n_sensor)
        )
    return parts


@dataclass(frozen=True, eq=False)
class _RestrictedModel:
    """A model of the parameters `columns` of a larger one; the other columns, without influence, stay at `others`."""

    whole: SensorModel
    names: tuple[str, ...]
    columns: IntArray
    others: FloatArray

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        full = np.tile(self.others, (len(theta), 1))
        full[:, self.columns] = theta
        return self.whole.predict(full, plan)


@dataclass(frozen=True, eq=False)
class _PrefixedPrior:
    """An effect's prior with parameter names as in a chain, "effect.parameter"."""

    effect: str
    own: Prior

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{self.effect}.{name}" for name in self.own.names)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        return self.own.from_unit_cube(u)

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        return self.own.to_unit_cube(theta)

    def log_prob(self, theta: FloatArray) -> FloatArray:
        return self.own.log_prob(theta)
