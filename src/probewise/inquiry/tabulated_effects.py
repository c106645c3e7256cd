"""Predictions with effects that act before or after the white fraction of the footprint, tabulated for a disc."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from probewise._arrays import FloatArray
from probewise.inquiry.carded import CardedModel
from probewise.inquiry.discs import DiscTable, is_known_footprint_effect
from probewise.recordings.plan import Plan
from probewise.scene.cards import mean_albedo_with_cards
from probewise.sensor import Chain
from probewise.sensor.stages import SensorModel, Stage, View


@dataclass(frozen=True, eq=False)
class TabulatedChain:
    """A chain over one disc that takes the seen white fraction from a table, and applies the other effects unchanged.

    No effect may change the disc itself, and effects on the footprint must be those of the table. `cards`: the model
    with known cards, if there are any.
    """

    chain: Chain
    table: DiscTable
    cards: CardedModel | None = None

    @classmethod
    def of(cls, chain: Chain, plain: SensorModel) -> Self | None:
        """Make `chain` a chain over the table of `plain`, the same chain with fewer effects; None if impossible."""
        if isinstance(plain, TabulatedChain):
            plain = plain.table if plain.cards is None else plain.cards
        cards = plain if isinstance(plain, CardedModel) else None
        table = plain if cards is None else cards.plain
        if not isinstance(table, DiscTable) or chain.names[:3] != table.names:
            return None
        seen = (effect for effect in chain.effects if effect.stage in (Stage.SCENE, Stage.FOOTPRINT))
        if not all(map(is_known_footprint_effect, seen)):
            return None
        return cls(chain, table, cards)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the chain's parameters."""
        return self.chain.names

    def predict(self, theta: FloatArray, plan: Plan) -> FloatArray:
        """Predict noise-free readings, (n_samples, n_params) -> (n_samples, n_points), by the table and the effects."""
        poses, disc, table = self.chain.poses(theta, plan), theta[:, :3], self.table
        level = table.predict_at(disc, poses.x_mm, poses.y_mm, poses.orientation_rad)
        seen = (level - table.dark) / (table.bright - table.dark)
        if self.cards is not None:
            seen = mean_albedo_with_cards(seen, self.cards.cards, self.cards.footprint_share_by_card(poses, plan))
        return self.chain.readings_from_simulated_view(
            View(np.asarray(seen), poses, self.chain.scene.regions(disc)), theta, plan
        )
