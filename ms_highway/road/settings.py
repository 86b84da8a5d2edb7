"""Read the configuration of a driver for stock environments, with its rule.

The rule chooses a model for each car. Proposals are first scored with all cars under
the first model of the ladder. How much more the best of them would earn without car i
is an upper bound on the gain of any better prediction of this car: ``max_p (R(p) +
c_i(p)) - max_p R(p)``, where proposal p earns R(p), and c_i(p) is the cost of car i in
it. These bounds are the evidence of rules here.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

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
    """Say what better predictions could gain at most.

    The evidence is a bound for each car.
    """

    def estimate(self, memory: Memory, evidence: PerHuman) -> Estimate:
        """Return the bound of each car for all models but the first.

        The first gains nothing over itself.
        """
        above_first = jnp.arange(memory.last_check.shape[1]) > 0
        gains = jnp.where(above_first, jnp.asarray(evidence)[:, None], 0.0)
        return Estimate(gains, jnp.bool(False))


DRIVER_VALUES = (
    "priced",
    "priced:PRICE",
    "budget:MS",
    *(f"fixed:{rung}" for rung in TRAFFIC_MODELS),
)
"""Values of ``config["driver"]``."""

OptionalPositive = Annotated[
    Positive | None, Meta(description="it must be a positive number, or None")
]
LADDER_REMEDY = (
    f"give rungs of {', '.join(TRAFFIC_MODELS)} in this order, beginning with"
    f" {TRAFFIC_MODELS[0]}"
)


class DriverChoice(NamedTuple):
    """What ``config["driver"]`` says, with price and budget.

    Attributes:
        kind: ``priced``, ``budget``, ``fixed`` or ``added``.
        name: of the model of ``fixed``, or of the added driver.
        number: the price [reward/s] or the budget [ms].
    """

    kind: str
    name: str = ""
    number: float = 0.0


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
        str, Meta(description=f"choose one of {', '.join(map(repr, DRIVER_VALUES))}")
    ] = "priced"
    price: NotNegative = 1.0
    budget: OptionalPositive = None
    costs: Annotated[
        Literal["shipped"] | dict[str, NotNegative],
        Meta(
            description="say 'shipped', or give milliseconds of at least 0 by rung,"
            " such as {'tom': 0.5}"
        ),
    ] = "shipped"
    ladder: Annotated[tuple[str, ...], Meta(description=LADDER_REMEDY)] = TRAFFIC_MODELS
    desired_speed: OptionalPositive = None
    acceleration: Positive = 5.0
    curvature: Positive = 0.2
    intentions: bool = False

    @classmethod
    def read(cls, config: Mapping[str, object] | None) -> "RoadSettings":
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
        in_order = tuple(rung for rung in TRAFFIC_MODELS if rung in self.ladder)
        if TRAFFIC_MODELS[0] not in self.ladder or self.ladder != in_order:
            raise ValueError(f"config['ladder'] is {self.ladder!r}; {LADDER_REMEDY}")
        self._choice()

    def _choice(self) -> DriverChoice:
        """Return what the driver is.

        Raises:
            ValueError: for an unknown driver or an impossible value.
        """
        message = f"config['driver'] is {self.driver!r}"
        if self.driver == "priced":
            if self.budget is None:
                return DriverChoice("priced", number=self.price)
            return DriverChoice("budget", number=self.budget)
        if self.budget is not None:
            raise ValueError(
                f"config['budget'] is {self.budget!r}, but {message}; say 'priced'"
            )
        if self.driver in added_drivers():
            return DriverChoice("added", self.driver)

        # The rest is "KIND:VALUE".
        kind, _, value = self.driver.partition(":")
        try:
            if kind in ("priced", "budget"):
                number = convert(value, NotNegative, strict=False)
                return DriverChoice(kind, number=number)
            if kind == "fixed":
                return DriverChoice(kind, convert(value, Literal[self.ladder]))
        except ValidationError:
            pass
        known = (
            f"{', '.join([*DRIVER_VALUES, *added_drivers()])} or a name of"
            " ms_highway.add_driver"
        )
        raise ValueError(
            f"{message}; choose one of {known}, with numbers from 0 and rungs of"
            f" config['ladder'], which is {self.ladder}"
        )

    def rule(self, costs: Costs) -> Rule[PerHuman]:
        """Return the rule that chooses the models.

        It leaves out models that cost at least as much as a later model on the ladder.
        Of those left, a budget chooses between the first and the last.

        Args:
            costs: of each of `ms_highway.road.traffic_models.TRAFFIC_MODELS`.
        """
        choice = self._choice()
        if choice.kind == "fixed":
            return always(human_model(choice.name))

        # Models that cost less than all later ones.
        seconds = costs.select(self.ladder).each
        names = []
        for place, name in enumerate(self.ladder):
            if seconds[place] < min(seconds[place + 1 :], default=np.inf):
                names.append(name)

        if choice.kind != "budget":
            ladder = tuple(map(human_model, names))
            chooser = PriceFromFirst(choice.number)
            return Rule(ladder, costs.select(names), chooser, Bounds())

        # The bounds are gains of the last model; those between are not estimated.
        names = list(dict.fromkeys([names[0], names[-1]]))
        ladder = tuple(map(human_model, names))
        costs = costs.select(names)
        return Rule(ladder, costs, Knapsack(choice.number, share=1.0), Bounds())

    def planning(self, desired_speed: float, frame: float) -> RoadPlanning:
        """Return the limits and the desired speed of plans.

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
        self,
        planning: RoadPlanning,
        random: np.random.Generator | None = None,
    ) -> RoadDriver | AddedRoadDriver:
        """Return a driver with these limits and desired speed.

        Args:
            planning: limits, and the desired speed.
            random: source of the key of a driver that remembers, see
                `ms_highway.add_driver`.
        """
        choice = self._choice()
        if choice.kind == "added":
            driver = HUMAN_DRIVERS[choice.name]
            key = draw_key(driver, random or np.random.default_rng(0))
            return AddedRoadDriver(planning, choice.name, key)
        costs = MEASURED_COSTS
        if isinstance(self.costs, dict):
            seconds = np.array(
                [self.costs.get(model, 0.0) / 1e3 for model in TRAFFIC_MODELS]
            )
            costs = Costs(0.0, seconds, TRAFFIC_MODELS)
        budget = choice.number / 1e3 if choice.kind == "budget" else np.inf
        return RoadDriver(planning, self.rule(costs), budget=budget)
