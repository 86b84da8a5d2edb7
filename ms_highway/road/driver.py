"""Drive on a stock road, with proposals as plans.

The step is that of all robots, see `ms_highway.loop.step`. The evidence for the choice
of models is what the best proposal could gain from a better prediction of each car, see
`ms_highway.road.settings`. So the robot proposes when it looks, before it chooses;
planning is then to let others respond to the best proposals.
"""

from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import ClassVar, NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.choice.budget import deciding_in
from ms_highway.choice.rule import NOT_ESTIMATED, Outcome, Rule, decide_on, first_memory
from ms_highway.game.car_following import TRAFFIC_LIMITS
from ms_highway.loop.controller import ControlStep
from ms_highway.loop.step import (
    STATUSES,
    Carry,
    Choice,
    NewPlan,
    Parts,
    RemainingPlan,
    StepResult,
    step,
)
from ms_highway.perception.scene import SHAPE, Places, RoadScene
from ms_highway.planning.costs import Costs
from ms_highway.planning.plans import Plan
from ms_highway.road.plan import Proposed, RoadPlan, no_plan, propose_road, respond_road
from ms_highway.road.proposals import LAST_PLAN, LastPlan, full_braking
from ms_highway.road.road_planning import RoadPlanning
from ms_highway.road.road_weights import RoadWeights
from ms_highway.road.traffic_models import TRAFFIC_MODELS, ModelNumber
from ms_highway.runtime.arrays import Array, Controls, PerHuman, Rungs
from ms_highway.runtime.compilation import jit_quickly, timed, warm_up
from ms_highway.runtime.process import refuse_after_fork

MEASURED_COSTS = Costs(0.0040, np.array([0.0, 0.0, 0.0013]), TRAFFIC_MODELS)
"""Planning time if all cars are naive, and the time that each car adds under each
model, measured on one core [s].
"""

# Proposals, responses to them and decisions are each compiled once, for all scenes,
# models, limits and weights.
proposed_for = jit_quickly(propose_road)
responded_to = jit_quickly(respond_road)
decided = jit_quickly(decide_on)


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


RoadCarry: TypeAlias = Carry[RoadScene, LastPlan]
RoadChoice: TypeAlias = Choice[Look]
RoadRemainder: TypeAlias = RemainingPlan[LastPlan]
NewRoadPlan: TypeAlias = NewPlan[LastPlan, RoadPlan]
RoadResult: TypeAlias = StepResult[LastPlan, Look, RoadPlan]
"""Records of `ms_highway.loop.step` on stock roads, where proposals are plans."""


@dataclass(frozen=True, kw_only=True)
class RoadStep(ControlStep):
    """Record one step of a driver on a road.

    Each path of others counts as a human. Controls are the curvature of the rear axle's
    path [1/m] and the acceleration [m/s^2]. ``humans`` has the positions of others in
    place of their controls. ``models`` has an empty name for paths without a
    prediction; without a finite plan, these are all paths. ``gains`` are upper bounds,
    the same for all models except naive.

    Attributes:
        path: planned x, y and heading of the robot's centre in world coordinates; no
            steps if the plan failed.
        owners: number of the car that each path belongs to, -1 without one.
        source: what drives: ``proposal``, ``last plan`` or ``braking``; ``driver`` for
            one of `ms_highway.add_driver`.
        broken: whether the best plan breaks a constraint: it hits somebody, leaves the
            road or lacks the room to stop.
    """

    path: Float[Array, "steps 3"]
    owners: Places
    source: str
    broken: bool = False

    @property
    def failed(self) -> bool:
        """Whether the plan is not finite.

        The robot then follows the last plan or, without one, brakes.
        """
        return self.status not in ("planned", "late")


@dataclass
class RoadDriver:
    """Drive a robot on any road, one step at a time.

    If a plan takes longer than the budget, the robot follows the last plan in this step
    or, without one, brakes. The late plan is then the one to fall back on: the next
    step follows it if its own plan is late or not finite, too.

    Attributes:
        planning: limits, and the desired speed; may be replaced between steps.
        rule: chooses the models.
        weights: of the score.
        budget: largest time of a decision and a plan together [s].
        braking_share: share of the grip above which the deceleration of a broken plan
            counts as braking.
    """

    planning: RoadPlanning
    rule: Rule[PerHuman]
    weights: RoadWeights = field(default_factory=RoadWeights)
    budget: float = np.inf
    braking_share: ClassVar[float] = 0.95

    def __post_init__(self) -> None:
        self._carry: RoadCarry | None = None  # before the first step
        numbers = [TRAFFIC_MODELS.index(model.name) for model in self.rule.ladder]
        self._numbers = np.array(numbers, np.int32)

        # What the last step was worth and took.
        self._unknown_worth = np.zeros(SHAPE.paths, np.float32)  # before any proposal
        self._started = 0.0
        self._proposing_seconds = 0.0
        self._responding_seconds = 0.0
        self._deciding_seconds = 0.0

    def step(self, scene: RoadScene) -> RoadStep:
        """Choose the models, plan, and return the record of this step."""
        refuse_after_fork()
        carry = self._carry or self._begin(scene)
        compile_seconds = self._compile(scene, carry)
        self._started = perf_counter()
        is_late = self._is_late if np.isfinite(self.budget) else None
        parts = Parts(self._choose, self._plan, self._brake, is_late)
        self._carry, result = step(carry, scene, parts)
        return self._record(result, compile_seconds)

    def _compile(self, scene: RoadScene, carry: RoadCarry) -> float:
        """Compile what the step calls, and return the seconds that it took."""
        all_naive = np.zeros(SHAPE.paths, np.int32)
        warm_start = carry.fallback.warm_start
        seconds = warm_up(
            plan_of, scene, self.planning, self.weights, all_naive, warm_start
        )
        if self.rule.computes:
            seconds += warm_up(decided, self.rule, carry.memory, self._unknown_worth)
        return seconds

    def _begin(self, scene: RoadScene) -> RoadCarry:
        """Return what the robot carries into its first step.

        It is the same as after a step in which nobody moved.
        """
        last = no_plan(self.planning)
        memory = first_memory(self.rule, SHAPE.paths)
        nothing_left = RemainingPlan(_alone(last.controls), 0, memory.rungs, last)
        outcome = Outcome(
            scene,
            scene,
            last.controls[0],
            None,  # type: ignore[arg-type] # no rule of roads looks at
            None,  # type: ignore[arg-type] # the humans' controls and the reward
            nothing_left.plan,
        )
        return Carry(memory, outcome, None, nothing_left)

    def _record(self, result: RoadResult, compile_seconds: float) -> RoadStep:
        """Return the record of a step.

        Args:
            result: what happened.
            compile_seconds: seconds of compilation.
        """
        plan = result.new_plan.details
        look = result.choice.observation
        controls = result.executed.plan.robot
        is_finite = STATUSES[result.status] in ("planned", "late")
        path = plan.path[: len(controls) if is_finite else 0]

        # Paths without a car have no prediction, and so no model.
        is_predicted = look.scene.present & is_finite
        numbers = self._models(look.scene, result.choice.rungs)
        models = np.where(is_predicted, np.array(TRAFFIC_MODELS)[numbers], "")

        # The gains that the rule has estimated, for the models on its ladder.
        estimated = np.asarray(result.choice.decision.gains)
        gains = np.full((SHAPE.paths, len(TRAFFIC_MODELS)), np.nan)
        gains[:, self._numbers] = np.where(
            estimated == NOT_ESTIMATED, np.nan, estimated
        )

        return RoadStep(
            control=controls[0].astype(float),
            plan=controls,
            humans=plan.predictions[:, : len(path)],
            models=tuple(models.tolist()),
            planning_seconds=self._proposing_seconds + self._responding_seconds,
            decision_seconds=self._deciding_seconds,
            compile_seconds=compile_seconds,
            ladder=TRAFFIC_MODELS,
            gains=gains,
            status=STATUSES[result.status],
            path=path,
            owners=np.asarray(look.scene.owners),
            source=self._source(result, plan),
            broken=bool(plan.broken),
        )

    def _source(self, result: RoadResult, plan: RoadPlan) -> str:
        """Return what drives.

        Where the best plan does not, the last one does, or braking; the best plan may
        also be one of these.
        """
        if STATUSES[result.status] != "planned":
            return "last plan" if result.executed.controls_left > 0 else "braking"
        hardest = -self.braking_share * self.planning.grip
        if plan.broken and plan.controls[0, 1] < hardest:
            return "braking"
        number = int(plan.chosen)
        if number == LAST_PLAN:
            return "last plan"
        return "braking" if number in full_braking() else "proposal"

    # Parts of a step

    def _choose(self, carry: RoadCarry, scene: RoadScene) -> RoadChoice:
        """Look at the road, propose plans, and choose a model for each car.

        The choice depends on what a better prediction of the car could gain.
        """
        scene = self._with_accelerations(carry.outcome.before, scene)
        rule = self.rule
        memory = carry.memory
        decision = None
        if not rule.computes:
            decision = decide_on(rule, memory, self._unknown_worth)

        # Propose with the chosen models or, if they are yet to be chosen, with the
        # first one.
        all_first = np.zeros(SHAPE.paths, np.int32)
        rungs = all_first if decision is None else decision.memory.rungs
        models = self._models(scene, rungs)
        last = carry.fallback.warm_start.later()
        proposed, self._proposing_seconds = timed(
            proposed_for, scene, self.planning, self.weights, models, last
        )

        if decision is None:
            rule = deciding_in(rule, self._seconds_without_proposing)
            decision = jax.tree.map(np.asarray, decided(rule, memory, proposed.worth))
        self._deciding_seconds = self._seconds_without_proposing()
        look = Look(scene, models, proposed)
        return Choice(None, decision, decision.memory.rungs, look)

    def _seconds_without_proposing(self) -> float:
        """Return the time of this step so far, less that of the proposals [s]."""
        return perf_counter() - self._started - self._proposing_seconds

    def _plan(
        self,
        scene: RoadScene,
        choice: RoadChoice,
        last: RoadRemainder,
    ) -> NewRoadPlan:
        """Return the best proposal, after responses where a model says so."""
        look = choice.observation
        models = self._models(look.scene, choice.rungs)
        plan = look.proposed.plan
        self._responding_seconds = 0.0

        # Other models than in the proposals, or responses: score them again.
        are_others = (models != look.models).any()
        if are_others or (models == ModelNumber.tom).any():
            plan, self._responding_seconds = timed(responded_to, look.proposed, models)
        plan = jax.tree.map(np.asarray, plan)
        return NewPlan(_alone(plan.controls), plan.last(), 0, False, plan)

    def _brake(self, left: RoadRemainder, scene: RoadScene) -> RoadRemainder:
        """Brake straight on, by the whole grip.

        Nothing is left for the next plan to start from.
        """
        braking = np.full_like(left.plan.robot, [0.0, -self.planning.grip])
        warm_start = no_plan(self.planning)._replace(controls=braking)
        return left._replace(plan=_alone(braking), warm_start=warm_start)

    def _is_late(self) -> bool:
        """Return whether the budget is spent."""
        return perf_counter() - self._started > self.budget

    # What others do

    def _with_accelerations(self, before: RoadScene, scene: RoadScene) -> RoadScene:
        """Return the scene with mean accelerations of others since the last step."""
        owners_before = before.owners.tolist()
        speeds_before = before.states[:, 3].tolist()
        speed_before = dict(zip(owners_before, speeds_before, strict=True))

        # New cars have no earlier speed, and so no acceleration.
        owners = scene.owners.tolist()
        speeds = scene.states[:, 3].tolist()
        changes = []
        for owner, speed in zip(owners, speeds, strict=True):
            changes.append(speed - speed_before.get(owner, speed))
        accelerations = np.array(changes, np.float32) / float(self.planning.time_step)
        accelerations = np.nan_to_num(accelerations)
        hardest = TRAFFIC_LIMITS.braking
        accelerations = accelerations.clip(-hardest, hardest).astype(np.float32)
        return replace(scene, accelerations=accelerations)

    def _models(self, scene: RoadScene, rungs: Rungs) -> Rungs:
        """Return the number of the model of each car; obstacles are naive."""
        numbers = np.where(scene.moving, self._numbers[rungs], ModelNumber.naive)
        return numbers.astype(np.int32)


def _alone(controls: Controls) -> Plan:
    """Return a plan of the robot that expects no controls of others.

    Their positions are predicted instead.
    """
    return Plan(controls, np.zeros((0, *np.shape(controls)), np.float32))
