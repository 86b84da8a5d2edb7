"""Predict the most important humans by the top of the ladder, and all others by the first rung."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import jax
from jax import numpy as jnp

from ms_highway.game.dynamics import coast
from ms_highway.game.game import Game, move, move_all, trajectory_reward
from ms_highway.game.neighbours import far_behind
from ms_highway.metareasoning.rule import Decision, Memory, Outcome, unestimated
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import HumanModel
from ms_highway.planning.plans import one_step_later
from ms_highway.runtime.arrays import Controls, HumansControl, Index, PerHuman, Trajectories

LANES_AWAY = 1.5  # lanes to the side, beyond which a robot that changes lanes does not collide with a car


@dataclass(frozen=True)
class MostImportant(ABC):
    """Predict the most important humans by the top of the ladder, and all others by the first rung.

    Attributes:
        count: number of humans on the top rung.
        costs: planning time, for records.
        ladder: human models (static).
    """

    count: Index
    costs: Costs
    ladder: tuple[HumanModel, ...] = field(metadata={"static": True})

    @abstractmethod
    def unimportance(self, game: Game, outcome: Outcome) -> PerHuman:
        """Return what is lowest for the most important human."""

    def look(self, game: Game, memory: Memory, outcome: Outcome) -> HumansControl:
        """Return unimportances and distances."""
        return jnp.stack([self.unimportance(game, outcome), _distances(game, outcome)], axis=1)

    def choose(self, memory: Memory, seen: HumansControl) -> Decision:
        """See `ms_highway.metareasoning.rule.Rule.choose`; among equals, the nearest human comes first."""
        order = jnp.lexsort((seen[:, 1], seen[:, 0]))
        return unestimated(memory, jnp.where(jnp.argsort(order) < self.count, len(self.ladder) - 1, 0))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Nearest(MostImportant):
    """The nearest humans are the most important ones."""

    def unimportance(self, game: Game, outcome: Outcome) -> PerHuman:
        """Return the distance of every human."""
        return _distances(game, outcome)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TimeToCollision(MostImportant):
    """The humans with the shortest time to collision are the most important ones."""

    def unimportance(self, game: Game, outcome: Outcome) -> PerHuman:
        """Return the time until bodies meet in x, at constant velocities, as if the cars were in the same lane.

        A robot that merges is yet to come into that lane: lateral offsets are ignored up to one and a half lanes.
        The time is 0 for cars abreast, and infinite for those that go apart or are further to the side.
        """
        robot, humans = outcome.after[0], outcome.after[1 : 1 + game.number]
        ahead, aside = (humans[:, :2] - robot[:2]).T
        gap = jnp.maximum(jnp.abs(ahead) - jnp.asarray(game.scene.car_size)[0], 0.0)
        along = humans[:, 3] * jnp.cos(humans[:, 2]) - robot[3] * jnp.cos(robot[2])
        closing = -jnp.sign(ahead) * along
        time = jnp.where(closing > 0, gap / jnp.where(closing > 0, closing, 1.0), jnp.inf)
        beside = jnp.abs(aside) < LANES_AWAY * jnp.asarray(game.scene.lane_width)
        return jnp.where(beside, jnp.where(gap > 0, time, 0.0), jnp.inf)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Influence(MostImportant):
    """The humans that influence the robot's plan most are the most important ones (Refaat et al. 2019).

    The rest of the last plan would be improved along its gradient. A human's influence is the length of the change of
    this gradient when the human is left out, while all others do what the last plan expected of them.
    """

    def unimportance(self, game: Game, outcome: Outcome) -> PerHuman:
        """Return the negative influence of every human."""
        last, state = 1 + game.number, jnp.asarray(outcome.after)
        robot, humans = one_step_later(outcome.plan)
        others = move_all(game, state[1:last], humans)
        absent = jnp.stack(coast(game.dynamics, far_behind(state[0]), game.planner.horizon))

        def slope(others: Trajectories) -> Controls:
            return jax.grad(lambda own: trajectory_reward(game, state, move(game, state[0], own), others))(robot)

        without = jax.vmap(lambda human: slope(others.at[human].set(absent)))(jnp.arange(game.number))
        return -jnp.linalg.norm(without - slope(others), axis=(1, 2))


def _distances(game: Game, outcome: Outcome) -> PerHuman:
    places = jnp.asarray(outcome.after)[: 1 + game.number, :2]
    return jnp.linalg.norm(places[1:] - places[0], axis=1)
