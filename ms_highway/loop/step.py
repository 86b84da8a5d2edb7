"""One step of a robot among humans: live, in a batch, or on a stock road.

`step` is a function of what the robot carries from step to step. Whatever differs
between live steps, batches and stock roads is in its `Parts`: live, they are compiled
and timed; in a batch, JAX traces them; on a stock road, the robot chooses and plans
among proposals.

Everything here works for numbers of NumPy and of JAX, see `branch`.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.choice.belief import counted_on, first_belief, infer
from ms_highway.choice.rule import Decision, Memory, Outcome, Rule, first_memory
from ms_highway.game.dynamics import keep_velocity, recover_control
from ms_highway.game.features import reward
from ms_highway.game.game import Game
from ms_highway.planning.human_models import HumanModel
from ms_highway.planning.plans import Plan, cold_start
from ms_highway.planning.way_out import Escape
from ms_highway.runtime.arrays import (
    Belief,
    Control,
    Flag,
    Index,
    Rungs,
    SameArray,
    State,
)

Status: TypeAlias = Literal["planned", "previous plan", "braking", "late", "way out"]
"""Source of a control: ``planned``, this step's plan; ``previous plan``, the rest of
the last finite plan, if this one is not finite; ``braking`` in lane, if nothing is left
of that plan; ``late``, the rest of the last plan or braking, if this plan is late;
``way out``, an escape from cars that keep their velocity, if the planned control leaves
no such escape. The rest of an escape is then the rest of the last plan.
"""

STATUSES: tuple[Status, ...] = get_args(Status)
"""All statuses, in the order of their numbers."""

PLANNED, PREVIOUS_PLAN, BRAKING, LATE, WAY_OUT = range(5)
DECELERATION = 8.0  # m/s^2, hard braking on a dry road
STRAIGHTENING_TIME = 0.5  # s, in which a braking car aligns with the road


class RemainingPlan(NamedTuple):
    """A plan from some step on.

    Attributes:
        plan: scaled; beyond its end, its last controls are repeated.
        steps: number of its controls that are left, this step's included; with 0, the
            robot brakes.
        rungs: of every human in this plan.
        warm_start: where the next plan may start: this plan or, if it is an escape, the
            one that it replaced.
    """

    plan: Plan
    steps: Index
    rungs: Rungs
    warm_start: Any

    def later(self) -> "RemainingPlan":
        """Return the plan from the next step on."""
        steps = self.steps - (self.steps > 0)
        return RemainingPlan(
            self.plan.later(), steps, self.rungs, self.warm_start.later()
        )


class Carry(NamedTuple):
    """What a robot carries from step to step.

    Attributes:
        memory: of its rule.
        outcome: of the last step; before the first one, of a step in which no car
            moved.
        belief: probability that each of the package's models predicts each human.
        fallback: plan to fall back on in the next step, its first control counted as
            executed.
    """

    memory: Memory
    outcome: Outcome
    belief: Belief | None
    fallback: RemainingPlan


class Choice(NamedTuple):
    """The models of the coming plan.

    Attributes:
        belief: after the last step.
        decision: what the rule or a schedule chose.
        rungs: of every human in the coming plan; other than chosen for humans who do
            not respond.
        evidence: what was looked at, if the plan needs it.
    """

    belief: Belief | None
    decision: Decision
    rungs: Rungs
    evidence: Any = None


class NewPlan(NamedTuple):
    """The plan of this step, and how its ascent ended.

    Attributes:
        plan: scaled; it fails if it is not finite.
        warm_start: where the next plan may start, if this one is followed.
        steps: number of steps of the ascent; 0 if there was none.
        converged: whether the last of them hardly moved the plan.
        details: what else belongs into the record of the step.
    """

    plan: Plan
    warm_start: Any
    steps: Index = 0
    converged: Flag = False
    details: Any = None


class StepResult(NamedTuple):
    """What drives in a step, and where it comes from.

    Attributes:
        driven: what drives; its first control is executed. If the robot brakes, the
            rungs are those of the step's own plan.
        status: place of the status in `STATUSES`.
        choice: the models of the step's own plan.
        planned: that plan, whether it drives or not.
    """

    driven: RemainingPlan
    status: Index
    choice: Choice
    planned: NewPlan


class Parts(NamedTuple):
    """What differs between live steps, batches and stock roads.

    Attributes:
        choose: looks at the last step, and chooses the models from what the robot
            carries and the cars now.
        plan: plans among the cars now, with a choice, perhaps starting from the plan to
            fall back on.
        brake: returns what is left of a plan with braking in place of its controls,
            given the cars now.
        is_late: whether the plan, which was just made, is too late for this step; None
            if no plan ever is.
        escape: returns the control to execute now instead of a planned one, if that
            leaves no way out; None without such a search.
    """

    choose: Callable[[Carry, Any], Choice]
    plan: Callable[[Any, Choice, RemainingPlan], NewPlan]
    brake: Callable[[RemainingPlan, Any], RemainingPlan]
    is_late: Callable[[], bool] | None = None
    escape: Callable[[Any, Control], Escape] | None = None


def step(carry: Carry, now: Any, parts: Parts) -> tuple[Carry, StepResult]:
    """Drive one step: choose a model of each human by what the last step showed, plan,
    and execute the first control.

    A step of the paper's meta-MDP, whose action is the choice of the models (Sec. III).
    A robot that cannot follow its plan falls back on the last one, then brakes; one
    that would have no way out escapes.

    Args:
        carry: what the robot carries into the step.
        now: all cars; on a stock road, the scene.
        parts: what differs between live steps, batches and stock roads.

    Returns:
        What the robot carries into the next step, and what happened in this one.
    """
    # Look at what the last step has shown, and choose a model of each human.
    choice = parts.choose(carry, now)

    # Plan with these models.
    planned = parts.plan(now, choice, carry.fallback)
    late = parts.is_late is not None and parts.is_late()

    # Follow the plan. If it is not finite or late, follow the last one; where that has
    # ended, brake.
    driven, fallback, status = follow(
        planned, choice.rungs, carry.fallback, now, parts.brake, late
    )

    # If the control leaves no way out among cars that keep their velocity, escape.
    if parts.escape is not None:
        escape = parts.escape(now, driven.plan.robot[0])
        driven, fallback, status = follow_escape(driven, fallback, status, escape)

    # Remember what was done; the next step looks at what comes of it.
    # The gain of a chosen rung says nothing of another one that drives instead.
    chosen = choice.decision.memory
    gain = chosen.gain * (driven.rungs == chosen.rungs)
    memory = Memory(driven.rungs, carry.memory.step + 1, chosen.last_check, gain)
    control = driven.plan.robot[0]
    outcome = carry.outcome._replace(
        before=now, after=now, robot=control, plan=driven.plan
    )
    return Carry(memory, outcome, choice.belief, fallback), StepResult(
        driven, status, choice, planned
    )


def branch(
    flag: Flag | bool, then: Callable[[], Any], otherwise: Callable[[], Any]
) -> Any:
    """Return one of two results; for a flag of JAX, compute both, and select each
    number.
    """
    if isinstance(flag, jax.Array):
        return jax.tree.map(lambda *both: jnp.where(flag, *both), then(), otherwise())
    return then() if flag else otherwise()


# Before the first step


def begin(rule: Rule, game: Game, state: State) -> Carry:
    """Return what a robot carries into its first step."""
    none = no_plan(game.planner.horizon, game.number)
    outcome = Outcome(
        state,
        state,
        none.plan.robot[0],
        none.plan.humans[:, 0],
        np.float32(0),
        none.plan,
    )
    return Carry(
        first_memory(rule, game.number), outcome, first_belief(game.number), none
    )


def no_plan(horizon: int, humans: int) -> RemainingPlan:
    """Return the remaining plan before the first step: it has no controls."""
    still = np.zeros((1 + humans, horizon, 2), np.float32)
    nothing = Plan(still[0], still[1:])
    return RemainingPlan(nothing, np.int32(0), np.zeros(humans, np.int32), nothing)


# Choosing the models


def choose(
    game: Game,
    models: tuple[HumanModel, ...],
    unresponsive: int | None,
    decide: Callable[[Memory, Outcome], Decision],
    carry: Carry,
    now: State,
) -> Choice:
    """Complete the outcome of the last step and the belief, and choose a model for each
    human.

    Args:
        game: as the robot believes it.
        models: which rungs name.
        unresponsive: rung that predicts humans who do not respond; None to count on
            everybody, without a belief.
        decide: chooses rungs by the outcome, see `ms_highway.choice.rule.decide`.
        carry: into the step.
        now: all cars.
    """
    # Observe the humans' controls, and what the step has earned.
    outcome = carry.outcome
    before = outcome.before
    players = slice(1, 1 + game.number)
    controls = (
        recover_control(game.world, before[players], now[players])
        / game.planner.control_scale
    )
    outcome = outcome._replace(
        after=now, humans=controls, reward=reward(game.scene, game.robot, now)
    )

    # Without a belief, count on what the rule chose.
    if unresponsive is None:
        decision = decide(carry.memory, outcome)
        return Choice(carry.belief, decision, decision.memory.rungs)

    # Infer which humans respond. Before the first step, nobody has moved.
    assert carry.belief is not None
    moved = jnp.any(before != now)
    belief = jnp.where(
        moved, infer(game, carry.belief, before, now, outcome.plan.robot), carry.belief
    )
    decision = decide(carry.memory, outcome)
    responds = jnp.array([model.responds for model in models])
    ignored = responds[decision.memory.rungs] & ~counted_on(belief)
    rungs = jnp.where(ignored, unresponsive, decision.memory.rungs).astype(jnp.int32)
    return Choice(belief, decision, rungs)


# Planning, and following a plan or what takes its place


def plan_start(
    models: tuple[HumanModel, ...],
    game: Game,
    state: State,
    rungs: Rungs,
    last: RemainingPlan,
) -> Plan | None:
    """Return the scaled plan from which the coming one starts.

    Humans continue the last plan if the planner or their model wants that; the robot
    does if any human does. All others start cold. It is None if no model ever
    continues.

    Args:
        models: that rungs name.
        game: of the robot.
        state: all cars now.
        rungs: of every human in the coming plan.
        last: the plan to fall back on.
    """
    warm = np.array([game.planner.solver.continues or model.warm for model in models])
    if not warm.any():
        return None
    cold = cold_start(game, state)
    rest = last.warm_start.later()
    xp = rungs.__array_namespace__()  # of NumPy or JAX
    continues = xp.asarray(warm)[rungs] & (last.steps > 0)
    robot = xp.where(continues.any(), rest.robot, cold.robot)
    humans = xp.where(continues[:, None, None], rest.humans, cold.humans)
    return Plan(robot, humans)


def follow(
    planned: NewPlan,
    rungs: Rungs,
    last: RemainingPlan,
    now: Any,
    brake: Callable[[RemainingPlan, Any], RemainingPlan],
    late: bool = False,
) -> tuple[RemainingPlan, RemainingPlan, Index]:
    """Follow a plan or, if it is late or not finite, the last one, and brake where
    nothing is left of that.

    Args:
        planned: of this step.
        rungs: of every human in it.
        last: plan to fall back on in this step.
        now: all cars.
        brake: see `Parts`.
        late: whether the plan is too late for this step; a finite one is followed from
            the next step on.

    Returns:
        What drives, the plan to fall back on in the next step, and the number of the
        status.
    """
    plan = planned.plan
    xp = plan.robot.__array_namespace__()
    finite = xp.isfinite(plan.robot).all() & xp.isfinite(plan.humans).all()

    def new() -> tuple[RemainingPlan, int]:
        return RemainingPlan(plan, len(plan.robot), rungs, planned.warm_start), PLANNED

    def old() -> tuple[RemainingPlan, Index]:
        return fall_back(last, rungs, now, brake)

    # A plan in time drives now, and is what the next step falls back on.
    fallback, status = branch(finite, new, old)
    if not late:
        return fallback, fallback, status

    # A late one has to wait for the next step.
    driven, failed = old()
    return driven, fallback, branch(finite, lambda: LATE, lambda: failed)


def fall_back(
    last: RemainingPlan,
    rungs: Rungs,
    now: Any,
    brake: Callable[[RemainingPlan, Any], RemainingPlan],
) -> tuple[RemainingPlan, Index]:
    """Go on with the last plan, or brake where nothing is left of it; return what
    drives and its status, see `follow`.

    Braking counts under the models of the step's own plan.
    """
    left = last.later()
    stopping = left._replace(rungs=rungs)
    return branch(
        left.steps > 0,
        lambda: (left, PREVIOUS_PLAN),
        lambda: (brake(stopping, now), BRAKING),
    )


def follow_escape(
    driven: RemainingPlan, fallback: RemainingPlan, status: Index, escape: Escape
) -> tuple[RemainingPlan, RemainingPlan, Index]:
    """Follow an escape, and fall back on it, if it replaces the control; return the
    same as `follow`.

    Late and failed plans keep their status. The rungs remain those of the plan,
    although an escape counts on nobody.
    """
    plan = driven.plan._replace(robot=escape.controls)
    own = RemainingPlan(plan, len(escape.controls), driven.rungs, fallback.warm_start)
    replaced = escape.replaces & (status == PLANNED)
    status = branch(replaced, lambda: WAY_OUT, lambda: status)
    return (
        *branch(escape.replaces, lambda: (own, own), lambda: (driven, fallback)),
        status,
    )


def brake(game: Game, left: RemainingPlan, now: State) -> RemainingPlan:
    """Return what is left of a plan, with braking in lane in place of the robot's
    controls.
    """
    robot = left.plan.robot
    xp = robot.__array_namespace__()
    with np.errstate(over="ignore", invalid="ignore"):
        braking = braking_control(game, now[0]) / game.planner.control_scale
    return left._replace(
        plan=left.plan._replace(robot=xp.broadcast_to(braking, robot.shape))
    )


def braking_control(game: Game, car: Float[SameArray, "4"]) -> Float[SameArray, "2"]:
    """Return the control that brakes and aligns a car with the road, within the limits
    of plans.

    It is finite in every finite state, even if friction or the acceleration that stops
    the car is not finite.
    """
    xp = car.__array_namespace__()
    heading = car[2]
    speed = car[3]

    # Turn towards the road's direction.
    turning = -xp.atan2(xp.sin(heading), xp.cos(heading)) / STRAIGHTENING_TIME
    curvature = turning / xp.maximum(xp.abs(speed), 1.0)
    omega = curvature if game.dynamics.steering == "curvature" else turning

    # Stop at the end of the step, or as soon as hard braking can.
    stop = keep_velocity(game.dynamics, car)[1] - speed / game.dynamics.time_step
    stop = xp.where(xp.isnan(stop), -xp.sign(speed) * DECELERATION, stop)
    stop = xp.clip(stop, -DECELERATION, DECELERATION)
    limit = xp.asarray(game.planner.control_limit)
    return xp.clip(xp.stack([omega, stop]), -limit, limit)
