"""Drive on a stock road, by the step of all robots (`ms_highway.loop.step`), with
proposals as plans.

The evidence for the choice of models is what the best proposal could gain from a better
prediction of each car, see `ms_highway.road.settings`. So the robot proposes when it
looks, before it chooses; planning is then to let others respond to the best proposals.
"""

from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.choice.budget import deciding_in
from ms_highway.choice.rule import NOT_ESTIMATED, Outcome, Rule, decide_on, first_memory
from ms_highway.game.car_following import TRAFFIC_LIMITS
from ms_highway.loop.controller import ControlStep
from ms_highway.loop.step import (
    LATE,
    PLANNED,
    STATUSES,
    Carry,
    Choice,
    NewPlan,
    Parts,
    RemainingPlan,
    StepResult,
    step,
)
from ms_highway.perception.scene import TRAFFIC, Places, RoadScene
from ms_highway.planning.costs import Costs
from ms_highway.planning.plans import Plan
from ms_highway.road.constants import MODELS, NAIVE, TOM, RoadPlanning, RoadWeights
from ms_highway.road.plan import Proposed, RoadPlan, no_plan, propose_road, respond_road
from ms_highway.road.proposals import FULL_BRAKING, LAST_PLAN, LastPlan
from ms_highway.runtime.arrays import Controls, PerHuman, Rungs
from ms_highway.runtime.compilation import jit_quickly, timed, warm_up
from ms_highway.runtime.process import refuse_after_fork

SHIPPED_COSTS = Costs(0.0040, np.array([0.0, 0.0, 0.0013]), MODELS)
"""Planning time if all cars are naive, and the time that each car adds under each
model, measured on one core [s].
"""

UNKNOWN_WORTH = np.zeros(TRAFFIC, np.float32)
"""What a better prediction of each of the others may gain, before anything is proposed.
"""

# share of the grip above which the deceleration of a broken plan counts as braking
BRAKING_SHARE = 0.95
SOURCES = {LAST_PLAN: "last plan"} | dict.fromkeys(FULL_BRAKING, "braking")

proposed_for = jit_quickly(propose_road)
responded_to = jit_quickly(respond_road)
decided = jit_quickly(decide_on)
"""Proposals, answers to them and decisions, each compiled once for all scenes, models,
limits and weights.
"""


def plan_of(
    scene: RoadScene,
    planning: RoadPlanning,
    weights: RoadWeights,
    models: Rungs,
    last: LastPlan,
) -> RoadPlan:
    """Return the best plan, given the number of the model of each of the others."""
    return responded_to(proposed_for(scene, planning, weights, models, last), models)


class Look(NamedTuple):
    """What the robot sees before it chooses models.

    Attributes:
        scene: with the mean accelerations of others since the last step.
        models: number of the model of each of the others in the proposals.
        proposed: the best proposals if nobody responds.
    """

    scene: RoadScene
    models: Rungs
    proposed: Proposed


@dataclass(frozen=True, kw_only=True)
class RoadStep(ControlStep):
    """Record of one step of a driver on a road, where each path of others counts as a
    human.

    Controls are the curvature of the rear axle's path [1/m] and the acceleration
    [m/s^2]. ``humans`` has the positions of others in place of their controls.
    ``models`` has an empty name for paths without a prediction; without a finite plan,
    these are all paths. ``gains`` are upper bounds, the same for all models except
    naive.

    Attributes:
        path: planned x, y and heading of the robot's centre in world coordinates; no
            steps if the plan failed.
        owners: number of the car that each path belongs to, -1 without one.
        source: what drives: ``proposal``, ``last plan`` or ``braking``; ``driver`` for
            one of `ms_highway.add_driver`.
        broken: whether the best plan breaks a constraint: it hits somebody, leaves the
            road or lacks the room to stop.
    """

    path: Float[Any, "steps 3"]
    owners: Places
    source: str
    broken: bool = False

    @property
    def failed(self) -> bool:
        """Whether the plan is not finite, so that the robot follows the last plan or,
        without one, brakes.
        """
        return self.status not in ("planned", "late")


@dataclass
class RoadDriver:
    """Drive a robot on any road, one step at a time.

    If a plan takes longer than the budget, the robot follows it from the next step on;
    in this step, it follows the last plan or, without one, brakes.

    Attributes:
        planning: limits and wishes; may be replaced between steps.
        rule: chooses the models.
        weights: of the score.
        budget: largest time of a decision and a plan together [s].
    """

    planning: RoadPlanning
    rule: Rule[PerHuman]
    weights: RoadWeights = field(default_factory=RoadWeights)
    budget: float = np.inf

    def __post_init__(self) -> None:
        self._carry: Carry | None = None  # before the first step
        numbers = [MODELS.index(model.name) for model in self.rule.ladder]
        self._numbers = np.array(numbers, np.int32)
        self._proposing = self._responding = self._deciding = (
            0.0  # seconds of the last step
        )

    def step(self, scene: RoadScene) -> RoadStep:
        """Choose the models, plan, and return the record of this step."""
        refuse_after_fork()
        carry = self._carry or self._begin(scene)
        nobody = np.zeros(TRAFFIC, np.int32)
        compiling = warm_up(
            plan_of,
            scene,
            self.planning,
            self.weights,
            nobody,
            carry.fallback.warm_start,
        )
        if self.rule.estimates:
            compiling += warm_up(decided, self.rule, carry.memory, UNKNOWN_WORTH)
        self._started = perf_counter()
        is_late = self._is_late if np.isfinite(self.budget) else None
        self._carry, result = step(
            carry, scene, Parts(self._choose, self._plan, self._brake, is_late)
        )
        return self._record(result, compiling)

    def _begin(self, scene: RoadScene) -> Carry:
        """Return what the robot carries into its first step, as after a step in which
        nobody moved.
        """
        last = no_plan(self.planning)
        memory = first_memory(self.rule, TRAFFIC)
        none = RemainingPlan(_alone(last.controls), 0, memory.rungs, last)
        outcome = Outcome(scene, scene, last.controls[0], None, None, none.plan)
        return Carry(memory, outcome, None, none)

    def _record(self, result: StepResult, compiling: float) -> RoadStep:
        """Return the record of a step, given what happened and the seconds of
        compilation.
        """
        plan: RoadPlan = result.planned.details
        look: Look = result.choice.evidence
        controls = result.driven.plan.robot
        finite = result.status in (PLANNED, LATE)
        path = plan.path[: len(controls) if finite else 0]

        # Where the best plan does not drive, the last one does, or braking, which a
        # plan may also be.
        hardest = (
            plan.broken and plan.controls[0, 1] < -BRAKING_SHARE * self.planning.grip
        )
        if result.status != PLANNED:
            source = "last plan" if result.driven.steps > 0 else "braking"
        else:
            source = "braking" if hardest else SOURCES.get(int(plan.chosen), "proposal")

        # Paths without a car have no prediction, and so no model.
        predicted = look.scene.present & finite
        models = np.array(MODELS)[self._models(look.scene, result.choice.rungs)]
        estimated = np.asarray(result.choice.decision.gains)
        gains = np.full((TRAFFIC, len(MODELS)), np.nan)
        gains[:, self._numbers] = np.where(
            estimated == NOT_ESTIMATED, np.nan, estimated
        )

        return RoadStep(
            control=controls[0].astype(float),
            plan=controls,
            humans=plan.predictions[:, : len(path)],
            models=tuple(np.where(predicted, models, "").tolist()),
            planning_seconds=self._proposing + self._responding,
            decision_seconds=self._deciding,
            compile_seconds=compiling,
            ladder=MODELS,
            gains=gains,
            status=STATUSES[result.status],
            path=path,
            owners=np.asarray(look.scene.owners),
            source=source,
            broken=bool(plan.broken),
        )

    # Parts of a step

    def _choose(self, carry: Carry, scene: RoadScene) -> Choice:
        """Look at the road, propose plans, and choose a model for each car by what it
        could gain.
        """
        scene = self._with_accelerations(carry.outcome.before, scene)
        rule = self.rule
        memory = carry.memory
        decision = None
        if not rule.estimates:
            decision = decide_on(rule, memory, UNKNOWN_WORTH)

        # Propose with the chosen models or, if they are yet to be chosen, with the
        # first one.
        rungs = (
            np.zeros(TRAFFIC, np.int32) if decision is None else decision.memory.rungs
        )
        first = self._models(scene, rungs)
        last = carry.fallback.warm_start.later()
        proposed, self._proposing = timed(
            proposed_for, scene, self.planning, self.weights, first, last
        )

        if decision is None:
            rule = deciding_in(
                rule, lambda: perf_counter() - self._started - self._proposing
            )
            decision = jax.tree.map(np.asarray, decided(rule, memory, proposed.worth))
        self._deciding = perf_counter() - self._started - self._proposing
        return Choice(
            None, decision, decision.memory.rungs, Look(scene, first, proposed)
        )

    def _plan(self, scene: RoadScene, choice: Choice, last: RemainingPlan) -> NewPlan:
        """Return the best proposal, once others have responded where a model says so."""
        look: Look = choice.evidence
        models = self._models(look.scene, choice.rungs)
        plan = look.proposed.plan
        self._responding = 0.0
        if (models != look.models).any() or (
            models == TOM
        ).any():  # the proposals have to be scored again
            plan, self._responding = timed(responded_to, look.proposed, models)
        plan = jax.tree.map(np.asarray, plan)
        return NewPlan(_alone(plan.controls), plan.last(), details=plan)

    def _brake(self, left: RemainingPlan, scene: RoadScene) -> RemainingPlan:
        """Brake straight on, by the whole grip; nothing is left for the next plan to
        start from.
        """
        braking = np.full_like(left.plan.robot, [0.0, -self.planning.grip])
        return left._replace(
            plan=_alone(braking),
            warm_start=no_plan(self.planning)._replace(controls=braking),
        )

    def _is_late(self) -> bool:
        """Return whether the budget is spent."""
        return perf_counter() - self._started > self.budget

    # What others do

    def _with_accelerations(self, before: RoadScene, scene: RoadScene) -> RoadScene:
        """Return the scene with the mean accelerations of others since the scene of the
        last step.
        """
        owners = scene.owners.tolist()
        speeds = scene.states[:, 3].tolist()
        last = dict(
            zip(before.owners.tolist(), before.states[:, 3].tolist(), strict=True)
        )
        changes = [
            speed - last.get(owner, speed)
            for owner, speed in zip(owners, speeds, strict=True)
        ]
        accelerations = np.nan_to_num(
            np.array(changes, np.float32) / float(self.planning.time_step)
        )
        hardest = TRAFFIC_LIMITS.braking
        accelerations = accelerations.clip(-hardest, hardest).astype(np.float32)
        return replace(scene, accelerations=accelerations)

    def _models(self, scene: RoadScene, rungs: Rungs) -> Rungs:
        """Return the number of the model of each car; naive for those that cannot move."""
        return np.where(scene.moving, self._numbers[rungs], NAIVE).astype(np.int32)


def _alone(controls: Controls) -> Plan:
    """Return a plan of the robot that expects no controls of others, whose positions
    are predicted instead.
    """
    return Plan(controls, np.zeros((0, *np.shape(controls)), np.float32))
