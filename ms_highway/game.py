"""The game that robot and human play: a scene, two rewards, and the motion that plans assume.

A plan's controls are kept in units of the planner's ``control_scale`` throughout the core ("scaled"); only the
controllers turn them into curvatures and accelerations.
"""

from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.dynamics import Dynamics, coast, keep_velocity, rollout
from ms_highway.planner import Planner
from ms_highway.reward import Reward, reward
from ms_highway.scene import Scene

__all__ = ["Game", "Influence", "constant_velocity", "response", "swap", "swap_roles", "total_reward"]

Influence: TypeAlias = Literal["exact", "damped"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Game:
    """All that a planner has to know. Changing a number in it never recompiles a plan.

    Attributes:
        scene: road, obstacles and bodies.
        robot: the reward of car 0.
        human: the reward of car 1.
        dynamics: the motion that plans assume.
        world: the motion of the real cars, from which executed controls are recovered.
        planner: horizon, steps and limits of every plan.
        influence: how the human's response to the robot is computed, see `response` (static).
    """

    scene: Scene
    robot: Reward
    human: Reward
    dynamics: Dynamics
    world: Dynamics
    planner: Planner
    influence: Influence = field(default="damped", metadata={"static": True})


def swap(game: Game, state: Float[jax.Array, "cars 4"]) -> tuple[Game, Float[jax.Array, "cars 4"]]:
    """The game and its state through the human's eyes: cars 0 and 1 change places."""
    return swap_roles(game), jnp.concatenate([state[1::-1], state[2:]])


def swap_roles(game: Game) -> Game:
    """The game in which the human is the one to plan."""
    return replace(game, robot=game.human, human=game.robot)


def constant_velocity(game: Game, car: Float[jax.Array, "4"]) -> Float[jax.Array, "steps 2"]:
    """The scaled controls of a car that keeps speed and heading over the horizon."""
    control = keep_velocity(game.dynamics, car) / game.planner.control_scale
    return jnp.broadcast_to(control, (game.planner.horizon, 2))


def total_reward(
    game: Game,
    state: Float[jax.Array, "cars 4"],
    robot: Float[jax.Array, "steps 2"],
    human: Float[jax.Array, "steps 2"],
) -> Float[jax.Array, ""]:
    """The robot's reward, summed over the states after each step, R_R(x, u_R, u_H).

    Args:
        game: whose rewards and motion.
        state: all cars now; cars beyond the first two keep their velocity.
        robot: scaled controls of car 0, of any number of steps.
        human: scaled controls of car 1, as many.
    """
    controls = jnp.stack([robot, human], axis=1) * game.planner.control_scale
    players = rollout(game.dynamics, state[:2], controls)
    others = coast(game.dynamics, state[2:], len(controls))
    states = jnp.concatenate([players, others], axis=1)
    return jnp.sum(reward(game.scene, game.robot, states))


def response(
    influence: Influence, hessian: Float[jax.Array, "n n"], vector: Float[jax.Array, "n *columns"]
) -> Float[jax.Array, "n *columns"]:
    """``-H^-1 vector``: where a human moves the optimum of its reward, whose Hessian is H, under a push ``vector``.

    * ``exact`` takes H as it is, like the paper and its released code; H need not be negative definite along the way
      nor invertible, and then the answer is wild or not finite.
    * ``damped`` first sets H's eigenvalues l to ``-max(|l|, 1)``, which makes every response an ascent and bounds it.
    """
    if influence == "exact":
        return -jnp.linalg.solve(hessian, vector)
    values, vectors = jnp.linalg.eigh(hessian)
    stiffness = jnp.maximum(jnp.abs(values), 1.0)
    return (vectors / stiffness) @ (vectors.T @ vector)
