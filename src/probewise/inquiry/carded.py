"""Predictions with known cards (rectangles of known albedo) on the field, over tabulated predictions of the shape."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from probewise._arrays import FloatArray, IntArray
from probewise.inquiry.designs import Designs
from probewise.inquiry.forecast import (
    Forecast,
    PredictiveDistributions,
    nearest_level_index,
    resampled_rows_and_weights,
    weight_by_level,
)
from probewise.recordings.plan import Plan
from probewise.scene.cards import Card, CardedScene, mean_albedo_with_cards
from probewise.sensor import Chain, FixedLevels, FixedMixture
from probewise.sensor.chain import RegionsAndPoses, response
from probewise.sensor.commanded import led_state, with_led_on
from probewise.sensor.stages import Poses, SensorModel

_REACH = 6.0  # sds of the footprint
_SHOWS = 1e-4  # share of the footprint on a card from which the card counts
_MOST_ASKED = 400


def cards_of(model: SensorModel) -> tuple[Card, ...]:
    """Return the known cards on a model's field; empty if its scene has none."""
    scene = getattr(model, "scene", None)
    return scene.cards if isinstance(scene, CardedScene) else ()


@dataclass(frozen=True, eq=False)
class CardedModel:
    """A sensor model without effects, for a shape and known cards on the field.

    `plain` predicts the shape alone; `chain` gives the share of the footprint on each card in closed form.
    """

    chain: Chain
    plain: SensorModel

    @property
    def names(self) -> tuple[str, ...]:
        """The shape's parameters."""
        return self.plain.names

    @property
    def cards(self) -> tuple[Card, ...]:
        """The known cards on the field."""
        return cards_of(self.chain)

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings, (n_samples, n_params) -> (n_samples, n_points)."""
        covered = self.footprint_share_by_card(
            Poses(plan.x_mm[None], plan.y_mm[None], plan.orientation_rad[None]), plan
        )
        dark, bright = self.black_and_white_readings
        seen = (self.plain.predict(theta, with_led_on(plan)) - dark) / (bright - dark)
        return np.asarray(dark + (bright - dark) * led_state(plan) * mean_albedo_with_cards(seen, self.cards, covered))

    @property
    def black_and_white_readings(self) -> tuple[float, float]:
        """Readings over black and over white: (I_min, I_max)."""
        levels = self.chain.levels
        assert isinstance(levels, FixedLevels)
        return levels.i_min, levels.i_max

    def footprint_share_by_card(self, poses: Poses, plan: Plan) -> list[FloatArray]:
        """Return for each card the share of the footprint on the card, (n_samples or 1, n_points)."""
        mixture = self.chain.ssf
        assert isinstance(mixture, FixedMixture)
        sd = np.sqrt(np.linalg.eigvalsh(mixture.covs_mm2)[:, -1])
        reach = float((np.linalg.norm(mixture.means_mm, axis=1) + _REACH * sd).max())
        footprint = mixture.footprint(np.empty((1, 0)))
        found = []
        for card in self.cards:
            out = np.zeros(np.broadcast_shapes(poses.x_mm.shape, poses.y_mm.shape))
            within = (np.abs(poses.x_mm - card.x_mm) < card.width_mm / 2 + reach) & (
                np.abs(poses.y_mm - card.y_mm) < card.height_mm / 2 + reach
            )
            rows = np.flatnonzero(within.any(axis=0))
            if rows.size:
                there = Poses(*(a[:, rows] for a in (poses.x_mm, poses.y_mm, poses.orientation_rad)))
                part = plan.take(rows)
                regions = dict.fromkeys(part.pattern_names, card.region)
                out[:, rows] = response(RegionsAndPoses(regions, there, part), footprint, n_nodes=self.chain.n_nodes)
            found.append(out)
        return found


@dataclass(frozen=True, eq=False)
class CardedForecast:
    """A forecast by tables of the shape for all hypotheses; near cards, by direct predictions of at most 400."""

    base: Forecast
    chain: Chain

    @property
    def model(self) -> CardedModel:
        """The sensor model, with the cards."""
        return CardedModel(self.chain, self.base.model)

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings, with cards: (n_samples, n_params) -> (n_samples, n_points)."""
        return CardedModel(self.chain, _ForecastAsModel(self.base)).predict(theta, plan)

    def predictive(
        self, theta: FloatArray, weight: FloatArray, designs: Designs, plan: Plan, rows: IntArray, noise_sd: float
    ) -> PredictiveDistributions:
        """Return the predictive distribution at `rows`; see `Forecast.predictive`."""
        base = self.base.predictive(theta, weight, designs, plan, rows, noise_sd)
        there, model = plan.take(rows), self.model
        covered = model.footprint_share_by_card(
            Poses(there.x_mm[None], there.y_mm[None], there.orientation_rad[None]), there
        )
        near = np.flatnonzero(sum(share[0] for share in covered) > _SHOWS)
        if not near.size:
            return base
        chosen, share = resampled_rows_and_weights(weight, _MOST_ASKED)
        answers = model.predict(theta[chosen], there.take(near))
        return _CardedPredictive(base, chosen, share / weight[chosen], answers, near, len(rows))


@dataclass(frozen=True, eq=False)
class _ForecastAsModel:
    """Adapter that gives a forecast the interface of a sensor model."""

    forecast: Forecast

    @property
    def names(self) -> tuple[str, ...]:
        return self.forecast.model.names

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        return self.forecast.predict(theta, plan)


@dataclass(frozen=True, eq=False)
class _CardedPredictive:
    """Predictions by the tables of `base`, except for designs `near` a card, of `n_rows` in all.

    There `answers` are the readings predicted by the hypotheses `chosen`, (n_chosen, n_near); `stands_for` is the
    factor from the weight of each to that of all hypotheses for which it stands.
    """

    base: PredictiveDistributions
    chosen: IntArray
    stands_for: FloatArray
    answers: FloatArray
    near: IntArray
    n_rows: int

    @property
    def levels(self) -> FloatArray:
        return self.base.levels

    def level_weights(self, weight: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield the weight of each level at each design; see `PredictiveDistributions.level_weights`."""
        own, n = weight[self.chosen] * self.stands_for, len(self.near)
        levels = self.levels
        index = nearest_level_index(self.answers, levels)
        mass_there = weight_by_level(np.clip(index, 0, len(levels) - 1), own, len(levels))
        number = np.full(self.n_rows, -1)
        number[self.near] = np.arange(n)
        for at, mass in self.base.level_weights(weight):
            sees = np.flatnonzero(number[at] >= 0)
            if sees.size:
                mass = mass.copy()
                mass[sees] = mass_there[number[at[sees]]]
            yield at, mass
