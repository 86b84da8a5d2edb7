"""Choose models without estimating their gains: all the same, those for the most important humans, at random."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import partial

import jax
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.crowd import Crowd, along_others, coasting
from ms_highway.game.game import move
from ms_highway.game.neighbours import far_behind
from ms_highway.metareasoning.crowd.rule import CrowdDecision, CrowdMemory, CrowdOutcome
from ms_highway.planning.crowd import NAIVE, RUNGS, TOM
from ms_highway.runtime.arrays import Array

__all__ = ["AllOfOne", "Influence", "Nearest", "RandomRungs", "TimeToCollision"]

LANES_AWAY = 1.5  # lanes to the side, beyond which a robot that changes lanes does not collide with a car


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AllOfOne:
    """Predict every human with the same model.

    Attributes:
        rung: of all.
    """

    rung: int | Int[Array, ""]

    def choose(self, crowd: Crowd, memory: CrowdMemory, outcome: CrowdOutcome) -> CrowdDecision:
        """See `ms_highway.metareasoning.crowd.rule.CrowdRule`."""
        return _chosen(memory, jnp.full(crowd.humans, self.rung))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RandomRungs:
    """Draw every human's model anew in every step, from the seed of the episode and the number of the step.

    Attributes:
        shares: probability of each rung.
    """

    shares: Float[Array, "rungs"]

    def choose(self, crowd: Crowd, memory: CrowdMemory, outcome: CrowdOutcome) -> CrowdDecision:
        """See `ms_highway.metareasoning.crowd.rule.CrowdRule`."""
        key = jax.random.fold_in(jax.random.key(memory.seed), memory.step)
        return _chosen(memory, jax.random.categorical(key, jnp.log(jnp.asarray(self.shares)), shape=(crowd.humans,)))


@dataclass(frozen=True)
class _MostImportant(ABC):
    """Predict the most important humans by theory of mind, and all others naively.

    Attributes:
        count: number of humans under theory of mind.
    """

    count: int | Int[Array, ""]

    @abstractmethod
    def unimportance(self, crowd: Crowd, outcome: CrowdOutcome) -> Float[jax.Array, "humans"]:
        """Return what is lowest for the most important human."""

    def choose(self, crowd: Crowd, memory: CrowdMemory, outcome: CrowdOutcome) -> CrowdDecision:
        """See `ms_highway.metareasoning.crowd.rule.CrowdRule`; among equals, the nearest human comes first."""
        order = jnp.lexsort((_distances(crowd, outcome), self.unimportance(crowd, outcome)))
        return _chosen(memory, jnp.where(jnp.argsort(order) < self.count, TOM, NAIVE))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Nearest(_MostImportant):
    """Predict the nearest humans by theory of mind, and all others naively."""

    def unimportance(self, crowd: Crowd, outcome: CrowdOutcome) -> Float[jax.Array, "humans"]:
        """Return the distance of every human."""
        return _distances(crowd, outcome)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TimeToCollision(_MostImportant):
    """Predict the humans with the shortest time to collision by theory of mind, and all others naively."""

    def unimportance(self, crowd: Crowd, outcome: CrowdOutcome) -> Float[jax.Array, "humans"]:
        """Return the time until bodies meet in x, at constant velocities, as if the cars were in the same lane.

        A robot that merges is yet to come into that lane: lateral offsets are ignored up to one and a half lanes.
        The time is 0 for cars abreast, and infinite for those that go apart or are further to the side.
        """
        robot, humans = outcome.after[0], outcome.after[1 : 1 + crowd.humans]
        ahead, aside = (humans[:, :2] - robot[:2]).T
        gap = jnp.maximum(jnp.abs(ahead) - jnp.asarray(crowd.game.scene.car_size)[0], 0.0)
        along = humans[:, 3] * jnp.cos(humans[:, 2]) - robot[3] * jnp.cos(robot[2])
        closing = -jnp.sign(ahead) * along
        time = jnp.where(closing > 0, gap / jnp.where(closing > 0, closing, 1.0), jnp.inf)
        beside = jnp.abs(aside) < LANES_AWAY * jnp.asarray(crowd.game.scene.lane_width)
        return jnp.where(beside, jnp.where(gap > 0, time, 0.0), jnp.inf)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Influence(_MostImportant):
    """Predict the humans that influence the robot's plan most by theory of mind (priority of Refaat et al. 2019).

    The rest of the last plan would be improved along its gradient. A human's influence is the length of the change of
    this gradient when the human is left out, while all others do what the last plan expected of them.
    """

    def unimportance(self, crowd: Crowd, outcome: CrowdOutcome) -> Float[jax.Array, "humans"]:
        """Return the negative influence of every human."""
        game, last, state = crowd.game, 1 + crowd.humans, jnp.asarray(outcome.after)
        rest = (jnp.concatenate([side[..., 1:, :], side[..., -1:, :]], axis=-2) for side in outcome.plan)
        robot, humans = map(jnp.asarray, rest)
        moved = jax.vmap(partial(move, game))(state[1:last], humans)
        others = jnp.concatenate([moved, coasting(game, state[last:])])
        absent = coasting(game, far_behind(state[:1]))

        def slope(others: Float[jax.Array, "others fields steps"]) -> Float[jax.Array, "steps 2"]:
            return jax.grad(lambda own: along_others(game.scene, game.robot, move(game, state[0], own), others))(robot)

        without = jax.vmap(lambda human: slope(others.at[human].set(absent[0])))(jnp.arange(crowd.humans))
        return -jnp.linalg.norm(without - slope(others), axis=(1, 2))


def _distances(crowd: Crowd, outcome: CrowdOutcome) -> Float[jax.Array, "humans"]:
    """Return the distance of every human from the robot."""
    places = jnp.asarray(outcome.after)[: 1 + crowd.humans, :2]
    return jnp.linalg.norm(places[1:] - places[0], axis=1)


def _chosen(memory: CrowdMemory, rungs: Int[jax.Array, "humans"]) -> CrowdDecision:
    """Return the decision for some rungs; nothing was estimated."""
    after = memory._replace(rungs=rungs.astype(jnp.int32), step=memory.step + 1)
    return CrowdDecision(after, jnp.full((len(rungs), len(RUNGS)), jnp.nan), jnp.bool(False))
