"""One step of a robot among humans: live, in a batch, or on a road of highway-env.

In a `step`, the robot

1. observes what the last step has shown, and chooses a model of each human;
2. plans with these models;
3. follows this plan or, if it fails or is late, the rest of the last one; where nothing
   is left of that, it brakes. A plan fails if it is not finite, for example where the
   response of a human is singular;
4. escapes, if an escape is better than every way out after the control;
5. remembers what the next step needs, a `Carry`.

How it chooses, plans, brakes and escapes is given by `Parts`. Live, these are compiled
and timed (`ms_highway.loop.driver`); in a batch, JAX traces them
(`ms_highway.loop.batch`); on highway-env's own roads, the stock roads, the robot plans
among proposals (`ms_highway.road.driver`).

Everything here works for arrays of NumPy and of JAX, see `branch`.
"""

from collections.abc import Callable
from functools import partial
from typing import (
    Generic,
    Literal,
    NamedTuple,
    Protocol,
    Self,
    TypeAlias,
    TypeVar,
    get_args,
)

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.choice.belief import equal_probabilities
from ms_highway.choice.records import Cars
from ms_highway.choice.rule import (
    Decision,
    GameEvidence,
    Memory,
    Outcome,
    Rule,
    first_memory,
)
from ms_highway.game.game import Game
from ms_highway.planning.plans import Plan
from ms_highway.planning.way_out import Escape
from ms_highway.runtime.arrays import (
    Control,
    Flag,
    Index,
    ModelProbabilities,
    Rungs,
    State,
)

Status: TypeAlias = Literal["planned", "previous plan", "braking", "late", "way out"]
"""Source of a control:

* ``planned``: this step's plan;
* ``previous plan``: the rest of the last finite plan, as this one is not finite;
* ``braking``: in lane, as nothing is left of that plan either;
* ``late``: the rest of the last plan or braking, as this plan is late;
* ``way out``: an escape instead of a planned control, as it is better than every way
  out after this control, see `ms_highway.planning.way_out`.

An escape may also replace a control of another source, whose status then stays.
"""

STATUSES: tuple[Status, ...] = get_args(Status)
"""All statuses; records hold their indices."""


def status_number(status: Status) -> int:
    """Return the index of a status in `STATUSES`."""
    return STATUSES.index(status)


# What robots carry from step to step, and what happens in a step


class Continuable(Protocol):
    """A warm start: the plan from which the search for the next plan may begin."""

    def later(self) -> Self:
        """Return the plan from the next step on, without its first control."""


WarmStart = TypeVar("WarmStart", bound=Continuable)
"""Initial guess of the next plan: a `Plan` in games, a proposal on stock roads."""

Observation = TypeVar("Observation")
"""What the choice of models on a stock road was based on; None in games."""

Details = TypeVar("Details")
"""What the record of a step on a stock road holds of its plan; None in games."""


class RemainingPlan(NamedTuple, Generic[WarmStart]):
    """A plan, and how many of its controls are left from some step on.

    Attributes:
        plan: scaled controls; beyond its end, the last ones are repeated.
        controls_left: number of its controls that are left, this step's included; with
            0, the robot brakes.
        rungs: rung of each human's model in this plan.
        warm_start: initial guess of the next plan. It is not this plan where the robot
            escapes or brakes, as that would be a poor guess.
    """

    plan: Plan
    controls_left: Index
    rungs: Rungs
    warm_start: WarmStart

    def later(self) -> "RemainingPlan[WarmStart]":
        """Return what is left from the next step on."""
        return RemainingPlan(
            controls_left=self.controls_left - (self.controls_left > 0),
            plan=self.plan.later(),
            rungs=self.rungs,
            warm_start=self.warm_start.later(),
        )


class Carry(NamedTuple, Generic[Cars, WarmStart]):
    """What a robot carries from step to step.

    Attributes:
        memory: what its rule remembers.
        outcome: this step, as far as it is known when the control is chosen: its cars
            before, its control and its plan. In games, the next step's `Parts.choose`
            fills in the rest, the cars after it, the humans' controls and the reward,
            in a copy of its own. Before the first step, no car has moved.
        model_probabilities: probability that each of the package's models predicts each
            human, see `ms_highway.choice.belief`; None on stock roads.
        fallback: plan for the next step if its own fails or is late. It is not shifted
            yet: its first control belongs to the step just done.
    """

    memory: Memory
    outcome: Outcome[Cars]
    model_probabilities: ModelProbabilities | None
    fallback: RemainingPlan[WarmStart]


class Choice(NamedTuple, Generic[Observation]):
    """The models of the coming plan.

    Attributes:
        model_probabilities: see `Carry`, after the last step.
        decision: what the rule or a schedule chose.
        rungs: rung of each human's model in the coming plan: the chosen one, except for
            humans who do not respond.
        observation: what the choice was based on, for the planner of a stock road.
    """

    model_probabilities: ModelProbabilities | None
    decision: Decision
    rungs: Rungs
    observation: Observation


class NewPlan(NamedTuple, Generic[WarmStart, Details]):
    """The plan of this step, and how its ascent ended.

    Attributes:
        plan: scaled controls; it fails if they are not finite.
        warm_start: initial guess of the next plan, if this one is followed.
        iterations: number of iterations of the ascent; 0 if there was none.
        converged: whether the last of them hardly moved the plan.
        details: what else the record of the step holds.
    """

    plan: Plan
    warm_start: WarmStart
    iterations: Index
    converged: Flag
    details: Details


class StepResult(NamedTuple, Generic[WarmStart, Observation, Details]):
    """The plan that is executed in a step, and where it comes from.

    Attributes:
        executed: plan whose first control is executed. If the robot brakes, the rungs
            are those of the step's own plan.
        status: index of its status in `STATUSES`.
        choice: models of the step's own plan.
        new_plan: the step's own plan, whether it is executed or not.
    """

    executed: RemainingPlan[WarmStart]
    status: Index
    choice: Choice[Observation]
    new_plan: NewPlan[WarmStart, Details]


Brake: TypeAlias = Callable[[RemainingPlan[WarmStart], Cars], RemainingPlan[WarmStart]]
"""Put braking in place of the robot's controls in what is left of a plan."""


class Parts(NamedTuple, Generic[Cars, WarmStart, Observation, Details]):
    """What differs between live steps, batches and stock roads.

    Attributes:
        choose: looks at the last step, and chooses the models from what the robot
            carries and the cars now.
        plan: plans among the cars now, with a choice, perhaps from the fallback's warm
            start.
        brake: brakes, where nothing is left of the last plan.
        is_late: whether the plan, which was just made, is too late for this step; it
            reads the clock. None if no plan ever is late.
        escape: searches for an escape that is better than every way out after a
            control, given the cars now; None without such a search.
    """

    choose: Callable[[Carry[Cars, WarmStart], Cars], Choice[Observation]]
    plan: Callable[
        [Cars, Choice[Observation], RemainingPlan[WarmStart]],
        NewPlan[WarmStart, Details],
    ]
    brake: Brake[WarmStart, Cars]
    is_late: Callable[[], bool] | None = None
    escape: Callable[[Cars, Control], Escape] | None = None


# These types in games: cars are a state, plans start from plans, and nothing else is
# needed for choices and records.
GameCarry: TypeAlias = Carry[State, Plan]
GameChoice: TypeAlias = Choice[None]
GamePlan: TypeAlias = NewPlan[Plan, None]
GameParts: TypeAlias = Parts[State, Plan, None, None]
GameResult: TypeAlias = StepResult[Plan, None, None]


# The step


def step(
    carry: Carry[Cars, WarmStart],
    now: Cars,
    parts: Parts[Cars, WarmStart, Observation, Details],
) -> tuple[Carry[Cars, WarmStart], StepResult[WarmStart, Observation, Details]]:
    """Decide one step: choose a model of each human, plan, and return what to execute.

    It is a step of the paper's meta-MDP, whose action is the choice of the models
    (Sripathy et al. 2021, Sec. III). The caller executes the first control of the
    executed plan. A robot that cannot follow its plan falls back on the last one, then
    brakes. It escapes if that is better than every way out after the control.

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
    new_plan = parts.plan(now, choice, carry.fallback)
    late = parts.is_late is not None and parts.is_late()

    # Follow the plan. If it is not finite or late, follow the last one; where that has
    # ended, brake.
    executed, fallback, status = follow(
        new_plan, choice.rungs, carry.fallback, now, parts.brake, late
    )

    # If an escape is better than every way out after the control, escape.
    if parts.escape is not None:
        escape = parts.escape(now, executed.plan.robot[0])
        executed, fallback, status = follow_escape(executed, fallback, status, escape)

    # Remember the rungs of the executed plan. The gain of a chosen rung says nothing of
    # another one that is used instead.
    decided = choice.decision.memory
    gain = decided.gain * (executed.rungs == decided.rungs)
    memory = Memory(executed.rungs, carry.memory.step + 1, decided.last_check, gain)

    # Remember what was done. Its consequences show in the next step, whose choice
    # completes the outcome; until then, what is after the step holds its place.
    control = executed.plan.robot[0]
    outcome = carry.outcome._replace(
        before=now, after=now, robot=control, plan=executed.plan
    )

    next_carry = Carry(memory, outcome, choice.model_probabilities, fallback)
    return next_carry, StepResult(executed, status, choice, new_plan)


Result = TypeVar("Result")


def branch(
    flag: Flag | bool,
    then: Callable[[], Result],
    otherwise: Callable[[], Result],
) -> Result:
    """Return one of two results; for a flag of JAX, select each of their numbers.

    With a flag of JAX, both results are computed; with any other flag, only the one
    that is returned.
    """
    if isinstance(flag, jax.Array):
        select = partial(jnp.where, flag)
        return jax.tree.map(select, then(), otherwise())
    return then() if flag else otherwise()


# Before the first step


def begin(rule: Rule[GameEvidence], game: Game, state: State) -> GameCarry:
    """Return what a robot carries into its first step."""
    none = no_plan(game.planner.horizon, game.number)
    outcome = Outcome(
        before=state,
        after=state,
        robot=none.plan.robot[0],
        humans=none.plan.humans[:, 0],
        reward=np.float32(0),
        plan=none.plan,
    )
    memory = first_memory(rule, game.number)
    return Carry(memory, outcome, equal_probabilities(game.number), none)


def no_plan(horizon: int, humans: int) -> RemainingPlan[Plan]:
    """Return the remaining plan before the first step: it has no controls."""
    zeros = np.zeros((1 + humans, horizon, 2), np.float32)
    nothing = Plan(zeros[0], zeros[1:])
    first_rungs = np.zeros(humans, np.int32)
    return RemainingPlan(nothing, np.int32(0), first_rungs, nothing)


# Following a plan, or what takes its place


def follow(
    new_plan: NewPlan[WarmStart, Details],
    rungs: Rungs,
    last: RemainingPlan[WarmStart],
    now: Cars,
    brake: Brake[WarmStart, Cars],
    late: bool = False,
) -> tuple[RemainingPlan[WarmStart], RemainingPlan[WarmStart], Index]:
    """Follow a plan or, if it is late or not finite, the last one, or brake.

    ==========  ================  =================  ======================
    plan        executed          next fallback      status
    ==========  ================  =================  ======================
    in time     it                it                 planned
    late        last or braking   it                 late
    not finite  last or braking   last or braking    previous plan, braking
    ==========  ================  =================  ======================

    Args:
        new_plan: plan of this step.
        rungs: rung of each human's model in it.
        last: plan to fall back on in this step.
        now: all cars.
        brake: see `Parts`; it brakes where nothing is left of the last plan.
        late: whether the plan is too late for this step.

    Returns:
        The executed plan, the plan to fall back on in the next step unless an escape
        replaces it, and the index of the status.
    """
    plan = new_plan.plan
    xp = plan.robot.__array_namespace__()  # of NumPy or JAX
    finite = xp.isfinite(plan.robot).all() & xp.isfinite(plan.humans).all()

    def follow_new() -> tuple[RemainingPlan[WarmStart], Index]:
        whole = RemainingPlan(plan, len(plan.robot), rungs, new_plan.warm_start)
        return whole, status_number("planned")

    def follow_last() -> tuple[RemainingPlan[WarmStart], Index]:
        return fall_back(last, rungs, now, brake)

    # A plan in time is executed now, and is what the next step falls back on.
    best, status = branch(finite, follow_new, follow_last)
    if not late:
        return best, best, status

    # A late one is only what the next step falls back on.
    executed, last_status = follow_last()
    status = branch(finite, lambda: status_number("late"), lambda: last_status)
    return executed, best, status


def fall_back(
    last: RemainingPlan[WarmStart],
    rungs: Rungs,
    now: Cars,
    brake: Brake[WarmStart, Cars],
) -> tuple[RemainingPlan[WarmStart], Index]:
    """Go on with the last plan, or brake where nothing is left of it.

    When the robot brakes, records show the models of the step's own plan, ``rungs``.

    Returns:
        The executed plan, and the index of its status, see `follow`.
    """
    rest = last.later()
    stopping = rest._replace(rungs=rungs)
    return branch(
        rest.controls_left > 0,
        lambda: (rest, status_number("previous plan")),
        lambda: (brake(stopping, now), status_number("braking")),
    )


def follow_escape(
    planned: RemainingPlan[WarmStart],
    fallback: RemainingPlan[WarmStart],
    status: Index,
    escape: Escape,
) -> tuple[RemainingPlan[WarmStart], RemainingPlan[WarmStart], Index]:
    """Follow an escape, and fall back on it, if it replaces the control.

    A late plan is then given up, except as a warm start. The status stays where the
    step's own plan was late or failed, so that only escapes from plans in time have a
    status of their own. The rungs remain those of the plan, although an escape relies
    on nobody.

    Returns:
        The same as `follow`.
    """
    plan = planned.plan._replace(robot=escape.controls)
    controls_left = len(escape.controls)
    warm_start = fallback.warm_start
    escaping = RemainingPlan(plan, controls_left, planned.rungs, warm_start)

    # The status changes only where the step's own plan would have been executed.
    renamed = escape.replaces & (status == status_number("planned"))
    status = branch(renamed, lambda: status_number("way out"), lambda: status)

    executed, fallback = branch(
        escape.replaces, lambda: (escaping, escaping), lambda: (planned, fallback)
    )
    return executed, fallback, status
