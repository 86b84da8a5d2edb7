"""Parse and check the configuration of a driver for stock environments."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ms_highway.control.road import RoadDriver
from ms_highway.envs.checks import LARGEST, is_number, refuse_unknown
from ms_highway.metareasoning.road import BudgetedRungs, FixedRung, PricedRungs, RoadCosts
from ms_highway.planning.road.settings import RUNGS, RoadPlanning
from ms_highway.vehicle.road_robot import MARGIN

__all__ = ["RoadSettings"]

DRIVERS = "'switching', 'switching:PRICE', 'budget:MS', 'proposals', " + ", ".join(f"'fixed:{rung}'" for rung in RUNGS)


@dataclass(frozen=True)
class RoadSettings:
    """How a robot drives a stock environment. Impossible values raise a ValueError.

    Attributes:
        driver: ``"switching"``, a rung for each car by price or budget; ``"switching:PRICE"`` and ``"budget:MS"``, the
            same with the number; ``"fixed:RUNG"``, the same rung for all cars; ``"proposals"``, the best proposal,
            without refinement.
        price: reward that a second of computation costs.
        budget: milliseconds of computation per plan, instead of a price; None for no budget.
        costs: milliseconds that each rung adds to a plan per car, by name, 0 where left out; None to measure
            them. With given ones and a price, episodes can be repeated exactly; a budget counts the time of decisions.
        ladder: rungs to choose from, of `ms_highway.planning.road.settings.RUNGS` in their order.
        desired_speed: [m/s]; None for what the scene rewards.
        acceleration: total acceleration at most [m/s^2].
        curvature: of the path at most [1/m].
        traits: whether the desired speed and time headway of each driver are estimated while driving, and used.
        belief: whether the robot infers which model each driver follows, and counts on a yield only of those who have
            shown one: for others, tom falls back to idm.
    """

    driver: str = "switching"
    price: float = 1.0
    budget: float | None = None
    costs: Mapping[str, float] | None = None
    ladder: tuple[str, ...] = RUNGS
    desired_speed: float | None = None
    acceleration: float = 5.0
    curvature: float = 0.2
    traits: bool = False
    belief: bool = False

    def __post_init__(self) -> None:
        for name in ("price", "budget", "desired_speed", "acceleration", "curvature"):
            value = getattr(self, name)
            if value is None and name in ("budget", "desired_speed"):
                continue
            if not is_number(value) or value < 0 or (value == 0 and name != "price"):
                least = "from 0" if name == "price" else "above 0"
                raise ValueError(f"config[{name!r}] is {value!r}; it must be a number {least} to {LARGEST:.2g}")
        for name in ("traits", "belief"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"config[{name!r}] is {getattr(self, name)!r}; it must be True or False")
        if self.costs is not None:
            if not isinstance(self.costs, Mapping):
                raise ValueError(
                    f"config['costs'] is {self.costs!r}; give milliseconds by rung, such as {{'tom': 0.5}}"
                )
            refuse_unknown("config['costs']", self.costs, RUNGS)
            for rung, cost in self.costs.items():
                if not is_number(cost) or cost < 0:
                    raise ValueError(f"config['costs'][{rung!r}] is {cost!r}; it must be milliseconds, a number from 0")
        names = self.ladder
        ordered = isinstance(names, (list, tuple)) and list(names) == [rung for rung in RUNGS if rung in names]
        if not ordered or RUNGS[0] not in names:
            remedy = f"give rungs of {', '.join(RUNGS)} in this order, {RUNGS[0]} among them"
            raise ValueError(f"config['ladder'] is {names!r}; {remedy}")
        object.__setattr__(self, "ladder", tuple(names))
        self.choice()

    @classmethod
    def read(cls, config: Mapping[str, Any] | None) -> "RoadSettings":
        """Read a configuration, by default the default one.

        Raises:
            ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
        """
        config = {} if config is None else config
        if not isinstance(config, Mapping):
            raise ValueError(f"the configuration is {config!r}; it must be a dictionary")
        refuse_unknown("config", config, [field.name for field in fields(cls)])
        return cls(**config)

    def choice(self) -> FixedRung | PricedRungs | BudgetedRungs:
        """Return what chooses the rungs.

        Raises:
            ValueError: for an unknown driver.
        """
        text = self.driver if isinstance(self.driver, str) else ""
        kind, _, rest = text.partition(":")
        if kind == "switching" and not rest and self.budget is not None:
            return BudgetedRungs(float(self.budget), self.ladder)
        if self.budget is not None:
            raise ValueError(f"config['budget'] is {self.budget!r}, but config['driver'] is {text!r}; say 'switching'")
        if kind == "switching":
            price = _number(text, rest, "its price, such as switching:0.1") if rest else float(self.price)
            return PricedRungs(price, self.ladder)
        if kind == "budget":
            return BudgetedRungs(_number(text, rest, "its milliseconds, such as budget:5"), self.ladder)
        if kind == "fixed" and rest in self.ladder:
            return FixedRung(rest)
        if text == "proposals":
            return FixedRung("idm")
        if kind == "fixed" and rest in RUNGS:
            raise ValueError(
                f"config['driver'] is {text!r}, but config['ladder'] is {self.ladder!r}; add {rest!r} to it"
            )
        raise ValueError(f"config['driver'] is {self.driver!r}; choose one of {DRIVERS}")

    def planning(self, desired_speed: float) -> RoadPlanning:
        """Return limits and wishes of plans.

        Args:
            desired_speed: that the scene rewards, where no other is configured [m/s].
        """
        return RoadPlanning(
            desired_speed=float(self.desired_speed or desired_speed),
            grip=MARGIN * float(self.acceleration),
            curvature=float(self.curvature),
        )

    def build(self, planning: RoadPlanning) -> RoadDriver:
        """Return a driver with these limits and wishes."""
        costs = None
        if self.costs is not None:
            costs = RoadCosts(0.0, np.array([self.costs.get(rung, 0.0) / 1e3 for rung in RUNGS]))
        refines = self.driver != "proposals"
        return RoadDriver(planning, self.choice(), refines, costs=costs, traits=self.traits, belief=self.belief)


def _number(text: str, part: str, wanted: str) -> float:
    try:
        number = float(part)
    except ValueError:
        number = -1.0
    if not (is_number(number) and number >= 0):
        raise ValueError(f"config['driver'] is {text!r}; it needs {wanted}, as a number from 0")
    return number
