"""Parse and check the configurations and short names of controllers for several humans."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from math import nan
from os import PathLike
from typing import Any, ClassVar

import numpy as np

from ms_highway.envs.checks import is_number, is_one_of, is_whole
from ms_highway.envs.controllers import (
    PLACE,
    BeliefSettings,
    ControllerSettings,
    RandomSettings,
    check_price,
    read_fields,
)
from ms_highway.envs.short_names import named_controller, number_of, shares_of, with_belief
from ms_highway.metareasoning.crowd.baselines import AllOfOne, Influence, Nearest, RandomRungs, TimeToCollision
from ms_highway.metareasoning.crowd.budget import Budget
from ms_highway.metareasoning.crowd.rule import CrowdRule
from ms_highway.metareasoning.crowd.switching import OneStepGains, crowd_switching
from ms_highway.metareasoning.crowd.values import CrowdValues, load_crowd_values
from ms_highway.metareasoning.values import SHIPPED_VALUES
from ms_highway.planning.compiled_crowd import CrowdCosts
from ms_highway.planning.crowd import RUNGS

__all__ = ["CrowdSettings", "any_controller", "crowd_controller_config", "crowd_settings"]


class CrowdSettings(BeliefSettings, ABC):
    """What the configuration of a controller for several humans says. Impossible values raise a ValueError.

    Attributes:
        budget: time of a cycle [s]; None without one.
        quantile: by which its costs should be measured, see `ms_highway.planning.compiled_crowd.measure_crowd_costs`.
    """

    type: ClassVar[str]
    quantile: ClassVar[float] = 0.5
    price: float = nan  # lambda, where a rule chooses at one

    @property
    def budget(self) -> float | None:
        """Time of a cycle [s]; None without one."""
        return None

    @abstractmethod
    def rule(self, costs: CrowdCosts) -> CrowdRule:
        """Return the rule for these planning times."""


@dataclass(frozen=True)
class FixedSettings(CrowdSettings):
    """Predicts every human with the same model."""

    model: str
    type: ClassVar[str] = "fixed"

    def __post_init__(self) -> None:
        if self.model is None or not is_one_of(self.model, RUNGS):
            raise ValueError(f"{PLACE}['model'] is {self.model!r}; the models of several humans are {', '.join(RUNGS)}")

    def rule(self, costs: CrowdCosts) -> CrowdRule:
        """See `CrowdSettings.rule`."""
        return AllOfOne(np.asarray(RUNGS.index(self.model)))


@dataclass(frozen=True)
class RandomCrowdSettings(CrowdSettings):
    """Draws the model of every human in every step, with the given shares by name."""

    shares: Mapping[str, float]
    type: ClassVar[str] = "random"

    def __post_init__(self) -> None:
        RandomSettings(self.shares)
        for name in self.shares:
            if name not in RUNGS:
                raise ValueError(
                    f"{PLACE}['shares'] names {name!r}; the models of several humans are {', '.join(RUNGS)}"
                )

    def rule(self, costs: CrowdCosts) -> CrowdRule:
        """See `CrowdSettings.rule`."""
        return RandomRungs(np.array([self.shares.get(name, 0.0) for name in RUNGS]))


@dataclass(frozen=True)
class _CountSettings(CrowdSettings):
    """Predicts the ``count`` most important humans by theory of mind, and all others naively."""

    count: int
    ranking: ClassVar[type[Any]]

    def __post_init__(self) -> None:
        if not is_whole(self.count) or self.count < 0:
            raise ValueError(f"{PLACE}['count'] is {self.count!r}; it must be a number of humans, 0 or more")

    def rule(self, costs: CrowdCosts) -> CrowdRule:
        """See `CrowdSettings.rule`."""
        return self.ranking(np.asarray(self.count))


class NearestSettings(_CountSettings):
    """The nearest humans are the most important ones."""

    type, ranking = "nearest", Nearest


class TimeToCollisionSettings(_CountSettings):
    """Those with the shortest time to collision are the most important ones."""

    type, ranking = "ttc", TimeToCollision


class InfluenceSettings(_CountSettings):
    """Those that influence the robot's plan most are the most important ones."""

    type, ranking = "influence", Influence


@dataclass(frozen=True)
class SwitchingCrowdSettings(CrowdSettings):
    """Algorithm 1 chooses for each human alone, at a price per second of planning."""

    price: float
    type: ClassVar[str] = "switching"

    def __post_init__(self) -> None:
        check_price(PLACE, self.price)

    def rule(self, costs: CrowdCosts) -> CrowdRule:
        """See `CrowdSettings.rule`."""
        return crowd_switching(costs, self.price)


@dataclass(frozen=True)
class LearnedCrowdSettings(CrowdSettings):
    """A learned value of computation chooses for each human, at a price per second of planning.

    Attributes:
        values: ``"shipped"`` or a file of `ms_highway.metareasoning.crowd.values`; ``""`` and None mean shipped.
    """

    price: float
    values: str | PathLike[str] | None = None
    type: ClassVar[str] = "learned"

    def __post_init__(self) -> None:
        check_price(PLACE, self.price)
        _loaded(self.values or SHIPPED_VALUES)

    def rule(self, costs: CrowdCosts) -> CrowdRule:
        """See `CrowdSettings.rule`."""
        return _loaded(self.values or SHIPPED_VALUES).rule(costs, self.price)


def _loaded(values: Any) -> CrowdValues:
    """Return learned values.

    Raises:
        ValueError: if there are none.
    """
    if not isinstance(values, (str, PathLike)):
        raise ValueError(f"{PLACE}['values'] is {values!r}; say 'shipped' or name a file of learned values")
    return load_crowd_values(values)


ONE_STEP = "one_step"
"""Name of the gains of budgets that are not learned but estimated by Algorithm 1."""


@dataclass(frozen=True)
class BudgetSettings(CrowdSettings):
    """Gains most within the time of a cycle.

    Attributes:
        milliseconds: of a cycle, decision and plan.
        values: that tell the gains: `ONE_STEP` or what `LearnedCrowdSettings` takes; None means shipped.
    """

    milliseconds: float
    values: str | PathLike[str] | None = None
    type: ClassVar[str] = "budget"
    quantile: ClassVar[float] = 0.99

    def __post_init__(self) -> None:
        if not is_number(self.milliseconds) or self.milliseconds <= 0:
            raise ValueError(
                f"{PLACE}['milliseconds'] is {self.milliseconds!r}; a cycle takes more than 0 milliseconds"
            )

        if self._is_learned:
            _loaded(self.values or SHIPPED_VALUES)

    @property
    def _is_learned(self) -> bool:
        return self.values != ONE_STEP

    @property
    def budget(self) -> float:
        """Time of a cycle [s]."""
        return self.milliseconds * 1e-3

    def rule(self, costs: CrowdCosts) -> CrowdRule:
        """See `CrowdSettings.rule`."""
        one_step = OneStepGains(crowd_switching(costs, 0.0).switching)
        gains: CrowdRule = _loaded(self.values or SHIPPED_VALUES).rule(costs, 0.0) if self._is_learned else one_step
        return Budget(gains, costs, self.budget)


CLASSES = (
    SwitchingCrowdSettings,
    LearnedCrowdSettings,
    BudgetSettings,
    FixedSettings,
    RandomCrowdSettings,
    NearestSettings,
    TimeToCollisionSettings,
    InfluenceSettings,
)
KINDS: dict[str, type[Any]] = {kind.type: kind for kind in CLASSES}
COUNTS = tuple(name for name, kind in KINDS.items() if issubclass(kind, _CountSettings))
NUMBERS = {
    "switching": ("lambda", "its lambda as a number, such as switching:0.1"),
    "learned": ("lambda", "its lambda as a number, such as learned:0.1"),
    "budget": ("milliseconds", "the milliseconds of a cycle as a number, such as budget:20"),
}


def crowd_settings(config: Any) -> CrowdSettings:
    """Return the settings of the configuration of a controller for several humans.

    Raises:
        ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
    """
    if not isinstance(config, Mapping) or config.get("type") is None or not is_one_of(config["type"], KINDS):
        raise ValueError(f"{PLACE} is {config!r}; its 'type' must be one of {', '.join(KINDS)}")
    kind = KINDS[config["type"]]
    return read_fields(kind, config)


@with_belief
def crowd_controller_config(text: str) -> dict[str, Any]:
    """Return the configuration that the short name of a controller for several humans stands for.

    These are ``naive``, ``turn`` and ``tom``, the same model for all humans; ``switching:0.1``,
    ``learned:0.1`` and ``learned:0.1:FILE`` with a lambda; ``budget:20``, with the milliseconds of a cycle and learned
    gains, ``budget:20:FILE`` with those of a file, and ``budget:20:one_step`` with Algorithm 1's; ``nearest:2``,
    ``ttc:2`` and ``influence:2``, theory of mind about the two nearest humans, those with the shortest time to
    collision, or those that influence the plan most; and ``random:naive=0.7,tom=0.3``, for every human and step a model
    that is drawn with these shares. With ``+belief`` at the end, such as ``tom+belief``, any of them counts on no
    response that a human does not show.

    Raises:
        ValueError: if it stands for none.
    """
    name, _, rest = text.partition(":")
    config: dict[str, Any]
    if name in RUNGS and name == text:
        config = {"type": "fixed", "model": name}
    elif name in NUMBERS:
        key, wanted = NUMBERS[name]
        number, _, values = rest.partition(":")
        config = {"type": name, key: number_of(text, number, wanted)} | ({"values": values} if values else {})
    elif name in COUNTS:
        if not rest.isdecimal():
            raise ValueError(f"controller {text!r} needs its number of humans, such as {name}:2")
        config = {"type": name, "count": int(rest)}
    elif name == "random":
        config = {"type": "random", "shares": shares_of(text, rest)}
    else:
        numbers = "switching:LAMBDA, learned:LAMBDA[:FILE], budget:MILLISECONDS[:FILE]"
        counts = ", ".join(f"{kind}:HUMANS" for kind in COUNTS)
        known = f"{', '.join(RUNGS)}, {numbers}, {counts} and random:MODEL=SHARE,..."
        raise ValueError(f"unknown controller {text!r}; the controllers of several humans are {known}")
    try:
        crowd_settings(config)
    except ValueError as error:
        raise ValueError(f"controller {text!r}: {error}") from None
    return config


def any_controller(text: str) -> ControllerSettings | CrowdSettings:
    """Return the settings that a controller's short name stands for, with one human or else with several.

    A name that both know is of the same type, at the same lambda.

    Raises:
        ValueError: if it stands for none.
    """
    try:
        return named_controller(text)
    except ValueError as error:
        try:
            return crowd_settings(crowd_controller_config(text))
        except ValueError:
            raise error from None
