"""One step of a robot among humans, live or in a batch: look at the last step, choose models, plan, follow the plan.

Pure functions over what the robot carries from step to step; `ms_highway.planning.compiled_plans.plan_for` makes the
plan. `follow` follows it or, where it is late or not finite, the rest of the last plan or braking in lane.
"""

from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.choice.belief import counted_on, first_belief, infer
from ms_highway.choice.rule import Decision, Memory, Outcome, Rule, first_memory, in_ladder, is_of_package
from ms_highway.choice.rule import decide as chosen_by
from ms_highway.game.dynamics import keep_velocity, recover_control
from ms_highway.game.features import reward
from ms_highway.game.game import Game
from ms_highway.planning.human_models import HumanModel
from ms_highway.planning.plans import Plan, one_step_later
from ms_highway.planning.way_out import Escape
from ms_highway.runtime.arrays import Belief, Car, Flag, Index, Rungs, SameArray, State

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


class Carry(NamedTuple):
    """What a robot carries from step to step.

    Attributes:
        memory: of its rule.
        outcome: of the last step; before the first one, of a step in which no car moved.
        belief: probability that each of the package's models predicts each human.
    """

    memory: Memory
    outcome: Outcome
    belief: Belief


def begin(rule: Rule, game: Game, state: State) -> Carry:
    """Return what a robot carries into its first step."""
    still = np.zeros((1 + game.number, game.planner.horizon, 2), np.float32)
    outcome = Outcome(state, state, still[0, 0], still[1:, 0], np.float32(0), Plan(still[0], still[1:]))
    return Carry(first_memory(rule, game.number), outcome, first_belief(game.number))


def complete_outcome(game: Game, carry: Carry, now: State, infers: bool) -> Carry:
    """Complete the outcome of the last step: observed controls, the reward and, if wanted, the belief."""
    outcome, last = carry.outcome, 1 + game.number
    controls = recover_control(game.world, outcome.before[1:last], now[1:last]) / game.planner.control_scale
    outcome = outcome._replace(after=now, humans=controls, reward=reward(game.scene, game.robot, now))
    belief = carry.belief
    if infers:
        moved = jnp.any(outcome.before != now)  # before the first step, nothing is seen of the humans
        belief = jnp.where(moved, infer(game, belief, outcome.before, now, outcome.plan.robot), belief)
    return carry._replace(outcome=outcome, belief=belief)


def responsive_rungs(ladder: tuple[HumanModel, ...], rungs: Rungs, belief: Belief, unresponsive: int | None) -> Rungs:
    """Predict unresponsive humans by the rung ``unresponsive`` instead of one that counts on a response.

    Args:
        ladder: human models.
        rungs: that were chosen.
        belief: see `Carry`.
        unresponsive: rung, or None to count on everybody's response.
    """
    if unresponsive is None:
        return rungs
    responds = jnp.array([model.responds for model in ladder])
    return jnp.where(responds[rungs] & ~counted_on(belief), unresponsive, rungs).astype(jnp.int32)


def decide(
    rule: Rule, game: Game, carry: Carry, now: State, unresponsive: int | None = None
) -> tuple[Belief, Decision]:
    """Choose the rungs of the coming step from the outcome of the last one, and return the belief with them.

    Args:
        rule: that chooses.
        game: as the robot believes it.
        carry: into the step.
        now: all cars.
        unresponsive: see `responsive_rungs`; None without a belief.
    """
    carry = complete_outcome(game, carry, now, unresponsive is not None)
    decision = chosen_by(rule, game, carry.memory, carry.outcome)
    chosen = decision.memory.rungs
    rungs = responsive_rungs(rule.ladder, chosen, carry.belief, unresponsive)
    if not is_of_package(rule):  # what is no rung is refused afterwards, not replaced
        rungs = jnp.where(in_ladder(rule, chosen), rungs, chosen)
    return carry.belief, decision._replace(memory=decision.memory._replace(rungs=rungs))


def continues_plan(ladder: tuple[HumanModel, ...], game: Game, rungs: Rungs, rest: Rest) -> bool:
    """Return whether the coming plan starts from the rest of the last one, as the planner or a rung wants."""
    warm = np.array([model.warm for model in ladder])
    wanted = game.planner.solver.continues or bool(warm.all())
    if not wanted and warm.any():
        wanted = rungs.__array_namespace__().asarray(warm)[rungs].any()
    return wanted & (rest.steps > 0)


# Following a plan, or what takes its place


def fallback_status(finite: bool | Flag, left: Index, horizon: int) -> tuple[Any, Any]:
    """Return the number of this step's status, and how many controls are then left, this one included.

    Args:
        finite: whether this step's plan is finite.
        left: number of controls left of the last finite plan, the executed one included; 0 without a plan.
        horizon: number of controls of a plan.
    """
    goes_on, failed = left > 1, 1 - finite  # arithmetic, which is the same for numbers and for arrays of JAX
    return failed * (BRAKING - goes_on * (BRAKING - PREVIOUS_PLAN)), finite * horizon + failed * goes_on * (left - 1)


def no_rest(horizon: int, humans: int) -> Rest:
    """Return the `Rest` before the first plan: no control is left."""
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
    xp, left, later_start = plan.robot.__array_namespace__(), one_step_later(before.plan), one_step_later(before.start)
    finite = xp.isfinite(plan.robot).all() & xp.isfinite(plan.humans).all()

    def choose(follows: Flag) -> tuple[Index, Rest]:
        status, steps = fallback_status(follows, before.steps, len(plan.robot))
        chosen, start = (jax.tree.map(partial(xp.where, follows), plan, old) for old in (left, later_start))
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


def advance(carry: Carry, decision: Decision, followed: Followed, state: State) -> Carry:
    """Return what is carried into the next step; there, `complete_outcome` completes the outcome of this one.

    Args:
        carry: into this step.
        decision: of this step.
        followed: what drives in this step.
        state: all cars before this step.
    """
    driven = followed.now
    memory = decision.memory._replace(rungs=driven.rungs, step=carry.memory.step + 1)
    outcome = carry.outcome._replace(before=state, after=state, robot=driven.plan.robot[0], plan=driven.plan)
    return carry._replace(memory=memory, outcome=outcome)
