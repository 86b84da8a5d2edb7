"""One step of a robot among humans: live, in a batch, or on a stock road.

In a `step`, the robot

1. observes what the last step has shown, and chooses a model of each human;
2. plans with these models;
3. follows this plan or, if it fails or is late, the rest of the last one; where nothing
   is left of that, it brakes;
4. escapes, if the control would leave it no way out;
5. remembers what the next step needs, a `Carry`.

How it chooses, plans, brakes and escapes is given by `Parts`. Live, these are compiled
and timed (`ms_highway.loop.driver`); in a batch, JAX traces them
(`ms_highway.loop.batch`); on a stock road, the robot plans among proposals
(`ms_highway.road.driver`).

Everything here works for numbers of NumPy and of JAX, see `branch`.
"""

from collections.abc import Callable
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
* ``way out``: an escape from cars that keep their velocity, as the planned control
  leaves none. The rest of an escape is then the rest of the last plan.
"""

STATUSES: tuple[Status, ...] = get_args(Status)
"""All statuses, in the order of their numbers."""


def status_number(status: Status) -> int:
    """Return the number of a status, its place in `STATUSES`."""
    return STATUSES.index(status)


# What robots carry from step to step, and what happens in a step


class Continuable(Protocol):
    """A plan from which another one may start a step later."""

    def later(self) -> Self:
        """Return the plan from the next step on."""


WarmStart = TypeVar("WarmStart", bound=Continuable)
"""Where the next plan may start: a `Plan` in games, a proposal on stock roads."""

Observation = TypeVar("Observation")
"""What a robot on a stock road looked at when it chose models; None in games."""

Details = TypeVar("Details")
"""What else the record of a step on a stock road needs of its plan; None in games."""


class RemainingPlan(NamedTuple, Generic[WarmStart]):
    """What is left of a plan from some step on.

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
    warm_start: WarmStart

    def later(self) -> "RemainingPlan[WarmStart]":
        """Return what is left from the next step on."""
        return RemainingPlan(
            steps=self.steps - (self.steps > 0),
            plan=self.plan.later(),
            rungs=self.rungs,
            warm_start=self.warm_start.later(),
        )


class Carry(NamedTuple, Generic[Cars, WarmStart]):
    """What a robot carries from step to step.

    Attributes:
        memory: of its rule.
        outcome: of the last step; before the first one, of a step in which no car
            moved.
        model_probabilities: probability that each of the package's models predicts each
            human, see `ms_highway.choice.belief`; None on stock roads.
        fallback: plan to fall back on in the next step, from this step on: its first
            control will be over by then.
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
        rungs: of every human in the coming plan; other than chosen for humans who do
            not respond.
        observation: what was looked at, if the plan needs it.
    """

    model_probabilities: ModelProbabilities | None
    decision: Decision
    rungs: Rungs
    observation: Observation


class NewPlan(NamedTuple, Generic[WarmStart, Details]):
    """The plan of this step, and how its ascent ended.

    Attributes:
        plan: scaled; it fails if it is not finite.
        warm_start: where the next plan may start, if this one is followed.
        steps: number of steps of the ascent; 0 if there was none.
        converged: whether the last of them hardly moved the plan.
        details: what else belongs into the record of the step.
    """

    plan: Plan
    warm_start: WarmStart
    steps: Index
    converged: Flag
    details: Details


class StepResult(NamedTuple, Generic[WarmStart, Observation, Details]):
    """What drives in a step, and where it comes from.

    Attributes:
        driven: the plan that drives; its first control is executed. If the robot
            brakes, the rungs are those of the step's own plan.
        status: number of its status, see `STATUSES`.
        choice: the models of the step's own plan.
        new_plan: the step's own plan, whether it drives or not.
    """

    driven: RemainingPlan[WarmStart]
    status: Index
    choice: Choice[Observation]
    new_plan: NewPlan[WarmStart, Details]


Brake: TypeAlias = Callable[[RemainingPlan[WarmStart], Cars], RemainingPlan[WarmStart]]
"""Put braking in place of the robot's controls in what is left of a plan, given the
cars now.
"""


class Parts(NamedTuple, Generic[Cars, WarmStart, Observation, Details]):
    """What differs between live steps, batches and stock roads.

    Attributes:
        choose: looks at the last step, and chooses the models from what the robot
            carries and the cars now.
        plan: plans among the cars now, with a choice, perhaps starting from the plan to
            fall back on.
        brake: brakes, where nothing is left of the last plan.
        is_late: whether the plan, which was just made, is too late for this step; None
            if no plan ever is.
        escape: says what to execute instead of a control, given the cars now, if that
            leaves the robot no way out; None without such a search.
    """

    choose: Callable[[Carry[Cars, WarmStart], Cars], Choice[Observation]]
    plan: Callable[
        [Cars, Choice[Observation], RemainingPlan[WarmStart]],
        NewPlan[WarmStart, Details],
    ]
    brake: Brake[WarmStart, Cars]
    is_late: Callable[[], bool] | None = None
    escape: Callable[[Cars, Control], Escape] | None = None


# The same in games, where nothing but the states of cars is looked at.
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
    """Drive one step: choose a model of each human, plan, and execute a control.

    It is a step of the paper's meta-MDP, whose action is the choice of the models (Sec.
    III). The plan's first control is executed. A robot that cannot follow its plan
    falls back on the last one, then brakes; one that would have no way out escapes.

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
    driven, fallback, status = follow(
        new_plan, choice.rungs, carry.fallback, now, parts.brake, late
    )

    # If the control leaves no way out among cars that keep their velocity, escape.
    if parts.escape is not None:
        escape = parts.escape(now, driven.plan.robot[0])
        driven, fallback, status = follow_escape(driven, fallback, status, escape)

    # Remember the rungs that drive. The gain of a chosen rung says nothing of another
    # one that drives instead.
    chosen = choice.decision.memory
    gain = chosen.gain * (driven.rungs == chosen.rungs)
    memory = Memory(driven.rungs, carry.memory.step + 1, chosen.last_check, gain)

    # Remember what was done. What comes of it shows in the next step, which completes
    # the outcome.
    control = driven.plan.robot[0]
    outcome = carry.outcome._replace(
        before=now, after=now, robot=control, plan=driven.plan
    )

    next_carry = Carry(memory, outcome, choice.model_probabilities, fallback)
    return next_carry, StepResult(driven, status, choice, new_plan)


Result = TypeVar("Result")


def branch(
    flag: Flag | bool,
    then: Callable[[], Result],
    otherwise: Callable[[], Result],
) -> Result:
    """Return one of two results; for a flag of JAX, select each of their numbers.

    JAX computes both results, everything else only the one that is returned.
    """
    if isinstance(flag, jax.Array):
        return jax.tree.map(lambda *both: jnp.where(flag, *both), then(), otherwise())
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

    Args:
        new_plan: of this step.
        rungs: of every human in it.
        last: plan to fall back on in this step.
        now: all cars.
        brake: see `Parts`; it brakes where nothing is left of the last plan.
        late: whether the plan is too late for this step; a finite one is followed from
            the next step on.

    Returns:
        What drives, the plan to fall back on in the next step, and the number of the
        status.
    """
    plan = new_plan.plan
    xp = plan.robot.__array_namespace__()  # of NumPy or JAX
    finite = xp.isfinite(plan.robot).all() & xp.isfinite(plan.humans).all()

    def new() -> tuple[RemainingPlan[WarmStart], Index]:
        whole = RemainingPlan(plan, len(plan.robot), rungs, new_plan.warm_start)
        return whole, status_number("planned")

    def old() -> tuple[RemainingPlan[WarmStart], Index]:
        return fall_back(last, rungs, now, brake)

    # A plan in time drives now, and is what the next step falls back on.
    fallback, status = branch(finite, new, old)
    if not late:
        return fallback, fallback, status

    # A late one has to wait for the next step.
    driven, failed = old()
    status = branch(finite, lambda: status_number("late"), lambda: failed)
    return driven, fallback, status


def fall_back(
    last: RemainingPlan[WarmStart],
    rungs: Rungs,
    now: Cars,
    brake: Brake[WarmStart, Cars],
) -> tuple[RemainingPlan[WarmStart], Index]:
    """Go on with the last plan, or brake where nothing is left of it.

    Braking counts under the models of the step's own plan, whose rungs are given.

    Returns:
        What drives, and the number of its status, see `follow`.
    """
    left = last.later()
    stopping = left._replace(rungs=rungs)
    return branch(
        left.steps > 0,
        lambda: (left, status_number("previous plan")),
        lambda: (brake(stopping, now), status_number("braking")),
    )


def follow_escape(
    driven: RemainingPlan[WarmStart],
    fallback: RemainingPlan[WarmStart],
    status: Index,
    escape: Escape,
) -> tuple[RemainingPlan[WarmStart], RemainingPlan[WarmStart], Index]:
    """Follow an escape, and fall back on it, if it replaces the control.

    Late and failed plans keep their status. The rungs remain those of the plan,
    although an escape counts on nobody.

    Returns:
        The same as `follow`.
    """
    plan = driven.plan._replace(robot=escape.controls)
    steps = len(escape.controls)
    escaping = RemainingPlan(plan, steps, driven.rungs, fallback.warm_start)

    # Only a planned control gets the status of an escape.
    renamed = escape.replaces & (status == status_number("planned"))
    status = branch(renamed, lambda: status_number("way out"), lambda: status)

    driven, fallback = branch(
        escape.replaces, lambda: (escaping, escaping), lambda: (driven, fallback)
    )
    return driven, fallback, status
