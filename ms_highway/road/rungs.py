"""Choose a model for each car of the traffic on a road: what its answer could be worth, against the time of the model.

Proposals are judged with what costs nothing to predict first. What the best of them would gain if it were not for a car
bounds what any better prediction of this car can be worth: ``max_p (R(p) + c_i(p)) - max_p R(p)``, with R what a
proposal earns and c_i the part of it that car i costs. Where nothing is to be gained, nothing more is spent.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ms_highway.planning.compiled_plans import Costs
from ms_highway.road.constants import MODELS
from ms_highway.runtime.arrays import PerHuman, Rungs


class RungChoice(Protocol):
    """Choose rungs.

    Attributes:
        looks: whether gains have to be known.
    """

    looks: bool

    @property
    def milliseconds(self) -> float:
        """Duration of a decision and a plan at most [ms]."""

    def choose(self, gains: PerHuman, costs: Costs, spent: float) -> Rungs:
        """Return the rung of each car; asked without gains first, for the proposals that gains are computed from.

        Args:
            gains: bounds on what its answer is worth [reward].
            costs: of plans.
            spent: seconds of this step that are gone, proposals left out, which belong to the plan.
        """


@dataclass(frozen=True)
class FixedRung:
    """Predict everybody by the same model.

    Attributes:
        name: of the model.
    """

    name: str
    looks = False
    milliseconds = np.inf

    def choose(self, gains: PerHuman, costs: Costs, spent: float) -> Rungs:
        """See `RungChoice`."""
        return np.full(len(gains), MODELS.index(self.name), np.int32)


@dataclass(frozen=True)
class PricedRungs:
    """Predict a car by the most expensive model whose time its answer may be worth.

    A model that costs nothing is always worth it.

    Attributes:
        price: lambda [reward per second].
        ladder: models in use, cheapest first.
    """

    price: float
    ladder: tuple[str, ...] = MODELS
    looks = True
    milliseconds = np.inf

    def choose(self, gains: PerHuman, costs: Costs, spent: float) -> Rungs:
        """See `RungChoice`."""
        first, *more = map(MODELS.index, self.ladder)
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
    ladder: tuple[str, ...] = MODELS
    looks = True

    def choose(self, gains: PerHuman, costs: Costs, spent: float) -> Rungs:
        """See `RungChoice`."""
        left = self.milliseconds / 1e3 - spent - costs.base
        ladder = [MODELS.index(name) for name in self.ladder]
        free = max(rung for rung in ladder if costs.each[rung] == 0 or rung == ladder[0])
        rungs = np.full(len(gains), free, np.int32)
        for car in np.argsort(-gains, kind="stable"):
            affordable = [rung for rung in ladder if costs.each[rung] <= left]
            if gains[car] > 0 and affordable:
                rungs[car] = max(free, affordable[-1])
                left -= costs.each[rungs[car]]
        return rungs
