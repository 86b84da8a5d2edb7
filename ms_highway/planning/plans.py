"""Make plans: where they start from, against predicted humans, within limits."""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.dynamics import observe
from ms_highway.game.game import (
    Game,
    around,
    bounded,
    constant_velocity,
    discomfort,
    move,
    move_all,
    move_jacobian,
    trajectory_curvature,
    trajectory_reward,
)
from ms_highway.optimization.objective import Objective, best_of
from ms_highway.optimization.solvers import optimize_controls
from ms_highway.planning.manoeuvres import into_gaps, manoeuvres
from ms_highway.runtime.arrays import Car, Controls, HumansControls, State, Trajectories

MARGIN = 5.0
"""Reward by which a manoeuvre has to be better than the last plan, so that plans do not change for little."""

ACCELERATIONS = np.array([-8.0, -5.0, -2.5, 0.0, 2.0, 4.0], np.float32)  # m/s^2, of the manoeuvres to start from


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
        partial(move_jacobian, game, car),
    )


def best_start(game: Game, state: State, last: Controls, others: Trajectories) -> Controls:
    """Return the manoeuvre that earns most, if that is `MARGIN` more than the last plan earns; else the last plan.

    NaN where none of them earns anything finite.

    Steps of a solver do not leave a local optimum: there is a start per gap, and one per lane and acceleration, see
    `ms_highway.planning.manoeuvres`. Only for horizons of seconds, and where the planner is persistent, as the robot's.

    Args:
        game: of the robot.
        state: all cars now.
        last: scaled controls to start from otherwise.
        others: trajectories of the next cars; those beyond them keep their velocity.
    """
    if not (game.planner.for_seconds and game.planner.persistent):
        return last
    held = manoeuvres(game, state[0], game.planner.horizon, ACCELERATIONS)
    gaps = into_gaps(game, state[0], around(game, state, others))
    objective = driving(game, state[0], state, others)
    controls, states = (jnp.concatenate(sides) for sides in zip(held, gaps, strict=True))
    paths = jnp.stack(observe(states), axis=1)
    earned = jax.vmap(objective.earned)(controls, paths)
    kept = objective.earned(last) + MARGIN
    return best_of(jnp.concatenate([last[None], controls]), jnp.concatenate([kept[None], earned]))


@jax.jit  # traced once for the human and the robot, naive and turn
def plan_against(game: Game, state: State, humans: HumansControls, start: Plan | None = None) -> Plan:
    """Optimise the robot's controls against fixed controls of the humans."""
    expected = move_all(game, state[1 : 1 + len(humans)], humans)
    objective = driving(game, state[0], state, expected)
    last = (cold_start(game, state) if start is None else start).robot
    begin = best_start(game, state, last, expected)
    return Plan(optimize_controls(game.planner, objective, begin), humans)


def within_limits(game: Game, state: State, plan: Plan) -> Plan:
    """Limit all controls of a plan, see `ms_highway.game.game.bounded`."""
    if game.number == 1:
        return Plan(bounded(game, state[0], plan.robot), bounded(game, state[1], plan.humans[0])[None])
    humans = jax.vmap(partial(bounded, game))(state[1 : 1 + game.number], plan.humans)
    return Plan(bounded(game, state[0], plan.robot), humans)
