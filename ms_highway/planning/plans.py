"""Make plans: where they start from, against predicted humans, within limits."""

from functools import partial
from typing import NamedTuple

import jax
from jax import numpy as jnp

from ms_highway.game.game import (
    Game,
    bounded,
    constant_velocity,
    discomfort,
    move,
    move_all,
    trajectory_curvature,
    trajectory_reward,
)
from ms_highway.optimization.objective import Objective
from ms_highway.optimization.solvers import optimize_controls
from ms_highway.runtime.arrays import Car, Controls, HumansControls, State, Trajectories


class Plan(NamedTuple):
    """The robot's controls and those that they expect of every human.

    Scaled in models and starts: times ``game.planner.control_scale``, they are curvatures [1/m] and accelerations
    before friction [m/s^2], as `ms_highway.planning.compiled_plans.plan` returns them.
    """

    robot: Controls
    humans: HumansControls


def one_step_later(plan: Plan) -> Plan:
    """Return what is left of a plan after its first step, its last controls repeated."""
    xp = plan.robot.__array_namespace__()  # of NumPy or JAX
    return Plan(*(xp.concat([side[..., 1:, :], side[..., -1:, :]], axis=-2) for side in plan))


def cold_start(game: Game, state: State) -> Plan:
    """Return the plan that plans start from without a last one.

    All controls are zero, the paper's start, or keep the velocity where the solver is made for horizons of seconds.
    """
    cars = 1 + game.number
    if game.planner.for_seconds:
        controls = constant_velocity(game, state[:cars])
    else:
        controls = jnp.zeros((cars, game.planner.horizon, 2))
    return Plan(controls[0], controls[1:])


def driving(game: Game, car: Car, state: State, others: Trajectories) -> Objective:
    """Return what car 0 of a game maximises over its controls, among others of given trajectories.

    Args:
        game: of the car.
        car: its state now.
        state: all cars now; those beyond the others keep their velocity.
        others: trajectories of the next cars, its partner first.
    """
    return Objective(
        partial(move, game, car),
        lambda own: trajectory_reward(game, state, own, others),
        partial(discomfort, game, car),
        partial(bounded, game, car),
        lambda own: trajectory_curvature(game, state, own, others),
    )


@jax.jit  # traced once for the human and the robot, naive and turn
def plan_against(game: Game, state: State, humans: HumansControls, start: Plan | None = None) -> Plan:
    """Optimise the robot's controls against fixed controls of the humans."""
    expected = move_all(game, state[1 : 1 + len(humans)], humans)
    objective = driving(game, state[0], state, expected)
    robot = optimize_controls(game.planner, objective, (cold_start(game, state) if start is None else start).robot)
    return Plan(robot, humans)


def within_limits(game: Game, state: State, plan: Plan) -> Plan:
    """Limit all controls of a plan, see `ms_highway.game.game.bounded`."""
    if game.number == 1:
        return Plan(bounded(game, state[0], plan.robot), bounded(game, state[1], plan.humans[0])[None])
    humans = jax.vmap(partial(bounded, game))(state[1 : 1 + game.number], plan.humans)
    return Plan(bounded(game, state[0], plan.robot), humans)
