"""Define plans and their solutions.

That is: where plans start from, what they maximise, and their limits.
"""

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
    """Set when a plan starts from a simple manoeuvre instead of the last plan."""

    margin: float = 5.0
    """Reward by which a manoeuvre has to be better than the last plan, so that small
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
    """The robot's controls and the controls that they expect of every human.

    Models and starts hold scaled controls; times ``game.planner.control_scale``, they
    are curvatures [1/m] and accelerations before friction [m/s^2], as
    `ms_highway.planning.compiled_plans.plan` returns them.
    """

    robot: Controls
    humans: HumansControls

    def later(self) -> "Plan":
        """Return the rest of the plan a step later; its last controls are repeated."""
        xp = self.robot.__array_namespace__()  # of NumPy or JAX
        robot = xp.concat([self.robot[1:], self.robot[-1:]])
        humans = xp.concat([self.humans[:, 1:], self.humans[:, -1:]], axis=1)
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

    All controls are zero, the paper's start; under a smooth reward, they keep the
    velocity.
    """
    cars = 1 + game.number
    if game.planner.solver.smooth:
        controls = constant_velocity(game, state[:cars])
    else:
        controls = np.zeros((cars, game.planner.horizon, 2), np.float32)
    return Plan(controls[0], controls[1:])


def driving(game: Game, car: Car, others: Trajectories) -> Objective:
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


def best_start(game: Game, car: Car, last: Controls, others: Trajectories) -> Controls:
    """Return the controls to start from: the last plan's, or a much better manoeuvre.

    A manoeuvre has to earn the margin of `RestartSettings` more. The steps of a solver
    do not leave a local optimum: so there is a manoeuvre per gap, and one per lane and
    acceleration, see `ms_highway.planning.manoeuvres`. Only plans that continue and
    climb a smooth reward start from manoeuvres.

    Args:
        game: of the robot.
        car: its state now.
        last: scaled controls of the last plan.
        others: trajectories of all others.

    Returns:
        Scaled controls; NaN where nothing earns a finite reward.
    """
    solver = game.planner.solver
    if not (solver.continues and solver.smooth):
        return last
    into_lanes = manoeuvres(game, car, game.planner.horizon, RESTART.accelerations)
    gaps = into_gaps(game, car, Motion(*jnp.moveaxis(others, 1, 0)))

    # All candidates, the last plan first.
    objective = driving(game, car, others)
    controls = jnp.concatenate([into_lanes.controls, gaps.controls])
    states = jnp.concatenate([into_lanes.states, gaps.states])
    controls = jnp.concatenate([last[None], controls])
    paths = jnp.stack(observe(states), axis=1)
    paths = jnp.concatenate([objective.path(last)[None], paths])

    # The best of them, with an advantage for the last plan.
    earned = jnp.asarray(jax.vmap(objective.earned)(controls, paths))
    return best_of(controls, earned.at[0].add(RESTART.margin))


def within_limits(game: Game, state: State, plan: Plan) -> Plan:
    """Limit all controls of a plan, see `ms_highway.game.game.bounded`."""
    humans = for_rows(partial(bounded, game), state[1 : 1 + game.number], plan.humans)
    return Plan(bounded(game, state[0], plan.robot), humans)
