"""The kinds of hypotheses that a run compares, and the posterior: a mixture of kinds, each with samples and evidence.

A kind is a shape together with at most one effect that the sensor model leaves out. Its probability is proportional to
its prior times its evidence. Improbable kinds are kept with fewer samples, so that later readings can revive them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from probewise._arrays import FloatArray, IntArray, logsumexp, read_only_floats
from probewise.effects import Effect, Known
from probewise.experiment.rivals import SensorModelRival, powers_of_s
from probewise.inference.problem import Likelihood, SensorProblem, checked_log_prob
from probewise.inquiry import TabulatedChain
from probewise.inquiry.smc import Particles, prior_particles
from probewise.nested import Weighted
from probewise.priors import Joint, Prior
from probewise.recordings.plan import Plan, Recording
from probewise.scene.shapes import AnyOf, Shape
from probewise.sensor import Chain
from probewise.sensor.stages import SensorModel

IMPROBABLE = 1e-3  # probability below which a kind is carried by fewer samples
_IMPROBABLE_DIVISOR = 3  # of its number of samples
SUSPECTED_PROBABILITY = 0.02  # of a left-out effect, below which its samples are few and moved only briefly
# Least probability of a left-out effect, and the divisor of its number of samples.
_SAMPLE_DIVISORS = ((0.2, 2), (SUSPECTED_PROBABILITY, 4), (0.0, 6))
_LEAST_SAMPLES = 100

LEFT_OUT_ODDS_FACTOR = 14.0
"""Factor on the odds that the sensor model is incomplete, wherever something is concluded: choice of readings, stopping
rule, reported shape and its error, credible set. By the plain odds an effect that a dozen readings can hardly show
would be left out in one run of ten, and every conclusion of such a run would miss it."""


class KindProblem(SensorProblem):
    """The problem of one kind, for nested sampling and, reading by reading, for `inquiry.smc`."""

    def evaluate(self, theta: FloatArray) -> FloatArray:
        """Predict all readings, (n_samples, n_params) -> (n_samples, n_points)."""
        return self.model.predict(theta, self.recording.plan)

    def log_likelihoods(self, evaluated: FloatArray, power: float) -> tuple[FloatArray, FloatArray]:
        """Return log likelihoods, (n_samples,), without (zero where `power` is 1) and with the last reading."""
        usable, readings = self.recording.usable, self.recording.readings
        earlier = usable & (power < 1.0)
        earlier[-1:] = False
        without, with_last = (
            checked_log_prob(self.likelihood, readings[rows], evaluated[:, rows])
            if rows.any()
            else np.zeros(len(evaluated))
            for rows in (earlier, usable)
        )
        return without, with_last

    def least_misfit_nats(self, evaluated: FloatArray) -> float:
        """Return by how many nats the best prediction of the last reading misses it; 0 if that reading is missing."""
        if not self.recording.usable[-1]:
            return 0.0
        best = checked_log_prob(self.likelihood, self.recording.readings[-1:], evaluated[:, -1:]).max()
        return float(self.perfect_log_likelihood - best)

    @property
    def perfect_log_likelihood(self) -> float:
        """Log likelihood of the last reading if predicted exactly; 0 if that reading is missing."""
        reading = self.recording.readings[-1:]
        return float(checked_log_prob(self.likelihood, reading, reading[None])[0]) if self.recording.usable[-1] else 0.0


@dataclass(frozen=True, eq=False)
class HypothesisKind:
    """A shape with at most one left-out effect; its samples and evidence are in `PosteriorByKind.particles`."""

    member: _MemberShape  # the shape, one of a set or the single one
    left_out: str  # name of the effect that the sensor model leaves out; "" if none
    log_prior: float  # natural log of the kind's prior probability
    prior: Prior  # this, model and likelihood are of the parameters of shape and effect
    model: SensorModel
    likelihood: Likelihood
    effect: Effect | None = None  # the one left out, if it acts on the noise-free reading; its parameters are the last

    @property
    def shape(self) -> str:
        """Name of the shape in a set of shapes; "" for a single shape."""
        return self.member.label

    def at_pace(self, particles: Particles, before_s: float, now_s: float) -> Particles:
        """Return the samples of the same hypotheses where a paced second stands for another time.

        `before_s` and `now_s` are the mean seconds per reading. The prior, which is of paced time, reweights them.
        """
        powers = powers_of_s(self.effect)
        if before_s == now_s or not powers.any() or particles.log_z == -math.inf:
            return particles
        weighted, factors = particles.weighted, (before_s / now_s) ** powers
        theta = weighted.theta.copy()
        theta[:, -len(powers) :] *= factors
        alive = np.isfinite(weighted.log_weight)
        before, after = (np.where(alive, self.prior.log_prob(values), 0.0) for values in (weighted.theta, theta))
        log_weight = weighted.log_weight + after - before + np.log(factors).sum()
        gained = float(logsumexp(log_weight))
        if gained == -math.inf:
            return particles
        moved = replace(weighted, theta=theta, log_weight=log_weight - gained, log_z=weighted.log_z + gained)
        return replace(particles, weighted=moved)

    def problem(self, recording: Recording) -> KindProblem:
        """Set up the inference of this kind from a recording."""
        return KindProblem(self.prior, self.model, self.likelihood, recording)


def kinds_of(
    shape: Shape,
    sensor_prior: Prior | None,
    prior: Prior,
    models: tuple[SensorModel, SensorModel],
    likelihood: Likelihood,
    *,
    trust: float,
    rivals: Sequence[SensorModelRival],
) -> tuple[HypothesisKind, ...]:
    """Return the kinds of hypotheses of an experiment: for every shape, the sensor model alone and with each rival.

    `prior` and `likelihood` are those of all parameters, of which those of `sensor_prior` (None: the sensor is known)
    come first. `models` are the sensor model, from tables where possible, and the chain to which effects are added.
    `trust` is the prior probability that the sensor model is complete; the names of the rivals share the rest equally.
    Below 1, the kinds without a rival also infer the effects that a repair of the sensor estimated.
    """
    quick, chain = models
    ways = Counter(rival.name for rival in rivals)
    kinds = []
    for part in _member_shapes(shape, sensor_prior, prior):
        whole = _prior_and_model_with_estimated_effects(part.prior, chain, quick) if trust < 1 else (part.prior, quick)
        kinds.append(_kind(part, "", trust, *whole, likelihood))
        for rival in rivals:
            share = (1.0 - trust) / (len(ways) * ways[rival.name])
            if rival.effect is None:
                kinds.append(_kind(part, rival.name, share, part.prior, quick, rival.likelihood or likelihood))
                continue
            assert isinstance(chain, Chain)
            both = Joint((part.prior, _PrefixedPrior(rival.name, rival.effect.prior)))
            acting = chain.with_effects(rival.effect)
            model = TabulatedChain.of(acting, quick) or acting
            kinds.append(_kind(part, rival.name, share, both, model, likelihood, rival.effect))
    return tuple(kinds)


def _kind(
    member: _MemberShape,
    left_out: str,
    share: float,
    prior: Prior,
    model: SensorModel,
    likelihood: Likelihood,
    effect: Effect | None = None,
) -> HypothesisKind:
    log_prior = math.log(member.share) + math.log(share)
    return HypothesisKind(member, left_out, log_prior, prior, member.restrict_model(model), likelihood, effect)


def _prior_and_model_with_estimated_effects(
    prior: Prior, chain: SensorModel, quick: SensorModel
) -> tuple[Prior, SensorModel]:
    """Return prior and model with parameters for the effects that a repair of the sensor estimated, if any."""
    effects = chain.effects if isinstance(chain, Chain) else ()
    estimated = [effect for effect in effects if isinstance(effect, Known) and effect.marginals]
    if not estimated or not isinstance(chain, Chain):
        return prior, quick
    informed = [effect.informed for effect in estimated]
    known = tuple(effect for effect in chain.effects if effect not in estimated)
    acting = replace(chain, effects=(*known, *informed))
    both = Joint((prior, *(_PrefixedPrior(effect.name, effect.prior) for effect in informed)))
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
        """Return the experiment's parameters for the shape's, (n, n_own); draw those missing, drop the effect's."""
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
    """Return the shapes of a set, or the single shape, each with the sensor's parameters before the shape's."""
    if not isinstance(shape, AnyOf):
        return [_MemberShape("", 1.0, prior, prior, np.arange(len(prior.names)), number=None, n_sensor=0)]
    n_sensor = 0 if sensor_prior is None else len(sensor_prior.names)
    parts = []
    for k, (name, member) in enumerate(shape.shapes.items()):
        columns = np.concatenate([np.arange(n_sensor), n_sensor + shape.prior.columns_by_shape[k]])
        of_member = member.prior if sensor_prior is None else Joint((sensor_prior, member.prior))
        parts.append(_MemberShape(name, shape.weights[k], of_member, prior, columns, number=k, n_sensor=n_sensor))
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
    prior: Prior

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{self.effect}.{name}" for name in self.prior.names)

    def from_unit_cube(self, u: FloatArray) -> FloatArray:
        return self.prior.from_unit_cube(u)

    def to_unit_cube(self, theta: FloatArray) -> FloatArray:
        return self.prior.to_unit_cube(theta)

    def log_prob(self, theta: FloatArray) -> FloatArray:
        return self.prior.log_prob(theta)


@dataclass(frozen=True, eq=False)
class PosteriorByKind:
    """The kinds of hypotheses and, in the same order, their weighted samples with the evidence."""

    kinds: tuple[HypothesisKind, ...]
    particles: tuple[Particles, ...]

    @property
    def log_odds(self) -> FloatArray:
        """Log of prior times evidence of each kind, (n_kinds,)."""
        return np.array([k.log_prior + p.log_z for k, p in zip(self.kinds, self.particles, strict=True)])

    @property
    def probability(self) -> FloatArray:
        """Probability of each kind, (n_kinds,), summing to one."""
        log_odds = self.log_odds
        share = np.exp(log_odds - log_odds.max())
        return np.asarray(share / share.sum())

    @property
    def log_z(self) -> float:
        """Natural log of the evidence of the mixture."""
        return float(logsumexp(self.log_odds))

    @property
    def left_out(self) -> dict[str, float]:
        """Probability of each effect that the sensor may leave out, marginalised over shapes; "" is none."""
        shares: dict[str, float] = {}
        for kind, p in zip(self.kinds, self.probability.tolist(), strict=True):
            shares[kind.left_out] = shares.get(kind.left_out, 0.0) + p
        return shares

    @property
    def doubts_sensor(self) -> bool:
        """Whether some kind has an effect that the sensor model leaves out."""
        return any(kind.left_out for kind in self.kinds)

    @property
    def most_probable_kind_index(self) -> int:
        """Index of the most probable kind."""
        return int(self.log_odds.argmax())

    def with_raised_left_out_odds(self) -> PosteriorByKind:
        """Return the posterior with the odds of left-out effects multiplied by `LEFT_OUT_ODDS_FACTOR`."""
        if not self.doubts_sensor:
            return self
        raised = math.log(LEFT_OUT_ODDS_FACTOR)
        log_prior = np.array([k.log_prior + (raised if k.left_out else 0.0) for k in self.kinds])
        log_prior -= logsumexp(log_prior)
        kinds = tuple(replace(k, log_prior=p) for k, p in zip(self.kinds, log_prior.tolist(), strict=True))
        return replace(self, kinds=kinds)

    def joined(self, *, rng: np.random.Generator) -> Weighted:
        """Return the samples of all kinds as one weighted posterior; parameters that a kind lacks are drawn."""
        if len(self.kinds) == 1:
            return self.particles[0].weighted
        probability = self.probability
        some = np.flatnonzero(probability > 0)
        parts = [self.particles[k].weighted for k in some]
        theta = np.concatenate(
            [self.kinds[k].member.to_whole_theta(w.theta, rng) for k, w in zip(some, parts, strict=True)]
        )
        log_weight = np.concatenate([w.log_weight + math.log(probability[k]) for k, w in zip(some, parts, strict=True)])
        weight = np.exp(log_weight)
        errors = np.array([self.particles[k].log_z_error for k in some])
        return Weighted(
            self.kinds[0].member.whole.names,
            theta,
            log_likelihood=np.concatenate([w.log_likelihood for w in parts]),
            log_weight=log_weight,
            log_z=self.log_z,
            log_z_error=float(np.sqrt(probability[some] ** 2 @ errors**2)),
            n_eff=float(weight.sum() ** 2 / (weight @ weight)),
            n_calls=sum(p.weighted.n_calls for p in self.particles),
            pareto_k=max(w.pareto_k for w in parts),
            run=self.particles[self.most_probable_kind_index].weighted.run,
        )


def prior_posterior(kinds: Sequence[HypothesisKind], n_particles: int, *, rng: np.random.Generator) -> PosteriorByKind:
    """Return the posterior without readings: samples of every kind's prior, fewer for improbable kinds and rivals."""
    sizes = [n_samples_of_kind(kind, math.exp(kind.log_prior), n_particles) for kind in kinds]
    drawn = (prior_particles(kind.prior, n, rng=rng) for kind, n in zip(kinds, sizes, strict=True))
    return PosteriorByKind(tuple(kinds), tuple(drawn))


def n_samples_of_kind(kind: HypothesisKind, probability: float, n_particles: int) -> int:
    """Return a kind's number of samples: fewer if improbable; with a left-out effect at most half, but 100 or more."""
    if kind.left_out:
        divisor = next(divisor for least, divisor in _SAMPLE_DIVISORS if probability >= least)
        return max(n_particles // divisor, _LEAST_SAMPLES)
    return n_particles if probability >= IMPROBABLE else n_particles // _IMPROBABLE_DIVISOR
