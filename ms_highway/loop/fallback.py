"""Follow a plan or, where it is late or not finite, the rest of the last plan or braking in lane."""

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
"""Source of a control: ``planned``, this step's plan; ``previous plan``, the rest of the last finite plan, if this one
is not finite; ``braking`` in lane, if nothing is left of that plan; ``late``, the rest of the last plan or braking, if
this plan is late; ``way out``, an escape from cars that keep their velocity, if the planned control leaves no such
escape. The rest of an escape is then the rest of the last plan."""

STATUSES: tuple[Status, ...] = get_args(Status)
"""All statuses, in the order of their numbers."""

PLANNED, PREVIOUS_PLAN, BRAKING, LATE, WAY_OUT = range(5)
DECELERATION = 8.0  # m/s^2, hard braking on a dry road
STRAIGHTENING_TIME = 0.5  # s, in which a braking car aligns with the road


def fallback_status(finite: bool | Flag, left: Index, horizon: int) -> tuple[Any, Any]:
    """Return the number of this step's status, and how many controls are then left, this one included.

    Args:
        finite: whether this step's plan is finite.
        left: number of controls left of the last finite plan, the executed one included; 0 without a plan.
        horizon: number of controls of a plan.
    """
    goes_on, failed = left > 1, 1 - finite  # arithmetic, which is the same for numbers and for arrays of JAX
    return failed * (BRAKING - goes_on * (BRAKING - PREVIOUS_PLAN)), finite * horizon + failed * goes_on * (left - 1)


class Rest(NamedTuple):
    """What is left of a plan.

    Attributes:
        plan: scaled, from this step on; beyond its end, its last controls are repeated.
        steps: number of its controls that are left, this step's included; with 0, the robot brakes.
        rungs: of every human in this plan.
        start: plan from which the next one may start: this plan or, if it is an escape, the one that it replaced.
    """

    plan: Plan
    steps: Index
    rungs: Rungs
    start: Plan


class Followed(NamedTuple):
    """What drives in a step.

    Attributes:
        now: what is followed; its first control is executed. If the robot brakes, the rungs are those of the step's own
            plan.
        kept: start of the next plan, and what is followed if that plan fails or is late: `now`, or a late plan, whose
            first control counts as executed.
        status: place of the status in `STATUSES`.
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
    """Choose the plan that drives in a step; where none is left, `or_brake` brakes.

    Args:
        plan: of this step, scaled.
        rungs: of every human in it.
        before: what the last step kept.
        late: whether the plan is too late for this step; a finite one is kept for the next step.
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
    """Follow and keep an escape that replaces the control.

    Late and failed plans keep their status. The rungs remain those of the plan, although an escape counts on nobody.
    """
    xp, (now, kept, status) = escape.controls.__array_namespace__(), followed
    own = Rest(now.plan._replace(robot=escape.controls), len(escape.controls), now.rungs, kept.start)
    now, kept = (jax.tree.map(partial(xp.where, escape.replaces), own, rest) for rest in (now, kept))
    return Followed(now, kept, xp.where(escape.replaces & (status == PLANNED), WAY_OUT, status))


def braking_control(game: Game, car: Float[SameArray, "4"]) -> Float[SameArray, "2"]:
    """Return the control that brakes and aligns a car with the road, within the limits of plans.

    It is finite in every finite state, even if friction or the acceleration that stops the car is not finite.
    """
    xp = car.__array_namespace__()
    heading, speed = car[2], car[3]
    turning = -xp.atan2(xp.sin(heading), xp.cos(heading)) / STRAIGHTENING_TIME
    omega = turning / xp.maximum(xp.abs(speed), 1.0) if game.dynamics.steering == "curvature" else turning
    stop = keep_velocity(game.dynamics, car)[1] - speed / game.dynamics.time_step
    stop = xp.where(xp.isnan(stop), -xp.sign(speed) * DECELERATION, stop)
    limit = xp.asarray(game.planner.control_limit)
    return xp.clip(xp.stack([omega, xp.clip(stop, -DECELERATION, DECELERATION)]), -limit, limit)
