"""Parse and check the configurations and short names of controllers."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import nan
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ms_highway.envs.checks import LARGEST, is_number, is_one_of, refuse_unknown
from ms_highway.game.scenario import Semantics
from ms_highway.metareasoning.rule import Rule
from ms_highway.metareasoning.switching import RELEASED_TRUST_TOLERANCE, Switching
from ms_highway.metareasoning.values import load_values
from ms_highway.planning.human_models import MODELS, HumanModel

__all__ = [
    "CHOOSING",
    "ChoosingSettings",
    "ControllerSettings",
    "FixedSettings",
    "LearnedSettings",
    "RandomSettings",
    "ScheduledSettings",
    "SwitchingSettings",
    "controller_config",
    "controller_settings",
    "named_controller",
]

PLACE = "config['controller']"
ROUNDING = 1e-6  # how far a sum of shares may be from 1
MOST_DIGITS = 5  # of a number of steps


class ControllerSettings(ABC):
    """What a controller's configuration says. Impossible values raise a ValueError."""

    type: ClassVar[str]
    price: float = nan  # lambda, where Algorithm 1 decides

    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """The names of its human models; empty where Algorithm 1 chooses from the ladder."""

    def draw(self, steps: int, random: np.random.Generator) -> list[str]:
        """Return the name of every step's human model, the last one kept; empty where Algorithm 1 chooses.

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
        if not is_one_of(self.model, MODELS):
            raise ValueError(f"{PLACE}['model'] is {self.model!r}; the human models are {', '.join(MODELS)}")

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
        if not isinstance(names, (list, tuple)) or not names or not all(is_one_of(name, MODELS) for name in names):
            raise ValueError(f"{PLACE}['models'] is {names!r}; give a list of human models, of {', '.join(MODELS)}")

    def names(self) -> tuple[str, ...]:
        """See `ControllerSettings.names`."""
        return tuple(self.models)


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
            if not is_one_of(name, MODELS):
                raise ValueError(f"{place} names {name!r}; the human models are {', '.join(MODELS)}")
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
        if semantics == "released":
            return Switching(costs, self.price, models, trust_tolerance=RELEASED_TRUST_TOLERANCE)
        return Switching(costs, self.price, models)


@dataclass(frozen=True)
class LearnedSettings(ChoosingSettings):
    """A learned value of computation chooses.

    Attributes:
        values: ``"shipped"`` or a file of `ms_highway.metareasoning.values`; ``""`` and None mean shipped.
    """

    values: str | None = None
    type: ClassVar[str] = "learned"

    def __post_init__(self) -> None:
        super().__post_init__()
        load_values(self.values or "shipped")

    def rule(self, models: tuple[HumanModel, ...], costs: Float[np.ndarray, "rungs"], semantics: Semantics) -> Rule:
        """See `ChoosingSettings.rule`."""
        return load_values(self.values or "shipped").rule(models, costs, self.price)


KINDS: dict[str, type[Any]] = {
    kind.type: kind for kind in (SwitchingSettings, LearnedSettings, FixedSettings, ScheduledSettings, RandomSettings)
}

CHOOSING = [name for name, kind in KINDS.items() if issubclass(kind, ChoosingSettings)]
"""Types of the controllers that choose models online, by a rule."""


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
    keys = {field.name: "lambda" if field.name == "price" else field.name for field in fields(kind)}
    refuse_unknown(PLACE, config, {"type", *keys.values()})
    return kind(**{name: config.get(key) for name, key in keys.items()})


def named_controller(text: str) -> ControllerSettings:
    """Return the settings that a controller's short name stands for, see `controller_config`.

    Raises:
        ValueError: if it stands for none.
    """
    return controller_settings(controller_config(text))


def controller_config(text: str) -> dict[str, Any]:
    """Return the configuration that a controller's short name stands for.

    These are the human models, such as ``tom``; ``switching:0.1`` with a lambda; ``schedule:tom=6,naive``, tom for six
    steps and then naive; and ``random:naive=0.7,tom=0.3``, for every step a model that is drawn with these shares.

    Raises:
        ValueError: if it stands for none.
    """
    name, _, rest = text.partition(":")
    config: dict[str, Any]
    if name in CHOOSING:
        price, _, values = rest.partition(":")
        try:
            if price != price.strip():
                raise ValueError  # the name would have spaces or line breaks, in files too
            config = {"type": name, "lambda": float(price)}
        except ValueError:
            raise ValueError(f"controller {text!r} needs its lambda as a number, such as {name}:0.1") from None
        if values:
            config["values"] = values
    elif name == "schedule":
        config = {"type": "schedule", "models": _schedule(text, rest)}
    elif name == "random":
        config = {"type": "random", "shares": _shares(text, rest)}
    elif name in MODELS and not rest:
        config = {"type": "fixed", "model": name}
    else:
        known = f"{', '.join(MODELS)}, switching:LAMBDA, schedule:MODEL=STEPS,...,MODEL and random:MODEL=SHARE,..."
        raise ValueError(f"unknown controller {text!r}; the controllers are {known}")
    try:
        controller_settings(config)
    except ValueError as error:
        raise ValueError(f"controller {text!r}: {error}") from None
    return config


def _schedule(text: str, parts: str) -> list[str]:
    """Return the models of a schedule's short name, one per step; the last one stands once and is kept."""
    *first, last = parts.split(",")
    if "=" in last:
        raise ValueError(f"controller {text!r}: the last model takes no number of steps; write schedule:tom=6,naive")
    models: list[str] = []
    for part in first:
        name, _, steps = part.partition("=")
        if name not in MODELS:
            raise ValueError(f"controller {text!r}: unknown human model {name!r}; the models are {', '.join(MODELS)}")
        if not steps.isdecimal():
            raise ValueError(f"controller {text!r} does not say for how many steps; say it like schedule:tom=6,naive")
        if len(steps) > MOST_DIGITS:
            raise ValueError(f"controller {text!r}: no episode has {steps} steps; leave out what comes later")
        models += [name] * int(steps)
    return [*models, last]


def _shares(text: str, parts: str) -> dict[str, float]:
    """Return the share of each model in a random controller's short name."""
    shares: dict[str, float] = {}
    for part in parts.split(","):
        name, _, share = part.partition("=")
        try:
            number = float(share)
        except ValueError:
            raise ValueError(
                f"controller {text!r} has {part!r} where a share belongs; say it like random:naive=0.7,tom=0.3"
            ) from None
        if name in shares:
            raise ValueError(f"controller {text!r} names {name!r} twice; give it one share")
        shares[name] = number
    return shares
