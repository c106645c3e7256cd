"""What a case conceals: kept apart from its recording, for scoring only."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

from probewise.world.challenge.inside import INSIDE, NO_PHYSICS
from probewise.world.challenge.outsiders import OUTSIDE
from probewise.world.challenge.regions import Region
from probewise.world.challenge.sensors import NOISE_NAMES
from probewise.world.challenge.strata import Stratum
from probewise.world.concealed import Concealed

__all__ = ["Alias", "Hidden", "Truth"]


@dataclass(frozen=True)
class Hidden:
    """One concealed effect.

    Parameters
    ----------
    effect
        What it is, with its parameters.
    size_lambda
        What is left of it when the null model has been refitted, in units of the noise's sd.
    region
        Where it is; None: everywhere.
    """

    effect: Concealed
    size_lambda: float
    region: Region | None = None

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name

    @property
    def in_vocabulary(self) -> bool:
        """Whether a diagnosis can name it."""
        return self.name in INSIDE

    @property
    def shows_in(self) -> tuple[str, ...]:
        """Covariates that its residual shows in."""
        return (INSIDE.get(self.name) or OUTSIDE[self.name]).shows_in

    @property
    def parameters(self) -> dict[str, object]:
        """Parameters by name, as in the vocabulary."""
        return dict(vars(self.effect))


@dataclass(frozen=True)
class Alias:
    """An effect that looks like the concealed one in this plan, and how much."""

    effect: Concealed
    cosine: float


@dataclass(frozen=True)
class Truth:
    """Everything about a case that its recording does not say.

    Parameters
    ----------
    seed, number
        The case again.
    stratum
        What kind of case it was to be.
    ssf, noise_level, noise_model, plan
        Names of SSFS, NOISE_LEVELS, NOISE_MODELS and PLANS.
    noise_sd, black, white
        The sensor's numbers.
    hidden
        What is concealed, in the order of the vocabulary.
    cosine
        Of the surviving parts of a pair; None: no pair.
    alias
        What the concealed effect cannot be told from; None where that was not asked.
    """

    seed: int
    number: int
    stratum: Stratum
    ssf: str
    noise_level: str
    noise_model: str
    plan: str
    noise_sd: float
    black: float
    white: float
    hidden: tuple[Hidden, ...] = ()
    cosine: float | None = None
    alias: Alias | None = None

    @property
    def combination(self) -> tuple[str, ...]:
        """What a perfect diagnosis says: names, sorted; () when clean; ("unknown",) outside the vocabulary.

        The name of the noise model is among them.
        """
        if any(not hidden.in_vocabulary for hidden in self.hidden):
            return ("unknown",)
        names = {hidden.name for hidden in self.hidden} - NO_PHYSICS
        if self.noise_model in NOISE_NAMES:
            names.add(NOISE_NAMES[self.noise_model])
        return tuple(sorted(names))

    def to_json(self) -> str:
        """Write all of it as strict JSON, "format": "truth/1"."""
        content = {
            "format": "truth/1",
            **{field.name: getattr(self, field.name) for field in dataclasses.fields(self)},
            "stratum": dataclasses.asdict(self.stratum),
            "combination": self.combination,
            "hidden": [
                {
                    "name": hidden.name,
                    "in_vocabulary": hidden.in_vocabulary,
                    "parameters": hidden.parameters,
                    "size_lambda": hidden.size_lambda,
                    "shows_in": hidden.shows_in,
                    "region": None if hidden.region is None else dataclasses.asdict(hidden.region),
                }
                for hidden in self.hidden
            ],
            "alias": None if self.alias is None else {"name": self.alias.effect.name, "cosine": self.alias.cosine},
        }
        return json.dumps(content, indent=1, allow_nan=False) + "\n"
