"""Choose a model for each car of the traffic on a road: what its answer could be worth, against the time of the model.

Proposals are judged with everybody keeping its velocity first, which is cheap. What the best of them would gain if it
were not for a car bounds what any better prediction of this car can be worth: ``max_p (R(p) + c_i(p)) - max_p R(p)``,
with R what a proposal earns and c_i the part of it that car i costs. Where nothing is to be gained, nothing is spent.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, Int

from ms_highway.planning.road.settings import RUNGS

__all__ = ["BudgetedRungs", "FixedRung", "PricedRungs", "RoadCosts", "RungChoice"]


class RoadCosts(NamedTuple):
    """Seconds of a plan: ``base + sum each[rung]`` over the cars."""

    base: float
    each: Float[np.ndarray, "rungs"]


class RungChoice(Protocol):
    """Choose rungs.

    Attributes:
        looks: whether gains have to be known.
    """

    looks: bool

    def choose(self, gains: Float[np.ndarray, "traffic"], costs: RoadCosts, spent: float) -> Int[np.ndarray, "traffic"]:
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
        if self.name not in RUNGS:
            raise ValueError(f"there is no model {self.name!r} of traffic; the models are {', '.join(RUNGS)}")

    def choose(self, gains: Float[np.ndarray, "traffic"], costs: RoadCosts, spent: float) -> Int[np.ndarray, "traffic"]:
        """See `RungChoice`."""
        return np.full(len(gains), RUNGS.index(self.name), np.int32)


@dataclass(frozen=True)
class PricedRungs:
    """Predict a car by the dearest model if its answer may be worth the time of it, else by the cheaper ones.

    A model that costs nothing is always worth it.

    Attributes:
        price: lambda [reward per second].
        ladder: models in use, cheapest first.
    """

    price: float
    ladder: tuple[str, ...] = RUNGS
    looks = True

    def choose(self, gains: Float[np.ndarray, "traffic"], costs: RoadCosts, spent: float) -> Int[np.ndarray, "traffic"]:
        """See `RungChoice`."""
        rungs = np.full(len(gains), RUNGS.index(self.ladder[0]), np.int32)
        for rung in (RUNGS.index(name) for name in self.ladder[1:]):
            rungs[gains >= self.price * costs.each[rung]] = rung
        return rungs


@dataclass(frozen=True)
class BudgetedRungs:
    """Predict those by the dearest model whose answers may be worth most, as many as there is time for.

    Attributes:
        milliseconds: of a decision and a plan.
        ladder: models in use, cheapest first.
    """

    milliseconds: float
    ladder: tuple[str, ...] = RUNGS
    looks = True

    def choose(self, gains: Float[np.ndarray, "traffic"], costs: RoadCosts, spent: float) -> Int[np.ndarray, "traffic"]:
        """See `RungChoice`."""
        left = self.milliseconds / 1e3 - spent - costs.base
        ladder = [RUNGS.index(name) for name in self.ladder]
        free = max([ladder[0], *(rung for rung in ladder if costs.each[rung] == 0)])
        rungs = np.full(len(gains), free, np.int32)
        for car in np.argsort(-gains, kind="stable"):
            affordable = [rung for rung in ladder if costs.each[rung] <= left]
            if gains[car] > 0 and affordable:
                rungs[car] = max(rungs[car], affordable[-1])
                left -= costs.each[rungs[car]]
        return rungs
