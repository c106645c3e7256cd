"""The truth of a case, separate from its recording and used for scoring only."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass

from probewise.proof.sensors.in_vocabulary import INSIDE, NO_PHYSICS
from probewise.proof.sensors.out_of_vocabulary import OUTSIDE
from probewise.proof.sensors.regions import CovariateRegion
from probewise.proof.sensors.sensors import NOISE_NAMES
from probewise.proof.sensors.strata import Stratum
from probewise.world.concealed import Concealed


@dataclass(frozen=True)
class HiddenEffect:
    """One concealed effect.

    Parameters
    ----------
    effect
        The effect with its parameters.
    size_lambda
        Norm of its change after a refit of the null model, in noise sds.
    region
        Region where it acts; None: not a local effect.
    """

    effect: Concealed
    size_lambda: float
    region: CovariateRegion | None = None

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name

    @property
    def in_vocabulary(self) -> bool:
        """Whether the effect is in the vocabulary of a diagnosis."""
        return self.name in INSIDE

    @property
    def residual_covariates(self) -> tuple[str, ...]:
        """Names of the covariates along which the effect's residual is visible."""
        return (INSIDE.get(self.name) or OUTSIDE[self.name]).residual_covariates

    @property
    def parameters(self) -> dict[str, object]:
        """Parameters of the effect, name to value."""
        return dict(vars(self.effect))


@dataclass(frozen=True)
class AliasedEffect:
    """An effect aliased with the concealed one, not itself in the recording, and their cosine after the refit."""

    effect: Concealed
    cosine: float


@dataclass(frozen=True)
class Truth:
    """The truth of a case.

    Parameters
    ----------
    seed, number
        Seed and number of the case.
    stratum
        Stratum of the case.
    ssf, noise_level, noise_model, plan
        Names in SSFS, NOISE_LEVELS, NOISE_MODELS and PLANS.
    noise_sd, black, white
        Noise sd and levels of the sensor, in reading units.
    hidden
        Concealed effects, in the order of the vocabulary.
    cosine
        Cosine of a pair after the refit; None: no pair.
    alias
        The alias of the concealed effect, in the stratum of aliases; otherwise None.
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
    hidden: tuple[HiddenEffect, ...] = ()
    cosine: float | None = None
    alias: AliasedEffect | None = None

    @property
    def combination(self) -> tuple[str, ...]:
        """Names that a perfect diagnosis gives, sorted; ("unknown",) if any effect is outside the vocabulary.

        A noise model that the vocabulary has is among them, "ssf_order" is not; () if none is left.
        """
        if any(not hidden.in_vocabulary for hidden in self.hidden):
            return ("unknown",)
        names = {hidden.name for hidden in self.hidden} - NO_PHYSICS
        if self.noise_model in NOISE_NAMES:
            names.add(NOISE_NAMES[self.noise_model])
        return tuple(sorted(names))

    def to_json(self) -> str:
        """Return the truth as a string of strict JSON, "format": "truth/1"."""
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
                    "shows_in": hidden.residual_covariates,
                    "region": None if hidden.region is None else dataclasses.asdict(hidden.region),
                }
                for hidden in self.hidden
            ],
            "alias": None if self.alias is None else {"name": self.alias.effect.name, "cosine": self.alias.cosine},
        }
        return json.dumps(content, indent=1, allow_nan=False) + "\n"
