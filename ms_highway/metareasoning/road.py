"""Choose a model for each car of the traffic on a road: what its answer could be worth, against the time of the model.

Proposals are judged with everybody keeping its velocity first, which is cheap. What the best of them would gain if it
were not for a car bounds what any better prediction of this car can be worth: ``max_p (R(p) + c_i(p)) - max_p R(p)``,
with R what a proposal earns and c_i the part of it that car i costs. Where nothing is to be gained, nothing is spent.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, Int

from ms_highway.planning.road.settings import ROAD_MODELS

Gains = Float[Any, "traffic"]
Rungs = Int[Any, "traffic"]


class RoadCosts(NamedTuple):
    """Seconds of a plan: ``base + sum each[rung]`` over the cars."""

    base: float
    each: Float[Any, "rungs"]


class RungChoice(Protocol):
    """Choose rungs.

    Attributes:
        looks: whether gains have to be known.
    """

    looks: bool

    def choose(self, gains: Gains, costs: RoadCosts, spent: float) -> Rungs:
        """Return the rung of each car.

        Args:
            gains: bounds on what its answer is worth [reward].
            costs: of plans.
            spent: seconds of this step that are gone.
        """


@dataclass(frozen=True)
class FixedRung:
    """Predict everybody by the same model.

    Attributes:
        name: of the model.
    """

    name: str
    looks = False

    def __post_init__(self) -> None:
        if self.name not in ROAD_MODELS:
            raise ValueError(f"there is no model {self.name!r} of traffic; the models are {', '.join(ROAD_MODELS)}")

    def choose(self, gains: Gains, costs: RoadCosts, spent: float) -> Rungs:
        """See `RungChoice`."""
        return np.full(len(gains), ROAD_MODELS.index(self.name), np.int32)


@dataclass(frozen=True)
class PricedRungs:
    """Predict a car by the most expensive model whose time its answer may be worth.

    A model that costs nothing is always worth it.

    Attributes:
        price: lambda [reward per second].
        ladder: models in use, cheapest first.
    """

    price: float
    ladder: tuple[str, ...] = ROAD_MODELS
    looks = True

    def choose(self, gains: Gains, costs: RoadCosts, spent: float) -> Rungs:
        """See `RungChoice`."""
        first, *more = map(ROAD_MODELS.index, self.ladder)
        rungs = np.full(len(gains), first, np.int32)
        for rung in more:
            rungs[gains >= self.price * costs.each[rung]] = rung
        return rungs


@dataclass(frozen=True)
class BudgetedRungs:
    """Predict those by the most expensive model whose answers may be worth most, as many as there is time for.

    Attributes:
        milliseconds: of a decision and a plan.
        ladder: models in use, cheapest first.
    """

    milliseconds: float
    ladder: tuple[str, ...] = ROAD_MODELS
    looks = True

    def choose(self, gains: Gains, costs: RoadCosts, spent: float) -> Rungs:
        """See `RungChoice`."""
        left = self.milliseconds / 1e3 - spent - costs.base
        ladder = [ROAD_MODELS.index(name) for name in self.ladder]
        free = max(rung for rung in ladder if costs.each[rung] == 0 or rung == ladder[0])
        rungs = np.full(len(gains), free, np.int32)
        for car in np.argsort(-gains, kind="stable"):
            affordable = [rung for rung in ladder if costs.each[rung] <= left]
            if gains[car] > 0 and affordable:
                rungs[car] = max(free, affordable[-1])
                left -= costs.each[rungs[car]]
        return rungs
