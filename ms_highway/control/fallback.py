"""Fall back where a plan is not finite: on the rest of the last finite plan, then on braking in lane."""

from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Float

from ms_highway.game.dynamics import keep_velocity, step
from ms_highway.game.game import Game
from ms_highway.runtime.arrays import Car, Controls, Flag, Index, SameArray

Status: TypeAlias = Literal["planned", "previous plan", "braking", "late", "way out"]
"""Source of a control: this step's plan; where that is not finite, the rest of the last finite plan; where nothing is
left of it, braking in lane. Where the plan is late for its step, ``late``: again the rest of the last plan, or braking.
``way out``: the first control of an escape from cars that keep their velocity, instead of a planned one that leaves no
such escape."""

STATUSES: tuple[Status, ...] = get_args(Status)
"""All statuses, in the order of their numbers."""

PLANNED, PREVIOUS_PLAN, BRAKING, LATE, WAY_OUT = range(5)
DECELERATION = 8.0  # m/s^2, hard braking on a dry road
STRAIGHTENING_TIME = 0.5  # s, in which a braking car aligns with the road


def fallback_status(finite: bool | Flag, left: Index, horizon: int) -> tuple[Any, Any]:
    """Return the number of this step's status, and the number of controls then left, this one included.

    Args:
        finite: whether this step's plan is.
        left: number of controls left of the last finite plan, the executed one included; 0 without a plan.
        horizon: number of controls of a plan.
    """
    goes_on, failed = left > 1, 1 - finite  # arithmetic, which is the same for numbers and for arrays of JAX
    return failed * (BRAKING - goes_on * (BRAKING - PREVIOUS_PLAN)), finite * horizon + failed * goes_on * (left - 1)


def braking_control(game: Game, car: Float[SameArray, "4"]) -> Float[SameArray, "2"]:
    """Return the control that brakes and aligns a car with the road, within the limits of plans.

    It is finite in every finite state, even where friction, or the acceleration that stops the car, is not.
    """
    xp = car.__array_namespace__()
    heading, speed = car[2], car[3]
    turning = -xp.atan2(xp.sin(heading), xp.cos(heading)) / STRAIGHTENING_TIME
    omega = turning / xp.maximum(xp.abs(speed), 1.0) if game.dynamics.steering == "curvature" else turning
    stop = keep_velocity(game.dynamics, car)[1] - speed / game.dynamics.time_step
    stop = xp.where(xp.isnan(stop), -xp.sign(speed) * DECELERATION, stop)
    limit = xp.asarray(game.planner.control_limit)
    return xp.clip(xp.stack([omega, xp.clip(stop, -DECELERATION, DECELERATION)]), -limit, limit)


def brake(game: Game, car: Car) -> Controls:
    """Return the controls that stop a car and align it with the road, within the limits of plans."""
    car, controls = np.asarray(car, dtype=float), []
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(game.planner.horizon):
            controls.append(braking_control(game, car))
            moved = step(game.dynamics, car, controls[-1])
            car = np.where(np.isfinite(moved), moved, car)
    return np.array(controls)
