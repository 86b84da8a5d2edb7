"""Drive on a road: choose a model for each car, plan, then follow the plan or fall back."""

from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.choice.budget import deciding_in
from ms_highway.choice.rule import Rule, decide_on, first_memory
from ms_highway.loop.controller import ControlStep
from ms_highway.loop.step import LATE, PLANNED, STATUSES, fallback_status
from ms_highway.perception.scene import TRAFFIC, Places, RoadScene
from ms_highway.planning.costs import Costs
from ms_highway.planning.manoeuvres import MAX_BRAKING
from ms_highway.road.constants import MODELS, NAIVE, TOM, RoadPlanning, RoadWeights
from ms_highway.road.plan import RoadPlan, no_plan, propose_road, respond_road
from ms_highway.road.proposals import FULL_BRAKING, LAST_PLAN, LastPlan
from ms_highway.runtime.arrays import Controls, PerHuman, Rungs
from ms_highway.runtime.compilation import jit_quickly, timed, warm_up
from ms_highway.runtime.process import refuse_after_fork

SHIPPED_COSTS = Costs(0.0040, np.array([0.0, 0.0, 0.0013]), MODELS)
"""Planning time if all cars are naive, and the time that each car adds under each model, measured on one core [s]."""

BRAKING_SHARE = 0.95  # share of the grip above which the deceleration of a broken plan counts as braking
SOURCES = {LAST_PLAN: "last plan"} | dict.fromkeys(FULL_BRAKING, "braking")

proposed_for, responded_to, decided = jit_quickly(propose_road), jit_quickly(respond_road), jit_quickly(decide_on)
"""Proposals, answers to them and decisions, each compiled once for all scenes, models, limits and weights."""


def plan_of(scene: RoadScene, planning: RoadPlanning, weights: RoadWeights, models: Rungs, last: LastPlan) -> RoadPlan:
    """Return the best plan, given the number of the model of each of the others."""
    return responded_to(proposed_for(scene, planning, weights, models, last), models)


@dataclass(frozen=True, kw_only=True)
class RoadStep(ControlStep):
    """Record of one step of a driver on a road, where each path of others counts as a human.

    Controls are the curvature of the rear axle's path [1/m] and the acceleration [m/s^2]. ``humans`` has the positions
    of others in place of their controls. ``models`` has an empty name for paths without a prediction; without a finite
    plan, these are all paths. ``gains`` are upper bounds, the same for all models except naive.

    Attributes:
        path: planned x, y and heading of the robot's centre in world coordinates; no steps if the plan failed.
        owners: number of the car that each path belongs to, -1 without one.
        source: what drives: ``proposal``, ``last plan`` or ``braking``; ``driver`` for one of `ms_highway.add_driver`.
        broken: whether the best plan breaks a constraint: it hits somebody, leaves the road or lacks the room to stop.
    """

    path: Float[Any, "steps 3"]
    owners: Places
    source: str
    broken: bool = False

    @property
    def failed(self) -> bool:
        """Whether the plan is not finite, so that the robot follows the last plan or, without one, brakes."""
        return self.status not in ("planned", "late")


@dataclass
class RoadDriver:
    """Drive a robot on any road, one step at a time.

    If a plan takes longer than the budget, the robot follows it from the next step on; in this step, it follows the
    last plan or, without one, brakes.

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
        self._memory = first_memory(self.rule, TRAFFIC)
        self._last = no_plan(self.planning)
        self._left = 0  # remaining controls of the last plan, the executed one included
        self._speeds: dict[int, float] = {}  # of others at the last look, by number

    def step(self, scene: RoadScene) -> RoadStep:
        """Choose the models, plan, and return the record of this step."""
        refuse_after_fork()
        start = perf_counter()
        scene = self._with_accelerations(scene)
        rule, memory, gains = self.rule, self._memory, np.full((TRAFFIC, len(MODELS)), np.nan)
        compiling = warm_up(plan_of, scene, self.planning, self.weights, np.zeros(TRAFFIC, np.int32), self._last)
        if rule.estimates:
            compiling += warm_up(decided, rule, memory, np.zeros(TRAFFIC, np.float32))
        else:
            memory = decide_on(rule, memory, np.zeros(TRAFFIC, np.float32)).memory
        first = models = self._models(scene, memory.rungs)
        proposed, proposing = timed(proposed_for, scene, self.planning, self.weights, first, self._last)
        if rule.estimates:
            rule = deciding_in(rule, lambda: perf_counter() - start - compiling - proposing)
            gains[:, NAIVE + 1 :] = np.asarray(proposed.worth)[:, None]
            models = self._models(scene, np.asarray(decided(rule, memory, proposed.worth).memory.rungs))
        plan, answering = proposed.plan, 0.0
        if (models != first).any() or (models == TOM).any():  # the proposals have to be scored again
            plan, answering = timed(responded_to, proposed, models)
        plan = jax.tree.map(np.asarray, plan)
        planning = proposing + answering
        deciding = perf_counter() - start - compiling - planning
        controls, status, source = self._followed(plan, deciding + planning > self.budget)
        path = plan.path[: len(controls) if status in (PLANNED, LATE) else 0]
        predicted = scene.present & (len(path) > 0)
        self._memory = self._memory._replace(step=self._memory.step + 1)
        return RoadStep(
            controls[0].astype(float),
            controls,
            plan.predictions[:, : len(path)],
            tuple(np.where(predicted, np.array(MODELS)[models], "").tolist()),
            planning,
            deciding,
            compiling,
            MODELS,
            gains,
            status=STATUSES[status],
            path=path,
            owners=np.asarray(scene.owners),
            source=source,
            broken=bool(plan.broken),
        )

    def _with_accelerations(self, scene: RoadScene) -> RoadScene:
        """Return the scene with the mean accelerations of others since the last look."""
        owners, before = scene.owners.tolist(), self._speeds
        self._speeds = speeds = dict(zip(owners, scene.states[:, 3].tolist(), strict=True))
        changes = [speeds[owner] - before.get(owner, speeds[owner]) for owner in owners]
        accelerations = np.nan_to_num(np.array(changes, np.float32) / float(self.planning.time_step))
        return replace(scene, accelerations=accelerations.clip(-MAX_BRAKING, MAX_BRAKING).astype(np.float32))

    def _models(self, scene: RoadScene, rungs: Rungs) -> Rungs:
        """Return the number of the model of each car; naive for those that cannot move."""
        numbers = np.array([MODELS.index(model.name) for model in self.rule.ladder], np.int32)
        return np.where(scene.moving, numbers[rungs], NAIVE).astype(np.int32)

    def _followed(self, plan: RoadPlan, late: bool) -> tuple[Controls, int, str]:
        """Return the controls to follow, the number of their status and their source; keep the rest for later steps."""
        wanted, grip = plan.controls, self.planning.grip
        if self._left > 1:
            rest, source = self._last, "last plan"
        else:
            rest, source = no_plan(self.planning)._replace(controls=np.full_like(wanted, [0.0, -grip])), "braking"
        status, self._left = fallback_status(bool(np.isfinite(wanted).all()), self._left, len(wanted))
        self._last = plan.rest() if status == PLANNED else rest.later()
        if status != PLANNED or late:
            return rest.controls, LATE if status == PLANNED else status, source
        hardest = plan.broken and wanted[0, 1] < -BRAKING_SHARE * grip
        return wanted, status, "braking" if hardest else SOURCES.get(int(plan.chosen), "proposal")
