"""Brake in lane: what a robot does when it has no plan left to follow.

Everything here works for arrays of NumPy and of JAX.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ms_highway.game.car_following import CAR_LIMITS
from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import Game
from ms_highway.loop.step import RemainingPlan
from ms_highway.planning.plans import Plan
from ms_highway.runtime.arrays import SameArray, State


@dataclass(frozen=True)
class BrakingSettings:
    """Set how a robot without a plan brakes."""

    deceleration: float = CAR_LIMITS.braking
    """Largest deceleration [m/s^2]: hard braking on a dry road."""

    straightening_time: float = 0.5
    """Time in which a braking car aligns with the road [s]."""


BRAKING = BrakingSettings()


def brake(game: Game, left: RemainingPlan[Plan], now: State) -> RemainingPlan[Plan]:
    """Return what is left of a plan, with braking in place of the robot's controls.

    Args:
        game: game of the robot.
        left: what is left of the plan, with the controls expected of the humans.
        now: all cars.
    """
    robot = left.plan.robot
    xp = robot.__array_namespace__()  # of NumPy or JAX
    with np.errstate(over="ignore", invalid="ignore"):
        braking = braking_control(game, now[0]) / game.planner.control_scale
    plan = left.plan._replace(robot=xp.broadcast_to(braking, robot.shape))
    return left._replace(plan=plan)


def braking_control(game: Game, car: Float[SameArray, "4"]) -> Float[SameArray, "2"]:
    """Return the control that brakes a car and aligns it with the road.

    It is within the limits of plans. It is finite in every finite state, even if
    friction or the acceleration that stops the car is not finite.
    """
    xp = car.__array_namespace__()
    heading = car[2]
    speed = car[3]

    # Turn towards the road's direction.
    angle = xp.atan2(xp.sin(heading), xp.cos(heading))
    yaw_rate = -angle / BRAKING.straightening_time
    if game.dynamics.steering == "curvature":
        omega = yaw_rate / xp.maximum(xp.abs(speed), 1.0)
    else:
        omega = yaw_rate

    # Stop at the end of the step, or as soon as hard braking can.
    hardest = BRAKING.deceleration
    coasting = keep_velocity(game.dynamics, car)[1]
    stop = coasting - speed / game.dynamics.time_step
    stop = xp.where(xp.isnan(stop), -xp.sign(speed) * hardest, stop)
    stop = xp.clip(stop, -hardest, hardest)

    limit = xp.asarray(game.planner.control_limit)
    control = xp.stack([omega, stop])
    return xp.clip(control, -limit, limit)
