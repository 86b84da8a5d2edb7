"""What drives when a plan is not finite: what is left of the last good plan, and then braking in lane."""

from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from ms_highway.game.dynamics import keep_velocity, step
from ms_highway.game.game import Game
from ms_highway.runtime.arrays import Array, SameArray

__all__ = ["BRAKING", "PLANNED", "PREVIOUS_PLAN", "STATUSES", "Status", "brake", "braking_control", "fallback_status"]

Status: TypeAlias = Literal["planned", "previous plan", "braking"]
"""How a control came about: from this step's plan; or, where that was not finite, from what is left of the last good
plan, and when nothing is left from braking in lane."""

STATUSES: tuple[Status, ...] = get_args(Status)
"""All, in the order of the numbers that stand for them."""

PLANNED, PREVIOUS_PLAN, BRAKING = range(3)
DECELERATION = 8.0  # m/s^2, hard braking on a dry road
STRAIGHTENING_TIME = 0.5  # s, in which a braking car turns back along the road


def fallback_status(finite: bool | Bool[Array, ""], left: int | Int[Array, ""], horizon: int) -> tuple[Any, Any]:
    """What is followed in this step: the number of its status, and how many controls are then left, this one included.

    Args:
        finite: whether this step's plan is.
        left: controls left of the last good plan, the one that was executed included; 0 without one.
        horizon: controls of a plan.
    """
    goes_on, failed = left > 1, 1 - finite  # arithmetic, which is the same for numbers and for arrays of JAX
    return failed * (BRAKING - goes_on * (BRAKING - PREVIOUS_PLAN)), finite * horizon + failed * goes_on * (left - 1)


def braking_control(game: Game, car: Float[SameArray, "4"]) -> Float[SameArray, "2"]:
    """The control with which a car goes on, or begins, to brake and to turn along the road, within a plan's limits.

    It is finite in every finite state, even where friction, or the acceleration that would stop the car, is not.
    """
    xp = car.__array_namespace__()
    heading, speed = car[2], car[3]
    turning = -xp.atan2(xp.sin(heading), xp.cos(heading)) / STRAIGHTENING_TIME
    omega = turning / xp.maximum(xp.abs(speed), 1.0) if game.dynamics.steering == "curvature" else turning
    stop = keep_velocity(game.dynamics, car)[1] - speed / game.dynamics.time_step
    stop = xp.where(xp.isnan(stop), -xp.sign(speed) * DECELERATION, stop)
    limit = xp.asarray(game.planner.control_limit)
    return xp.clip(xp.stack([omega, xp.clip(stop, -DECELERATION, DECELERATION)]), -limit, limit)


def brake(game: Game, car: Float[np.ndarray, "4"]) -> Float[np.ndarray, "steps 2"]:
    """Controls that bring a car to a stop and along the road, within the limits of the game's plans."""
    car, controls = np.asarray(car, dtype=float), []
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(game.planner.horizon):
            controls.append(braking_control(game, car))
            moved = step(game.dynamics, car, controls[-1])
            car = np.where(np.isfinite(moved), moved, car)
    return np.array(controls)
