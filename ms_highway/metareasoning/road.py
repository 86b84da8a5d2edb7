"""Choose a model for each car of the traffic on a road: what its answer could be worth, against the time of the model.

Proposals are judged with what costs nothing to predict first. What the best of them would gain if it were not for a car
bounds what any better prediction of this car can be worth: ``max_p (R(p) + c_i(p)) - max_p R(p)``, with R what a
proposal earns and c_i the part of it that car i costs. Where nothing is to be gained, nothing more is spent.
A belief says which model each driver follows.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.road import RoadScene, locate
from ms_highway.metareasoning.belief import first_belief, updated_belief
from ms_highway.planning.car_following import FAR
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import PACKAGE_MODELS
from ms_highway.planning.road.settings import IDM, TOM
from ms_highway.planning.road.traffic import assumed_traits
from ms_highway.planning.road.traits import followed, jointly, observed_step
from ms_highway.runtime.arrays import Belief, PerHuman, Rungs, Scalar


class RungChoice(Protocol):
    """Choose rungs.

    Attributes:
        looks: whether gains have to be known.
    """

    looks: bool

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

    def __post_init__(self) -> None:
        if self.name not in PACKAGE_MODELS:
            raise ValueError(f"there is no model {self.name!r} of traffic; the models are {', '.join(PACKAGE_MODELS)}")

    def choose(self, gains: PerHuman, costs: Costs, spent: float) -> Rungs:
        """See `RungChoice`."""
        return np.full(len(gains), PACKAGE_MODELS.index(self.name), np.int32)


@dataclass(frozen=True)
class PricedRungs:
    """Predict a car by the most expensive model whose time its answer may be worth.

    A model that costs nothing is always worth it.

    Attributes:
        price: lambda [reward per second].
        ladder: models in use, cheapest first.
    """

    price: float
    ladder: tuple[str, ...] = PACKAGE_MODELS
    looks = True

    def choose(self, gains: PerHuman, costs: Costs, spent: float) -> Rungs:
        """See `RungChoice`."""
        first, *more = map(PACKAGE_MODELS.index, self.ladder)
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
    ladder: tuple[str, ...] = PACKAGE_MODELS
    looks = True

    def choose(self, gains: PerHuman, costs: Costs, spent: float) -> Rungs:
        """See `RungChoice`."""
        left = self.milliseconds / 1e3 - spent - costs.base
        ladder = [PACKAGE_MODELS.index(name) for name in self.ladder]
        free = max(rung for rung in ladder if costs.each[rung] == 0 or rung == ladder[0])
        rungs = np.full(len(gains), free, np.int32)
        for car in np.argsort(-gains, kind="stable"):
            affordable = [rung for rung in ladder if costs.each[rung] <= left]
            if gains[car] > 0 and affordable:
                rungs[car] = max(free, affordable[-1])
                left -= costs.each[rungs[car]]
        return rungs


SHOWN = 0.3
"""Probability of theory of mind from which a driver has shown that it makes way; it is 1/4 at first."""

YIELDING = 2.0  # m/s^2, of braking to make way, at most


def updated_road_belief(
    belief: Belief, before: RoadScene, path: Float[Any, "steps 3"], now: RoadScene, time_step: Scalar
) -> Belief:
    """Return the belief about the cars in sight now; about new ones nothing is known, those out of sight are dropped.

    Args:
        belief: about the cars in sight a step before, a row for each path.
        before: the road then.
        path: x, y and heading that the robot planned then.
        now: the road now.
        time_step: between the two [s].
    """
    place, found, observed = observed_step(before, now, time_step)
    predicted = _accelerations(before, path, time_step)[place]
    along = jnp.array([0.0, 1.0])  # accelerations among controls
    mixed = updated_belief(
        jnp.asarray(belief)[place], predicted[..., None] * along, observed[..., None] * along, time_step
    )
    return jnp.where(found[:, None], mixed, first_belief(len(found)))


def counted_rungs(rungs: Rungs, belief: Belief) -> Rungs:
    """Return the rungs, but idm for drivers under theory of mind who have not shown that they make way."""
    return np.where((rungs == TOM) & (belief[:, TOM] < SHOWN), IDM, rungs)


def _accelerations(scene: RoadScene, path: Float[Any, "steps 3"], time_step: Scalar) -> Float[Any, "traffic models"]:
    """Return the acceleration of each car under each model."""
    traits = assumed_traits(scene)
    _, aside, _ = locate(scene.route, *jnp.asarray(path).T)
    idm, turn, tom = (followed(scene, traits, seen) for seen in (None, jnp.full(1, FAR), aside))
    tom = jnp.minimum(idm, jnp.maximum(tom, turn - YIELDING))
    return jnp.stack([jnp.zeros_like(idm), *(jointly(scene, each, time_step) for each in (idm, turn, tom))], axis=-1)
