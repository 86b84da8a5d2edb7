"""Define the game that robot and human play, and the rewards of their plans.

Controls of plans are in units of the planner's ``control_scale`` throughout the core ("scaled"); only the controllers
convert them to curvatures and accelerations.
"""

from dataclasses import dataclass, field, replace

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import Dynamics, Motion, coast, keep_velocity, rollout, speeds, within_grip
from ms_highway.game.features import motion_reward
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.optimization.second_derivatives import Influence, Trajectory
from ms_highway.optimization.solvers import Planner, project
from ms_highway.runtime.arrays import unrolled_sum

__all__ = [
    "Game",
    "bounded",
    "constant_velocity",
    "discomfort",
    "move",
    "rollout_reward",
    "step_rewards",
    "swap_players",
    "swap_roles",
    "total_reward",
    "trajectory_reward",
]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Game:
    """All that a planner needs. Changing a number in it never recompiles a plan.

    Attributes:
        scene: road, obstacles and bodies.
        robot: the reward of car 0.
        human: the reward of car 1.
        dynamics: assumed by plans.
        world: dynamics of the real cars, from which executed controls are recovered.
        planner: horizon, solver and limits of all plans.
        influence: form of the human's response to the robot, see
            `ms_highway.optimization.second_derivatives.response` (static).
    """

    scene: Scene
    robot: Reward
    human: Reward
    dynamics: Dynamics
    world: Dynamics
    planner: Planner
    influence: Influence = field(default="damped", metadata={"static": True})


def swap_players(game: Game, state: Float[jax.Array, "cars 4"]) -> tuple[Game, Float[jax.Array, "cars 4"]]:
    """Return the game and its state from the human's perspective: cars 0 and 1 swapped."""
    return swap_roles(game), jnp.concatenate([state[1::-1], state[2:]])


def swap_roles(game: Game) -> Game:
    """Return the game in which the human plans; humans use the paper's solver, whatever the robot's."""
    return replace(game, robot=game.human, human=game.robot, planner=replace(game.planner, solver="gradient"))


def constant_velocity(game: Game, car: Float[jax.Array, "4"]) -> Float[jax.Array, "steps 2"]:
    """Return the scaled controls of a car that keeps speed and heading over the horizon."""
    control = keep_velocity(game.dynamics, car) / game.planner.control_scale
    return jnp.broadcast_to(control, (game.planner.horizon, 2))


def bounded(
    game: Game, car: Float[jax.Array, "4"], controls: Float[jax.Array, "*batch steps 2"]
) -> Float[jax.Array, "*batch steps 2"]:
    """Limit scaled controls to the planner's ``control_limit`` and, if it is given, to its ``grip``.

    The limit by grip depends on the speed, which follows from the unlimited accelerations: the first control is exact,
    later ones may exceed the grip by a quarter. Executed controls never do.
    """
    controls, planner = project(game.planner, controls), game.planner
    if planner.grip is None:
        return controls
    physical = controls * planner.control_scale
    now = jnp.broadcast_to(car[3], physical.shape[:-2])
    speed = jnp.maximum(speeds(game.dynamics, now, physical[..., 1])[..., :-1], 0.0)
    grip, bend = jnp.asarray(planner.grip), jnp.asarray(0.0 if game.scene.bend is None else game.scene.bend)
    return within_grip(game.dynamics, grip, speed, physical, bend) / planner.control_scale


def discomfort(game: Game, car: Float[jax.Array, "4"], controls: Float[jax.Array, "steps 2"]) -> Float[jax.Array, ""]:
    """Return car 0's cost of not keeping its present velocity, ``sum comfort (u - u_keep)^2 / 2``, u scaled."""
    kept = keep_velocity(game.dynamics, car) / game.planner.control_scale
    return jnp.sum(game.robot.comfort * (controls - kept) ** 2) / 2


@jax.jit  # traced once, like `trajectory_reward`
def move(game: Game, car: Float[jax.Array, "4"], controls: Float[jax.Array, "steps 2"]) -> Trajectory:
    """Return the trajectory of a car under scaled controls."""
    return jnp.stack(rollout(game.dynamics, car, controls * game.planner.control_scale))


@jax.jit  # traced and differentiated once for all plans
def trajectory_reward(
    game: Game, state: Float[jax.Array, "cars 4"], robot: Trajectory, human: Trajectory
) -> Float[jax.Array, ""]:
    """Sum the robot's reward over the steps of both players' trajectories.

    Args:
        game: rewards and dynamics.
        state: all cars now; those beyond the first two keep their velocity.
        robot: trajectory of car 0.
        human: trajectory of car 1.
    """
    return unrolled_sum(step_rewards(game, state, robot, human))


def step_rewards(
    game: Game, state: Float[jax.Array, "cars 4"], robot: Trajectory, human: Trajectory
) -> Float[jax.Array, "steps"]:
    """Compute the robot's reward after each step of both players' trajectories, see `trajectory_reward`."""
    rest = coast(game.dynamics, state[2:], robot.shape[-1])
    others = Motion(*(jnp.concatenate([first[None], more]) for first, more in zip(human, rest, strict=True)))
    return motion_reward(game.scene, game.robot, Motion(*robot), others)


def rollout_reward(
    game: Game, car: Float[jax.Array, "4"], controls: Float[jax.Array, "steps 2"], others: Motion
) -> Float[jax.Array, ""]:
    """Sum car 0's reward over a rollout of its controls among others of given motion; subtract its discomfort.

    Args:
        game: reward and dynamics.
        car: car 0 now.
        controls: its scaled controls.
        others: motion of all others after each step, arrays [others, steps].
    """
    own = Motion(*move(game, car, controls))
    return jnp.sum(motion_reward(game.scene, game.robot, own, others)) - discomfort(game, car, controls)


def total_reward(
    game: Game,
    state: Float[jax.Array, "cars 4"],
    robot: Float[jax.Array, "steps 2"],
    human: Float[jax.Array, "steps 2"],
) -> Float[jax.Array, ""]:
    """Sum the robot's reward over the states after each step, R_R(x, u_R, u_H).

    Args:
        game: rewards and dynamics.
        state: all cars now; cars beyond the first two keep their velocity.
        robot: scaled controls of car 0, of any number of steps.
        human: scaled controls of car 1, as many.
    """
    return trajectory_reward(game, state, move(game, state[0], robot), move(game, state[1], human))
