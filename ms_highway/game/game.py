"""Define the game that a robot and humans play, and the rewards of their plans.

Controls of plans are in units of the planner's ``control_scale`` throughout the core ("scaled"); only drivers convert
them to curvatures and accelerations.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.curvature import Blocks, curvature
from ms_highway.game.dynamics import (
    Dynamics,
    Motion,
    coast,
    keep_velocity,
    rollout,
    rollout_jacobian,
    speeds,
    within_grip,
)
from ms_highway.game.features import motion_reward
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.game.stopping import stopping_cost
from ms_highway.optimization.second_derivatives import Influence
from ms_highway.optimization.solvers import Planner, project
from ms_highway.runtime.arrays import (
    Car,
    Controls,
    HumansControls,
    Index,
    ManyControls,
    SameArray,
    Scalar,
    State,
    Trajectories,
    Trajectory,
    unrolled_sum,
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Game:
    """All that a planner needs. Changing a number in it never recompiles a plan.

    The first car is the robot, the next ones are the humans, and all others are scripted: they keep their velocity.

    Attributes:
        scene: road, obstacles and bodies.
        robot: the reward of car 0.
        humans: the humans' rewards, which differ in their weights, an array [humans, features].
        dynamics: assumed by plans.
        world: dynamics of the real cars, from which executed controls are recovered.
        planner: horizon, solver and limits of all plans.
        influence: form of the humans' response to the robot, see
            `ms_highway.optimization.second_derivatives.response` (static).
    """

    scene: Scene
    robot: Reward
    humans: Reward
    dynamics: Dynamics
    world: Dynamics
    planner: Planner
    influence: Influence = field(default="damped", metadata={"static": True})

    @property
    def number(self) -> int:
        """Number of humans."""
        return int(np.shape(self.humans.weights)[0])

    @property
    def braking(self) -> Scalar | None:
        """Deceleration by which plans for seconds keep room to stop before obstacles; None for others."""
        planner = self.planner
        if not planner.for_seconds or len(self.scene.obstacles) == 0:
            return None
        limit = jnp.asarray(planner.control_limit)[1]
        return limit if planner.grip is None else jnp.minimum(limit, jnp.asarray(planner.grip))

    def human(self, human: Index = 0) -> Reward:
        """Return the reward of a human."""
        weights = self.humans.weights if isinstance(human, int) else jnp.asarray(self.humans.weights)
        return replace(self.humans, weights=weights[0 if self.number == 1 else human])


@cache
def others_of(cars: int) -> Int[np.ndarray, "cars others"]:
    """Return for each of some cars the numbers of all others, in ascending order."""
    return np.array([[other for other in range(cars) if other != car] for car in range(cars)], int).reshape(cars, -1)


def each_human(game: Game, function: Callable[[Index], Any], at_once: bool = False) -> Any:
    """Compute a function of every human's number, one by one or all at once; results have an axis of humans."""
    if game.number == 1:
        return jax.tree.map(lambda part: jnp.asarray(part)[None], function(0))
    numbers = jnp.arange(game.number)
    return jax.vmap(function)(numbers) if at_once else jax.lax.map(function, numbers)


def pair(game: Game, state: State, human: Index) -> tuple[Game, State]:
    """Return the game of the robot with one of the humans, and its state; the other humans count as scripted."""
    if game.number == 1:
        return game, state
    others = jnp.asarray(others_of(len(state) - 1))[human]
    state = jnp.asarray(state)
    return (
        replace(game, humans=_alone(game.human(human))),
        jnp.concatenate([state[:1], state[1:][human][None], state[1:][others]]),
    )


def _alone(reward: Reward) -> Reward:
    return replace(reward, weights=reward.weights[None])


def swap_players(game: Game, state: State, human: Index = 0) -> tuple[Game, State]:
    """Return a human's `pair` and its state from the human's side: car 0 is the human, car 1 the robot."""
    _, state = pair(game, state, human)
    return swap_roles(game, human), jnp.concatenate([state[1::-1], state[2:]])


def swap_roles(game: Game, human: Index = 0) -> Game:
    """Return the game in which a human plans, and the robot is its only partner.

    Humans plan anew in every step, by the paper's solver; by the robot's where that is made for horizons of seconds,
    and for their own comfort only.
    """
    solver = game.planner.solver if game.planner.for_seconds else "gradient"
    planner = replace(game.planner, solver=solver, persistent=False, ease=0.0)
    return replace(game, robot=game.human(human), humans=_alone(game.robot), planner=planner)


def constant_velocity(game: Game, cars: Float[SameArray, "*cars 4"]) -> Float[SameArray, "*cars steps 2"]:
    """Return the scaled controls of cars that keep speed and heading over the horizon."""
    control = keep_velocity(game.dynamics, cars)[..., None, :] / game.planner.control_scale
    return cars.__array_namespace__().repeat(control, game.planner.horizon, axis=-2)


def bounded(game: Game, car: Car, controls: ManyControls) -> ManyControls:
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


def discomfort(game: Game, car: Car, controls: Controls) -> Scalar:
    """Return car 0's cost of not keeping its present velocity, ``sum comfort (u - u_keep)^2 / 2``, u scaled.

    For horizons of seconds, the planner's ``ease`` is added to its comfort. That of steering falls with the square of
    the lateral acceleration that it causes, relative to that at the speed limit: a car that stands steers for nothing.
    """
    kept = keep_velocity(game.dynamics, car) / game.planner.control_scale
    comfort = game.robot.comfort
    if game.planner.for_seconds:
        pace = jnp.minimum(jnp.abs(car[3]) / game.robot.speed_limit, 1.0)
        steering = pace**4 if game.dynamics.steering == "curvature" else pace**2
        comfort = comfort + game.planner.ease * jnp.stack([steering, jnp.ones_like(pace)])
    return jnp.sum(comfort * (controls - kept) ** 2) / 2


@jax.jit  # traced once, like `trajectory_reward`
def move(game: Game, car: Car, controls: Controls) -> Trajectory:
    """Return the trajectory of a car under scaled controls."""
    return jnp.stack(rollout(game.dynamics, car, controls * game.planner.control_scale))


def move_jacobian(game: Game, car: Car, controls: Controls) -> Float[jax.Array, "fields steps controls"]:
    """Return the derivative of `move` in the ravelled scaled controls."""
    scale = jnp.asarray(game.planner.control_scale)
    return rollout_jacobian(game.dynamics, car, controls * scale) * jnp.tile(scale, len(controls))


def move_all(game: Game, cars: State, controls: Float[Any, "cars steps 2"]) -> Trajectories:
    """Return the trajectories of some cars under scaled controls."""
    if len(cars) == 1:
        return move(game, cars[0], controls[0])[None]
    return jax.vmap(lambda car, own: move(game, car, own))(cars, controls)


@jax.jit  # traced and differentiated once for all plans
def trajectory_reward(game: Game, state: State, own: Trajectory, others: Trajectories) -> Scalar:
    """Sum car 0's `step_rewards` over its trajectory and those of others.

    Args:
        game: rewards and dynamics.
        state: all cars now; those beyond car 0 and the others keep their velocity.
        own: trajectory of car 0.
        others: trajectories of the next cars, its partner first.
    """
    return unrolled_sum(step_rewards(game, state, own, others))


def step_rewards(game: Game, state: State, own: Trajectory, others: Trajectories) -> Float[Any, "steps"]:
    """Compute car 0's reward after each step.

    For horizons of seconds it is the smooth one, and the car pays for leaving no room to stop before obstacles:
    `ms_highway.game.stopping.stopping_cost`, at the price of a collision.
    """
    motion, others = Motion(*own), around(game, state, others)
    rewards, braking = motion_reward(game.scene, game.robot, motion, others, game.planner.for_seconds), game.braking
    if braking is None:
        return rewards
    return rewards - game.robot.price("collision") * stopping_cost(game.scene, braking, motion)


def around(game: Game, state: State, others: Trajectories) -> Motion:
    """Return the motion of all cars but car 0; those beyond the trajectories given keep their velocity."""
    rest = coast(game.dynamics, state[1 + len(others) :], others.shape[-1])
    # One human's fields are read one by one: XLA then fuses its plans into the same kernels, to the last digit.
    fields = [field[None] for field in others[0]] if len(others) == 1 else jnp.unstack(others, axis=1)
    return Motion(*(jnp.concatenate([known, more]) for known, more in zip(fields, rest, strict=True)))


def trajectory_curvature(game: Game, state: State, own: Trajectory, others: Trajectories) -> Blocks:
    """Return how `trajectory_reward` bends, see `ms_highway.game.curvature`."""
    return curvature(game.scene, game.robot, Motion(*own), around(game, state, others), game.braking)


def rollout_reward(game: Game, car: Car, controls: Controls, others: Motion) -> Scalar:
    """Sum car 0's reward over a rollout of its controls among others of given motion; subtract its discomfort.

    Args:
        game: reward and dynamics.
        car: car 0 now.
        controls: its scaled controls.
        others: motion of all others after each step, arrays [others, steps].
    """
    own = Motion(*move(game, car, controls))
    return jnp.sum(motion_reward(game.scene, game.robot, own, others)) - discomfort(game, car, controls)


def total_reward(game: Game, state: State, robot: Controls, humans: HumansControls) -> Scalar:
    """Return the robot's `trajectory_reward` under controls of all, R_R(x, u_R, u_H); they are scaled."""
    paths = move_all(game, state[1 : 1 + len(humans)], humans)
    return trajectory_reward(game, state, move(game, state[0], robot), paths)
