"""Hold the inputs and results of a simulation of many episodes.

The inputs are what its episodes share, `Loop`, and what differs between them,
`Episodes`; the results are the `Records` of all steps.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import jax
from jaxtyping import Bool, Float, Int

from ms_highway.choice.rule import GameEvidence, Rule, for_unresponsive
from ms_highway.game.game import Game
from ms_highway.loop.controller import DriverFunction
from ms_highway.planning.human_models import HumanModel, Naive
from ms_highway.runtime.arrays import Array, RungIndex
from ms_highway.runtime.compilation import GROUP_SIZES

DECIDES = -1
"""Entry of a schedule: the rule chooses the model of this human in this step; other
entries, from 0, are rungs of `Loop.models`.
"""

HUMAN_PLANS = 0
"""Entry of ``Episodes.drivers`` for a human who plans for its reward. ``HUMAN_PLANS + 1
+ index`` stands for the driver at this index in `Loop.drivers`.
"""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Loop:
    """What all episodes of a simulation share.

    Attributes:
        game: game that is played, with the humans' rewards as the robot believes them.
        rule: chooses rungs of its ladder; every episode has its own price.
        others: models that schedules may use beside the ladder; their rungs follow
            those of the ladder (static).
        way_out: whether an escape that is better than every way out after a control
            replaces it, see `ms_highway.planning.way_out` (static).
        belief: whether the robot infers which model predicts every human, see
            `ms_highway.loop.driver` (static).
        drivers: what drives humans who do not plan, see `ms_highway.add_driver`
            (static).
        chunk: number of episodes computed together with one human (static); with
            several humans, episodes are computed one by one. A chunk computes only the
            human models that it uses: smaller chunks waste less computation, larger
            ones use wide hardware better. The last digits of results depend on it, and
            chaotic episodes (Stay Back) amplify them.
        axis: name of the axis of a chunk, over which JAX maps.
    """

    game: Game
    rule: Rule[GameEvidence]
    others: tuple[HumanModel, ...] = field(default=(), metadata={"static": True})
    way_out: bool = field(default=False, metadata={"static": True})
    belief: bool = field(default=False, metadata={"static": True})
    drivers: tuple[DriverFunction, ...] = field(default=(), metadata={"static": True})
    chunk: int = field(default=GROUP_SIZES.cpu_chunk, metadata={"static": True})
    axis: ClassVar[str] = "episodes"

    @property
    def models(self) -> tuple[HumanModel, ...]:
        """The ladder of schedules and records: that of the rule, then the others."""
        return (*self.rule.ladder, *self.others)

    @property
    def unresponsive(self) -> RungIndex | None:
        """The rung that predicts unresponsive humans; None without a belief.

        Raises:
            ValueError: see `for_unresponsive`; if the order needs naive, and no model
                is it.
        """
        if not self.belief:
            return None
        _, rung = for_unresponsive(replace(self.rule, ladder=self.models))
        if rung == len(self.models):
            names = ", ".join(model.name for model in self.models)
            raise ValueError(
                f"with a belief, the models of the loop are {names}; add {Naive.name}"
                " to `others`"
            )
        return rung

    @property
    def together(self) -> int:
        """Number of episodes that are computed together."""
        return self.chunk if self.game.number == 1 else 1


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Episodes:
    """What differs between episodes.

    Attributes:
        starts: all cars at the start: robot, humans, scripted cars.
        prices: lambda, at which the rule decides.
        schedules: rung of the model that predicts each human in each step, or
            `DECIDES`.
        robot_weights: weights of the robot's reward, in the order of its features.
        human_weights: weights of the rewards that the humans drive for; with one human,
            the robot knows them.
        drivers: what drives each human, see `HUMAN_PLANS`.
    """

    starts: Float[Array, "episodes cars 4"]
    prices: Float[Array, "episodes"]
    schedules: Int[Array, "episodes steps humans"]
    robot_weights: Float[Array, "episodes features"]
    human_weights: Float[Array, "episodes humans features"]
    drivers: Int[Array, "episodes humans"]

    def __len__(self) -> int:
        return len(self.starts)


class Records(NamedTuple):
    """Records of all steps.

    `ms_highway.experiments.runner.episode` has the same columns.

    Attributes:
        rungs: rung, in `Loop.models`, of the model that predicted each human in the
            plan that was followed.
        planned: the same in the step's own plan, whose T is counted; it is not followed
            where it is not finite.
        status: index of the status of the robot's control in
            `ms_highway.loop.step.STATUSES`.
        reward: the robot's reward after the step.
        collision: whether the robot collides in the step.
        gains: of each rung for each human, estimated before the step, see
            `ms_highway.choice.rule.Estimate`.
        states: all cars after the step.
        chosen: rungs that a user's rule chose, 0 where a schedule did; to be checked by
            `ms_highway.choice.rule.refuse_rungs`. None for the package's rules.
    """

    rungs: Int[Array, "episodes steps humans"]
    planned: Int[Array, "episodes steps humans"]
    status: Int[Array, "episodes steps"]
    # The world moves after the robot has planned: these are filled in last.
    reward: Float[Array, "episodes steps"] = None  # type: ignore[assignment]
    collision: Bool[Array, "episodes steps"] = None  # type: ignore[assignment]
    gains: Float[Array, "episodes steps humans rungs"] = None  # type: ignore[assignment]
    states: Float[Array, "episodes steps cars 4"] = None  # type: ignore[assignment]
    chosen: Int[Array, "episodes steps humans"] | None = None
