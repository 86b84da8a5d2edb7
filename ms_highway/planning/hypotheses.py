"""Predict what every human does next if one model or another is true of it.

The models are `ms_highway.planning.road.settings.RUNGS`, on which `ms_highway.metareasoning.belief` decides.
"""

from dataclasses import replace
from functools import partial

import jax
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.game.crowd import Crowd, others_of
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import constant_velocity, move
from ms_highway.game.planning_settings import PlanningSettings, gradient_steps
from ms_highway.optimization.second_derivatives import Trajectory
from ms_highway.planning.crowd import predict_human
from ms_highway.planning.road.traffic import FAR, follow

__all__ = ["next_controls"]

LOOKAHEAD = 8  # steps of answers at most, only the first of which counts
HEADWAY, STANDSTILL = 0.1, 1.0  # s and m between bumpers: 3 m at 20 m/s, as in the streams of Dense Merge


def next_controls(
    crowd: Crowd, state: Float[jax.Array, "cars 4"], robot: Float[jax.Array, "steps 2"]
) -> Float[jax.Array, "humans models 2"]:
    """Return the next control of every human under each model, unscaled.

    * naive keeps the velocity.
    * idm keeps its heading and follows the car ahead in its lane, the robot too where it is there, with the speed limit
      as its desired speed.
    * turn answers a robot that keeps its velocity, and tom one that follows its plan, with the best plan for its own
      reward, as the robot believes it, among others who keep their velocity. Humans plan by gradient steps, over
      `LOOKAHEAD` steps at most: in Dense Merge this comes closer to how they drive than shorter plans by Newton steps.

    Args:
        crowd: the game.
        state: all cars.
        robot: scaled controls that the robot follows from there on.
    """
    planner = replace(crowd.game.planner, solver="gradient")
    shortened = planner.horizon > LOOKAHEAD
    if shortened:
        iterations, length = gradient_steps(PlanningSettings(LOOKAHEAD))
        planner = replace(planner, horizon=LOOKAHEAD, iterations=iterations, step_size=length)
    game, humans = replace(crowd.game, planner=planner), state[1 : 1 + crowd.humans]
    crowd = replace(crowd, game=game)
    path = move(game, state[0], robot[: planner.horizon])

    def answer(robot: Trajectory | None, human: Int[jax.Array, ""]) -> Float[jax.Array, "2"]:
        start = constant_velocity(game, state[1 + human]) if shortened else None
        return predict_human(crowd, state, human, start, robot)[0] * game.planner.control_scale

    numbers, kept = jnp.arange(crowd.humans), keep_velocity(game.dynamics, humans)
    answers = [jax.lax.map(partial(answer, each), numbers) for each in (None, path)]
    return jnp.stack([kept, kept.at[:, 1].add(_following(crowd, state)), *answers], axis=1)


def _following(crowd: Crowd, state: Float[jax.Array, "cars 4"]) -> Float[jax.Array, "humans"]:
    """Return the change of speed of every human by the Intelligent Driver Model [m/s^2]."""
    scene, last = crowd.game.scene, 1 + crowd.humans
    others = state[jnp.asarray(others_of(len(state)))[1:last]]
    offset = others[..., :2] - state[1:last, None, :2]
    ahead = (offset[..., 0] > 0) & (jnp.abs(offset[..., 1]) < jnp.asarray(scene.lane_width) / 2)
    gaps = jnp.where(ahead, offset[..., 0] - jnp.asarray(scene.car_size)[0], FAR)
    speeds = jnp.take_along_axis(others[..., 3], gaps.argmin(axis=1)[:, None], axis=1)[:, 0]
    limit = jnp.asarray(crowd.game.human.speed_limit)
    return follow(state[1:last, 3], limit, gaps.min(axis=1), speeds, HEADWAY, STANDSTILL)
