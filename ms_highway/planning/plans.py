"""Define plans, their initial guesses, their objective and their limits."""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.car_following import CAR_LIMITS
from ms_highway.game.dynamics import Motion, observe
from ms_highway.game.game import (
    Game,
    bounded,
    constant_velocity,
    discomfort,
    move,
    move_jacobian,
)
from ms_highway.numerics.objective import Objective, best_of
from ms_highway.planning.manoeuvres import into_gaps, manoeuvres
from ms_highway.runtime.arrays import (
    Car,
    Controls,
    Flag,
    HumansControls,
    Index,
    State,
    Trajectories,
    for_rows,
)


@dataclass(frozen=True)
class RestartSettings:
    """Set when a plan starts from a simple manoeuvre instead of the usual start."""

    margin: float = 5.0
    """Reward by which a manoeuvre has to be better than the usual start, so that small
    gains do not change plans.
    """
    accelerations: tuple[float, ...] = (
        -CAR_LIMITS.braking,
        -5.0,
        -2.5,
        0.0,
        2.0,
        CAR_LIMITS.acceleration,
    )
    """Accelerations of the manoeuvres, each into each lane [m/s^2]."""


RESTART = RestartSettings()


class Plan(NamedTuple):
    """The robot's controls, and the controls that the plan expects of every human.

    Inside the package, they are scaled: divided by ``game.planner.control_scale``. Only
    `ms_highway.planning.compiled_plans.plan`, for users, returns them in SI units:
    curvatures [1/m], or yaw rates [rad/s] under ``steering="yaw_rate"`` of
    `ms_highway.game.dynamics.Dynamics`, and accelerations before friction [m/s^2].
    """

    robot: Controls
    humans: HumansControls

    def later(self) -> "Plan":
        """Return the rest of the plan a step later; its last controls are repeated."""
        xp = self.robot.__array_namespace__()  # of NumPy or JAX
        last_of_robot = self.robot[-1:]
        robot = xp.concat([self.robot[1:], last_of_robot])
        last_of_humans = self.humans[:, -1:]
        humans = xp.concat([self.humans[:, 1:], last_of_humans], axis=1)
        return Plan(robot, humans)


class Solution(NamedTuple):
    """A plan, and how its ascent ended.

    Attributes:
        plan: scaled.
        steps: number of steps of the ascent that led to it.
        converged: whether the last of them hardly moved the plan.
    """

    plan: Plan
    steps: Index
    converged: Flag


def cold_start(game: Game, state: State) -> Plan:
    """Return the plan from which planning starts without a last plan.

    All controls are zero, the paper's start. Under a smooth reward, the controls keep
    the velocity instead.
    """
    cars = 1 + game.number
    if game.planner.solver.smooth:
        controls = constant_velocity(game, state[:cars])
    else:
        controls = np.zeros((cars, game.planner.horizon, 2), np.float32)
    return Plan(controls[0], controls[1:])


def plan_objective(game: Game, car: Car, others: Trajectories) -> Objective:
    """Return what car 0 of a game maximises over its controls.

    Args:
        game: of the car, which may be a human after `ms_highway.game.game.swap_roles`.
        car: its state now.
        others: trajectories of all others.
    """
    payoff = game.payoff
    return Objective(
        path=partial(move, game, car),
        reward=lambda own: payoff.total(own, others),
        cost=partial(discomfort, game, car),
        bounded=partial(bounded, game, car),
        slope=lambda own: payoff.slopes(own, others)[0],
        curvature=lambda own: payoff.curvature(own, others),
        jacobian=partial(move_jacobian, game, car),
    )


def best_start(game: Game, car: Car, usual: Controls, others: Trajectories) -> Controls:
    """Return the controls to start from: the usual ones, or a much better manoeuvre.

    This is a multi-start, as the steps of a solver do not leave a local optimum. There
    is a manoeuvre per gap, and one per lane and acceleration, see
    `ms_highway.planning.manoeuvres`; one has to earn the margin of `RestartSettings`
    more than the usual controls. Only solvers with a warm start (``continues``) and a
    smooth reward try manoeuvres.

    Args:
        game: of the robot.
        car: its state now.
        usual: scaled controls to start from otherwise, such as the rest of the last
            plan.
        others: trajectories of all others.

    Returns:
        Scaled controls; NaN where nothing earns a finite reward.
    """
    solver = game.planner.solver
    if not (solver.continues and solver.smooth):
        return usual
    into_lanes = manoeuvres(game, car, game.planner.horizon, RESTART.accelerations)
    fields = jnp.moveaxis(others, 1, 0)  # [fields, others, steps]
    gaps = into_gaps(game, car, Motion(*fields))

    # All candidates, the usual start first: their controls, and their trajectories.
    objective = plan_objective(game, car, others)
    controls = jnp.concatenate([into_lanes.controls, gaps.controls])
    states = jnp.concatenate([into_lanes.states, gaps.states])
    controls = jnp.concatenate([usual[None], controls])
    paths = jnp.stack(observe(states), axis=1)  # [candidates, fields, steps]
    usual_path = objective.path(usual)
    paths = jnp.concatenate([usual_path[None], paths])

    # The best of them, with an advantage for the usual start.
    earned_by_each = jax.vmap(objective.earned)
    earned = jnp.asarray(earned_by_each(controls, paths))
    with_advantage = earned.at[0].add(RESTART.margin)
    return best_of(controls, with_advantage)


def within_limits(game: Game, state: State, plan: Plan) -> Plan:
    """Limit all controls of a plan, see `ms_highway.game.game.bounded`."""
    states_of_humans = state[1 : 1 + game.number]
    humans = for_rows(partial(bounded, game), states_of_humans, plan.humans)
    robot = bounded(game, state[0], plan.robot)
    return Plan(robot, humans)
