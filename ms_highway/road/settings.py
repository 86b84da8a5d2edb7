"""Read the configuration of a driver for stock environments, with its rule, which
chooses a model for each car.

Proposals are first scored with all cars under the first model of the ladder. How much
more the best of them would earn without car i is an upper bound on the gain of any
better prediction of this car: ``max_p (R(p) + c_i(p)) - max_p R(p)``, where proposal p
earns R(p), and c_i(p) is the cost of car i in it. These bounds are the evidence of
rules here.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import jax
import numpy as np
from jax import numpy as jnp
from msgspec import Meta, Struct, ValidationError, convert

from ms_highway.choice.budget import Knapsack
from ms_highway.choice.choosers import PriceFromFirst
from ms_highway.choice.rule import Estimate, Estimator, Memory, Rule, always
from ms_highway.envs.configuration import read, refuse_unknown
from ms_highway.loop.controller import HUMAN_DRIVERS, draw_key
from ms_highway.planning.costs import Costs
from ms_highway.planning.ladders import human_model
from ms_highway.road.added import AddedRoadDriver, added_drivers
from ms_highway.road.driver import MEASURED_COSTS, RoadDriver
from ms_highway.road.road_planning import RoadPlanning
from ms_highway.road.robot import RoadRobot
from ms_highway.road.traffic_models import TRAFFIC_MODELS
from ms_highway.runtime.arrays import PerHuman
from ms_highway.runtime.limits import NotNegative, Positive


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bounds(Estimator[PerHuman]):
    """Say what better predictions could gain at most; the evidence is a bound for each
    car.
    """

    def estimate(self, memory: Memory, evidence: PerHuman) -> Estimate:
        """Return the bound of each car for all models but the first, which gains
        nothing over itself.
        """
        above_first = jnp.arange(memory.last_check.shape[1]) > 0
        gains = jnp.where(above_first, jnp.asarray(evidence)[:, None], 0.0)
        return Estimate(gains, jnp.bool(False))


DRIVERS = (
    "priced",
    "priced:PRICE",
    "budget:MS",
    *(f"fixed:{rung}" for rung in TRAFFIC_MODELS),
)
"""Values of ``config["driver"]``."""

OptionalPositive = Annotated[
    Positive | None, Meta(description="it must be a positive number, or None")
]
COSTS = (
    "say 'shipped', or give milliseconds of at least 0 by rung, such as {'tom': 0.5}"
)
IN_ORDER = f"give rungs of {', '.join(TRAFFIC_MODELS)} in this order, beginning with {TRAFFIC_MODELS[0]}"


class RoadSettings(Struct, frozen=True):
    """How a robot drives a stock environment.

    Attributes:
        driver: ``"priced"`` chooses a rung for each car by ``price``, or by ``budget``
            if there is one; ``"priced:PRICE"`` and ``"budget:MS"`` do the same with the
            number given here; ``"fixed:RUNG"`` takes the same rung for all cars. The
            name of a driver of `ms_highway.add_driver` that is called, see
            `ms_highway.road.added.AddedRoadDriver`; it predicts nobody, and price,
            costs and ladder do not matter.
        price: reward that a second of computation costs.
        budget: milliseconds of computation per plan, instead of a price; None for no
            budget.
        costs: ``"shipped"``, or milliseconds that each rung adds to a plan per car, by
            name, 0 where left out. Episodes at a price can be repeated exactly; a
            budget counts the measured time of decisions.
        ladder: rungs to choose from, in the order of
            `ms_highway.road.traffic_models.TRAFFIC_MODELS`.
        desired_speed: [m/s]; None for the speed that the scene rewards.
        acceleration: largest total acceleration [m/s^2].
        curvature: largest curvature of the path [1/m].
        intentions: whether the robot knows the ``route`` of each of the others that has
            one; highway-env's ``observe_intentions`` shows agents only the direction of
            its end.

    Raises:
        ValueError: for a ladder in another order, unknown rungs, or an impossible
            driver.
    """

    driver: Annotated[
        str, Meta(description=f"choose one of {', '.join(map(repr, DRIVERS))}")
    ] = "priced"
    price: NotNegative = 1.0
    budget: OptionalPositive = None
    costs: Annotated[
        Literal["shipped"] | dict[str, NotNegative], Meta(description=COSTS)
    ] = "shipped"
    ladder: Annotated[tuple[str, ...], Meta(description=IN_ORDER)] = TRAFFIC_MODELS
    desired_speed: OptionalPositive = None
    acceleration: Positive = 5.0
    curvature: Positive = 0.2
    intentions: bool = False

    @classmethod
    def read(cls, config: Mapping[str, Any] | None) -> "RoadSettings":
        """Read a configuration; without one, take the defaults.

        Raises:
            ValueError: for anything unknown or impossible; it names the key, the value
                and the remedy.
        """
        return read(cls, "config", {} if config is None else config)

    def __post_init__(self) -> None:
        refuse_unknown(
            "config['costs']",
            self.costs if isinstance(self.costs, dict) else (),
            TRAFFIC_MODELS,
        )
        if TRAFFIC_MODELS[0] not in self.ladder or self.ladder != tuple(
            rung for rung in TRAFFIC_MODELS if rung in self.ladder
        ):
            raise ValueError(f"config['ladder'] is {self.ladder!r}; {IN_ORDER}")
        self._choice()

    def _choice(self) -> tuple[str, Any]:
        """Return the kind of the driver, and its model, price or milliseconds.

        Raises:
            ValueError: for an unknown driver or an impossible value.
        """
        message = f"config['driver'] is {self.driver!r}"
        if self.driver == "priced":
            return (
                ("priced", self.price)
                if self.budget is None
                else ("budget", self.budget)
            )
        if self.budget is not None:
            raise ValueError(
                f"config['budget'] is {self.budget!r}, but {message}; say 'priced'"
            )
        if self.driver in added_drivers():
            return "added", self.driver
        kind, _, value = self.driver.partition(":")
        values = {
            "priced": NotNegative,
            "budget": NotNegative,
            "fixed": Literal[self.ladder],
        }
        try:
            return kind, convert(value, values[kind], strict=False)
        except (KeyError, ValidationError):
            known = (
                f"{', '.join([*DRIVERS, *added_drivers()])} or a name of"
                " ms_highway.add_driver"
            )
            remedy = (
                f"choose one of {known}, with numbers from 0 and rungs of"
                f" config['ladder'], which is {self.ladder}"
            )
            raise ValueError(f"{message}; {remedy}") from None

    def rule(self, costs: Costs) -> Rule[PerHuman]:
        """Return the rule that chooses the models.

        It leaves out models that cost at least as much as a later model on the ladder.
        Of those left, a budget chooses between the first and the last.

        Args:
            costs: of each of `ms_highway.road.traffic_models.TRAFFIC_MODELS`.
        """
        kind, value = self._choice()
        if kind == "fixed":
            return always(human_model(value))
        # Models that cost less than all later ones.
        seconds = costs.select(self.ladder).each
        kept = [
            name
            for place, name in enumerate(self.ladder)
            if seconds[place] < min(seconds[place + 1 :], default=np.inf)
        ]
        if kind == "budget":
            # The bounds are gains of the last model; those between are not estimated.
            kept = list(dict.fromkeys([kept[0], kept[-1]]))
        ladder = tuple(map(human_model, kept))
        costs = costs.select(kept)
        if kind == "budget":
            return Rule(ladder, costs, Knapsack(value, share=1.0), Bounds())
        return Rule(ladder, costs, PriceFromFirst(value), Bounds())

    def planning(self, desired_speed: float, frame: float) -> RoadPlanning:
        """Return limits and wishes of plans.

        Args:
            desired_speed: the speed that the scene rewards, unless another one is
                configured [m/s].
            frame: duration of the simulation's frames [s].
        """
        return RoadPlanning(
            desired_speed=self.desired_speed or desired_speed,
            grip=RoadRobot.grip_share * self.acceleration,
            curvature=self.curvature,
            frame=frame,
        )

    def build(
        self, planning: RoadPlanning, random: np.random.Generator | None = None
    ) -> RoadDriver | AddedRoadDriver:
        """Return a driver with these limits and wishes.

        Args:
            planning: limits and wishes.
            random: source of the key of a driver that remembers, see
                `ms_highway.add_driver`.
        """
        kind, value = self._choice()
        if kind == "added":
            key = draw_key(HUMAN_DRIVERS[value], random or np.random.default_rng(0))
            return AddedRoadDriver(planning, value, key)
        costs = MEASURED_COSTS
        if isinstance(self.costs, dict):
            seconds = np.array(
                [self.costs.get(model, 0.0) / 1e3 for model in TRAFFIC_MODELS]
            )
            costs = Costs(0.0, seconds, TRAFFIC_MODELS)
        budget = value / 1e3 if kind == "budget" else np.inf
        return RoadDriver(planning, self.rule(costs), budget=budget)
