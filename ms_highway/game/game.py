"""Define the game that a robot and humans play, and the rewards of their plans.

Controls of plans are in units of the planner's ``control_scale`` throughout the core ("scaled"); only drivers convert
them to curvatures and accelerations.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.curvature import curvature
from ms_highway.game.dynamics import (
    Dynamics,
    Motion,
    coast,
    keep_velocity,
    rollout,
    speeds,
    within_grip,
)
from ms_highway.game.features import motion_reward
from ms_highway.game.reward import Reward
from ms_highway.game.scene import Scene
from ms_highway.game.stopping import stopping_cost
from ms_highway.numerics.second_derivatives import Influence, along_fields
from ms_highway.numerics.solvers import Planner, project
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
            `ms_highway.numerics.second_derivatives.response` (static).
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
        """Deceleration by which plans of a smooth reward keep room to stop before obstacles; None for others."""
        planner = self.planner
        if not planner.smooth or len(self.scene.obstacles) == 0:
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

    Humans plan anew in every step, by the paper's solver; by the robot's where that climbs a smooth reward, and for
    their own comfort only.
    """
    solver = game.planner.solver if game.planner.smooth else "gradient"
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
    bend = 0.0 if game.scene.bend is None else game.scene.bend
    physical = controls * planner.control_scale
    return _held(game.dynamics, jnp.asarray(planner.grip), jnp.asarray(bend), car, physical) / planner.control_scale


@jax.jit
def _held(dynamics: Dynamics, grip: Scalar, bend: Scalar, car: Car, controls: ManyControls) -> ManyControls:
    now = jnp.broadcast_to(car[3], controls.shape[:-2])
    speed = jnp.maximum(speeds(dynamics, now, controls[..., 1])[..., :-1], 0.0)
    return within_grip(dynamics, grip, speed, controls, bend)


def discomfort(game: Game, car: Car, controls: Controls) -> Scalar:
    """Return car 0's cost of not keeping its present velocity, ``sum comfort (u - u_keep)^2 / 2``, u scaled.

    The planner's ``ease`` is added to its comfort. That of steering falls with the square of the lateral acceleration
    that it causes, relative to that at the speed limit: a car that stands steers for nothing.
    """
    kept = keep_velocity(game.dynamics, car) / game.planner.control_scale
    pace = jnp.minimum(jnp.abs(car[3]) / game.robot.speed_limit, 1.0)
    steering = pace**4 if game.dynamics.steering == "curvature" else pace**2
    comfort = game.robot.comfort + game.planner.ease * jnp.stack([steering, jnp.ones_like(pace)])
    return jnp.sum(comfort * (controls - kept) ** 2) / 2


def move(game: Game, car: Car, controls: Controls) -> Trajectory:
    """Return the trajectory of a car under scaled controls."""
    return _move(game.dynamics, car, controls * game.planner.control_scale)


@jax.jit
def _move(dynamics: Dynamics, car: Car, controls: Controls) -> Trajectory:
    return jnp.stack(rollout(dynamics, car, controls))


def move_all(game: Game, cars: State, controls: Float[Any, "cars steps 2"]) -> Trajectories:
    """Return the trajectories of some cars under scaled controls."""
    if len(cars) == 1:
        return move(game, cars[0], controls[0])[None]
    return jax.vmap(partial(move, game))(cars, controls)


def with_scripted(game: Game, state: State, players: Trajectories) -> Trajectories:
    """Return the trajectories of some cars, and of all cars after them, which keep their velocity.

    Args:
        game: its dynamics.
        state: all cars now.
        players: trajectories of the first cars after car 0.
    """
    scripted = coast(game.dynamics, state[1 + len(players) :], players.shape[-1])
    return jnp.concatenate([players, jnp.stack(scripted, axis=1)])


def trajectory_reward(game: Game, own: Trajectory, others: Trajectories) -> Scalar:
    """Sum car 0's reward over its trajectory, among the trajectories of all others; see `step_rewards`."""
    return _summed(*_weighed(game), own, others)


def reward_slopes(game: Game, own: Trajectory, others: Trajectories) -> tuple[Trajectory, Trajectories]:
    """Differentiate `trajectory_reward` in car 0's trajectory, and in those of all others."""
    return _slopes(*_weighed(game), own, others)


class Bends(NamedTuple):
    """Derivatives of car 0's reward at every step of its trajectory.

    Attributes:
        slope: in its own fields.
        own: twice in its own fields, [fields, fields, steps].
        partner: in its own fields, then in those of its partner.
    """

    slope: Trajectory
    own: Float[jax.Array, "fields fields steps"]
    partner: Float[jax.Array, "fields fields steps"]


def reward_bends(game: Game, own: Trajectory, others: Trajectories) -> Bends:
    """Differentiate `trajectory_reward` twice, in as many directions as a motion has fields."""
    return _bends(*_weighed(game), own, others)


def step_rewards(game: Game, own: Trajectory, others: Trajectories) -> Float[Any, "steps"]:
    """Compute car 0's reward after each step.

    Where the planner wants it smooth, the car also pays for leaving no room to stop before obstacles, at the price of
    a collision, see `ms_highway.game.stopping.stopping_cost`.
    """
    return _rewards(*_weighed(game), own, others)


def _weighed(game: Game) -> tuple[bool, Scene, Reward, Scalar | None]:
    """Return the arguments of a trajectory's reward. They are few, so that all plans share one trace."""
    return game.planner.smooth, game.scene, game.robot, game.braking


def _rewards(
    smooth: bool, scene: Scene, reward: Reward, braking: Scalar | None, own: Trajectory, others: Trajectories
) -> Float[Any, "steps"]:
    motion = Motion(*own)
    rewards = motion_reward(scene, reward, motion, Motion(*jnp.moveaxis(others, 1, 0)), smooth)
    if braking is None:
        return rewards
    return rewards - reward.price("collision") * stopping_cost(scene, braking, motion)


@partial(jax.jit, static_argnums=0)
def _summed(
    smooth: bool, scene: Scene, reward: Reward, braking: Scalar | None, own: Trajectory, others: Trajectories
) -> Scalar:
    return jnp.sum(_rewards(smooth, scene, reward, braking, own, others))


@partial(jax.jit, static_argnums=0)
def _slopes(*arguments: Any) -> tuple[Trajectory, Trajectories]:
    return jax.grad(_summed, argnums=(4, 5))(*arguments)


@partial(jax.jit, static_argnums=0)
def _bends(*arguments: Any) -> Bends:
    *weighed, own, others = arguments

    def slopes(own: Trajectory) -> tuple[Trajectory, Trajectory]:
        slope, around = _slopes(*weighed, own, others)
        return slope, around[0]

    (slope, _), bends = along_fields(slopes, own)
    return Bends(slope, *bends)


def trajectory_curvature(game: Game, own: Trajectory, others: Trajectories) -> Float[Any, "fields fields steps"]:
    """Return how `trajectory_reward` bends, see `ms_highway.game.curvature`."""
    _, *weighed = _weighed(game)
    return _curvature(*weighed, own, others)


@jax.jit
def _curvature(
    scene: Scene, reward: Reward, braking: Scalar | None, own: Trajectory, others: Trajectories
) -> Float[Any, "fields fields steps"]:
    return curvature(scene, reward, own, Motion(*jnp.moveaxis(others, 1, 0)), braking)


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
    paths = with_scripted(game, state, move_all(game, state[1 : 1 + len(humans)], humans))
    return trajectory_reward(game, move(game, state[0], robot), paths)
