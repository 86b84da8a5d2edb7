"""Parse and check the configurations of controllers; for their short names see `ms_highway.envs.short_names`."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from itertools import cycle, islice
from math import nan
from os import PathLike
from types import NoneType
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ms_highway.envs.checks import LARGEST, is_number, is_one_of, refuse_unknown
from ms_highway.game.scenario import Semantics
from ms_highway.metareasoning.horizon import WholeHorizon
from ms_highway.metareasoning.quadratic_rule import TRUST_TOLERANCE
from ms_highway.metareasoning.rule import Rule
from ms_highway.metareasoning.switching import RELEASED_TRUST_TOLERANCE, Switching
from ms_highway.metareasoning.values import load_values
from ms_highway.planning.human_models import HumanModel, is_model, model_names

__all__ = [
    "CHOOSING",
    "FIXED_ORDERS",
    "ChoosingSettings",
    "ControllerSettings",
    "FixedSettings",
    "HorizonSettings",
    "LearnedSettings",
    "PeriodSettings",
    "RandomSettings",
    "ScheduledSettings",
    "SwitchingSettings",
    "controller_settings",
]

PLACE = "config['controller']"
ROUNDING = 1e-6  # how far a sum of shares may be from 1


@dataclass(frozen=True)
class BeliefSettings:
    """Whether a controller infers which model predicts each human, see `ms_highway.metareasoning.belief`."""

    belief: bool = field(default=False, kw_only=True)


class ControllerSettings(BeliefSettings, ABC):
    """What a controller's configuration says. Impossible values raise a ValueError."""

    type: ClassVar[str]
    price: float = nan  # lambda, where a rule chooses

    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """The names of its human models; empty where a rule chooses from the ladder."""

    def draw(self, steps: int, random: np.random.Generator) -> list[str]:
        """Return the name of every step's human model, the last one kept; empty where a rule chooses.

        Args:
            steps: how many are drawn, for random controllers.
            random: what they are drawn from; other controllers do not use it.
        """
        return list(self.names())


@dataclass(frozen=True)
class FixedSettings(ControllerSettings):
    """Plans every step with the same human model."""

    model: str
    type: ClassVar[str] = "fixed"

    def __post_init__(self) -> None:
        if not is_model(self.model):
            raise ValueError(f"{PLACE}['model'] is {self.model!r}; the human models are {model_names()}")

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return (self.model,)


@dataclass(frozen=True)
class ScheduledSettings(ControllerSettings):
    """Plans each step with the human model of a list, the last one is kept."""

    models: tuple[str, ...]
    type: ClassVar[str] = "schedule"

    def __post_init__(self) -> None:
        names = self.models
        if not isinstance(names, (list, tuple)) or not names or not all(map(is_model, names)):
            raise ValueError(f"{PLACE}['models'] is {names!r}; give a list of human models, of {model_names()}")

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return tuple(self.models)


@dataclass(frozen=True)
class PeriodSettings(ScheduledSettings):
    """Plans each step with the human model of a list, which is repeated to the end of the episode."""

    type: ClassVar[str] = "period"

    def draw(self, steps: int, random: np.random.Generator) -> list[str]:
        """See `ControllerSettings.draw`."""
        return list(islice(cycle(self.models), steps))


@dataclass(frozen=True)
class RandomSettings(ControllerSettings):
    """Draws the human model of each step, with the given shares by name, when the episode starts."""

    shares: Mapping[str, float]
    type: ClassVar[str] = "random"

    def __post_init__(self) -> None:
        place, shares = f"{PLACE}['shares']", self.shares
        if not isinstance(shares, Mapping) or not shares:
            example = "{'naive': 0.7, 'tom': 0.3}"
            raise ValueError(f"{place} is {shares!r}; give the share of each model, such as {example}")
        for name, share in shares.items():
            if not is_model(name):
                raise ValueError(f"{place} names {name!r}; the human models are {model_names()}")
            if not is_number(share) or share < 0:
                raise ValueError(f"{place}[{name!r}] is {share!r}; a share must be a number from 0 to 1")
        if abs(sum(shares.values()) - 1) > ROUNDING:
            raise ValueError(f"{place} sum to {sum(shares.values()):g}; change one, so that they sum to 1")

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return tuple(name for name, share in self.shares.items() if share > 0)

    def draw(self, steps: int, random: np.random.Generator) -> list[str]:
        """See `ControllerSettings.draw`."""
        shares = np.array([self.shares[name] for name in self.names()], dtype=float)
        return random.choice(self.names(), size=steps, p=shares / shares.sum()).tolist()


@dataclass(frozen=True)
class ChoosingSettings(ControllerSettings):
    """A rule chooses the human model of each step from the ladder, at a price per second of planning."""

    price: float

    def __post_init__(self) -> None:
        check_price(PLACE, self.price)

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return ()

    @abstractmethod
    def rule(self, models: tuple[HumanModel, ...], costs: Float[np.ndarray, "rungs"], semantics: Semantics) -> Rule:
        """Return the rule on a ladder with T(M) [s]."""


@dataclass(frozen=True)
class SwitchingSettings(ChoosingSettings):
    """Algorithm 1 chooses."""

    type: ClassVar[str] = "switching"

    def rule(
        self, models: tuple[HumanModel, ...], costs: Float[np.ndarray, "rungs"], semantics: Semantics
    ) -> Switching:
        """See `ChoosingSettings.rule`."""
        return Switching(costs, self.price, models, trust_tolerance=_tolerance(semantics))


@dataclass(frozen=True)
class HorizonSettings(ChoosingSettings):
    """Algorithm 1 chooses with gains that are estimated over the whole horizon."""

    type: ClassVar[str] = "horizon"

    def rule(
        self, models: tuple[HumanModel, ...], costs: Float[np.ndarray, "rungs"], semantics: Semantics
    ) -> WholeHorizon:
        """See `ChoosingSettings.rule`."""
        return WholeHorizon(costs, self.price, models, trust_tolerance=_tolerance(semantics))


def _tolerance(semantics: Semantics) -> float:
    """Return the tolerance of trust regions."""
    return RELEASED_TRUST_TOLERANCE if semantics == "released" else TRUST_TOLERANCE


@dataclass(frozen=True)
class LearnedSettings(ChoosingSettings):
    """A learned value of computation chooses.

    Attributes:
        values: ``"shipped"`` or a file of `ms_highway.metareasoning.values`; ``""`` and None mean shipped.
    """

    values: str | PathLike[str] | None = None
    type: ClassVar[str] = "learned"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.values, (str, PathLike, NoneType)):
            raise ValueError(f"{PLACE}['values'] is {self.values!r}; say 'shipped' or name a file of learned values")
        load_values(self.values or "shipped")

    def rule(self, models: tuple[HumanModel, ...], costs: Float[np.ndarray, "rungs"], semantics: Semantics) -> Rule:
        """See `ChoosingSettings.rule`."""
        return load_values(self.values or "shipped").rule(models, costs, self.price)


CLASSES = (
    SwitchingSettings,
    HorizonSettings,
    LearnedSettings,
    FixedSettings,
    ScheduledSettings,
    PeriodSettings,
    RandomSettings,
)
KINDS: dict[str, type[Any]] = {kind.type: kind for kind in CLASSES}

CHOOSING = [name for name, kind in KINDS.items() if issubclass(kind, ChoosingSettings)]
"""Types of the controllers that choose models online, by a rule at a lambda."""

FIXED_ORDERS = ("fixed", "schedule", "period")
"""Types of the controllers whose models are the same in every episode, step by step."""


def check_price(place: str, price: Any) -> None:
    """Check a lambda.

    Raises:
        ValueError: naming the place.
    """
    if price is None:
        raise ValueError(f"{place} needs 'lambda', the price of a second of planning")
    if not is_number(price) or price < 0:
        raise ValueError(f"{place}['lambda'] is {price!r}; it must be a number from 0 to {LARGEST:.2g}")


def controller_settings(config: Any) -> ControllerSettings:
    """Return the settings of a controller's configuration.

    Raises:
        ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
    """
    if not isinstance(config, Mapping) or not is_one_of(config.get("type"), KINDS):
        raise ValueError(f"{PLACE} is {config!r}; its 'type' must be one of {', '.join(KINDS)}")
    kind = KINDS[config["type"]]
    if kind is SwitchingSettings and "model" in config:
        raise ValueError(f"{PLACE} has a 'model' but is of type 'switching'; say 'type': 'fixed' to always use a model")
    return read_fields(kind, config)


def read_fields(kind: type[Any], config: Mapping[str, Any]) -> Any:
    """Return the settings of a kind that a configuration gives, those that it does not name None.

    Raises:
        ValueError: for unknown keys and impossible values.
    """
    keys = {each.name: "lambda" if each.name == "price" else each.name for each in fields(kind)}
    refuse_unknown(PLACE, config, {"type", *keys.values()})
    belief = config.get("belief", False)
    if not isinstance(belief, bool):
        raise ValueError(f"{PLACE}['belief'] is {belief!r}; it must be True or False")
    return kind(**{name: config.get(key) for name, key in keys.items()} | {"belief": belief})
