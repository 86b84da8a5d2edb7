"""Follow a plan; where it is not finite or late, the rest of what was followed before, or braking in lane."""

from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import Game
from ms_highway.planning.plans import Plan, one_step_later
from ms_highway.planning.way_out import Escape
from ms_highway.runtime.arrays import Car, Flag, Index, Rungs, SameArray

Status: TypeAlias = Literal["planned", "previous plan", "braking", "late", "way out"]
"""Source of a control: this step's plan; where that is not finite, the rest of the last finite plan; where nothing is
left of it, braking in lane. Where the plan is late for its step, ``late``: again the rest of the last plan, or braking.
``way out``: the first control of an escape from cars that keep their velocity, instead of a planned one that leaves no
such escape; what is left of the escape is then the rest of the last plan."""

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


class Rest(NamedTuple):
    """What is left of a plan.

    Attributes:
        plan: scaled, from this step on; beyond its end, its last controls are repeated.
        steps: number of its controls that are left, this step's included; 0 without a plan: the robot brakes.
        rungs: of every human, that it was made with.
        start: what the next plan may start from: this plan or, where it is of an escape, the one that was replaced.
    """

    plan: Plan
    steps: Index
    rungs: Rungs
    start: Plan


class Followed(NamedTuple):
    """What drives in a step.

    Attributes:
        now: what is followed: its first control is executed. Where the robot brakes, its rungs are those of the step's
            own plan.
        kept: what the next plan may start from, and what is followed where that fails or is late: `now` or a late plan,
            whose first control counts as executed.
        status: number of the status, in `STATUSES`.
    """

    now: Rest
    kept: Rest
    status: Index


def no_rest(horizon: int, humans: int) -> Rest:
    """Return what is left before the first plan."""
    still = np.zeros((1 + humans, horizon, 2), np.float32)
    nothing = Plan(still[0], still[1:])
    return Rest(nothing, np.int32(0), np.zeros(humans, np.int32), nothing)


def follow(plan: Plan, rungs: Rungs, before: Rest, late: bool = False) -> Followed:
    """Choose which plan drives in a step; where none is left, `or_brake` brakes.

    Args:
        plan: of this step, scaled.
        rungs: that it was made with.
        before: what the last step kept.
        late: whether the plan is too late for this step; if it is finite, it is kept for the next one.
    """
    xp, left, begin = plan.robot.__array_namespace__(), one_step_later(before.plan), one_step_later(before.start)
    finite = xp.isfinite(plan.robot).all() & xp.isfinite(plan.humans).all()

    def choose(follows: Flag) -> tuple[Index, Rest]:
        status, steps = fallback_status(follows, before.steps, len(plan.robot))
        chosen, start = (jax.tree.map(partial(xp.where, follows), plan, old) for old in (left, begin))
        own = xp.where(follows | (steps == 0), rungs, before.rungs)
        return status, Rest(chosen, steps, own, start)

    status, kept = choose(finite)
    if not late:
        return Followed(kept, kept, status)
    return Followed(choose(finite & False)[1], kept, LATE if finite else status)


def or_brake(game: Game, car: Car, followed: Followed) -> Followed:
    """Let a car brake in its lane where no plan is left to follow."""
    now, braking = followed.now, braking_control(game, car) / game.planner.control_scale
    robot = braking.__array_namespace__().where(now.steps == 0, braking, now.plan.robot)
    return followed._replace(now=now._replace(plan=now.plan._replace(robot=robot)))


def follow_escape(followed: Followed, escape: Escape) -> Followed:
    """Return what drives once a way out was looked for: an escape that replaces a control is followed, and kept.

    Late and failed plans keep their status, and plans their rungs, although an escape counts on nobody.
    """
    xp, (now, kept, status) = escape.controls.__array_namespace__(), followed
    own = Rest(now.plan._replace(robot=escape.controls), len(escape.controls), now.rungs, kept.start)
    now, kept = (jax.tree.map(partial(xp.where, escape.replaces), own, rest) for rest in (now, kept))
    return Followed(now, kept, xp.where(escape.replaces & (status == PLANNED), WAY_OUT, status))


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
