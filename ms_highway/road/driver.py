"""Drive on a road: observe, choose how to predict each car, plan, follow the plan or fall back."""

from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.loop.controller import ControlStep
from ms_highway.loop.fallback import LATE, PLANNED, STATUSES, fallback_status
from ms_highway.planning.car_following import HARDEST
from ms_highway.planning.compiled_plans import Costs
from ms_highway.road.constants import IDM, MODELS, NAIVE, RoadPlanning, RoadWeights
from ms_highway.road.plan import LastPlan, Proposed, RoadPlan, answer_road, no_plan, propose_road
from ms_highway.road.proposals import FULL_BRAKING, LAST_PLAN
from ms_highway.road.rungs import RungChoice
from ms_highway.road.scene import TRAFFIC, Places, RoadScene, Traffic
from ms_highway.runtime.arrays import Controls, Rungs
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.forks import refuse_after_fork
from ms_highway.runtime.timing import timed, warm_up

SHIPPED_COSTS = Costs(0.0040, np.array([0.0, 0.0, 0.0013]))
"""Planning time among naive cars, and what each car adds under each model, as measured on one core [s]."""

BRAKING_SHARE = 0.95  # share of the grip from which a plan that breaks a constraint counts as braking
SOURCES = {LAST_PLAN: "last plan"} | dict.fromkeys(FULL_BRAKING, "braking")
REPEATS = 9  # plans that are timed for the costs of models

proposed_for, answered_by = jit_quickly(propose_road), jit_quickly(answer_road)
"""Proposals and answers to them, each compiled once for all scenes, rungs, limits and weights."""


def plan_of(scene: RoadScene, planning: RoadPlanning, weights: RoadWeights, rungs: Rungs, last: LastPlan) -> RoadPlan:
    """Return the plan with a model for each of the others, by both."""
    return answered_by(proposed_for(scene, planning, weights, rungs, last), rungs)


@dataclass(frozen=True, kw_only=True)
class RoadStep(ControlStep):
    """Record of one step of a driver on a road, where each path of others counts as a human.

    Controls are the curvature of the rear axle's path [1/m] and the acceleration [m/s^2]. ``humans`` has x and y of
    others in place of their controls, ``models`` an empty name where nobody is predicted, and ``gains`` what an answer
    may be worth at most, the same for all models but naive. Where a plan is not finite, nobody is predicted.

    Attributes:
        path: x, y and heading of the robot's centre, as planned, world coordinates; no steps if the plan failed.
        owners: number of the car that each path belongs to, -1 without one.
        source: what drives: ``proposal``, ``last plan`` or ``braking``.
        broken: whether the best plan breaks a constraint: it hits somebody, leaves the road or lacks the room to stop.
    """

    path: Float[Any, "steps 3"]
    owners: Places
    source: str
    broken: bool = False

    @property
    def failed(self) -> bool:
        """Whether the plan is not finite, so that the last plan or, without one, braking drives."""
        return self.status not in ("planned", "late")


@dataclass
class RoadDriver:
    """Drive a robot on any road, one step at a time.

    Where its choice has a budget, a plan that is late is followed from the next step on; in its own step, the last one
    or, without one, braking drives.

    Attributes:
        planning: limits and wishes; may be replaced between steps.
        choice: of the models that predict others.
        weights: what counts.
        costs: of models; None to measure them in the first step with others, which noise may change.
    """

    planning: RoadPlanning
    choice: RungChoice
    weights: RoadWeights = field(default_factory=RoadWeights)
    costs: Costs | None = SHIPPED_COSTS

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the last plan, before a new episode."""
        self._last = no_plan(self.planning)
        self._left = 0  # controls of the last plan that are left, the executed one included
        self._speeds: dict[int, float] = {}  # of others at the last look, by their names

    def step(self, scene: RoadScene) -> RoadStep:
        """Return what to do now."""
        refuse_after_fork()
        start = perf_counter()
        scene = self._with_accelerations(scene)
        costs, compiling = timed(self._prepared, scene)
        plan, rungs, worth, planning = self._chosen(scene, costs, perf_counter() - start - compiling)
        deciding = perf_counter() - start - compiling - planning
        late = deciding + planning > 1e-3 * self.choice.milliseconds
        controls, status, source = self._followed(plan, late)
        path = plan.path[: len(controls) if status in (PLANNED, LATE) else 0]
        predicted = scene.present & (len(path) > 0)
        gains = np.tile(worth[:, None], len(MODELS))
        gains[:, NAIVE] = np.nan
        return RoadStep(
            controls[0].astype(float),
            controls,
            plan.predictions[:, : len(path)],
            tuple(np.where(predicted, np.array(MODELS)[rungs], "").tolist()),
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
        """Return the road with the accelerations of others since the last look."""
        seen, speeds = scene.names.tolist(), scene.states[:, 3].tolist()
        changes = [speed - self._speeds.get(name, speed) for name, speed in zip(seen, speeds, strict=True)]
        self._speeds = dict(zip(seen, speeds, strict=True))
        accelerations = np.nan_to_num(np.array(changes, np.float32) / float(self.planning.time_step))
        return replace(scene, accelerations=accelerations.clip(-HARDEST, HARDEST).astype(np.float32))

    def _chosen(self, scene: RoadScene, costs: Costs, spent: float) -> tuple[RoadPlan, Rungs, Traffic, float]:
        """Return the plan, the rung of each of the others, what their answers are worth, and its planning time."""
        rungs, worth = self._rungs(scene, np.zeros(TRAFFIC), costs, spent), np.full(TRAFFIC, np.nan)
        proposed, planning = timed(self._proposed, scene, rungs)
        if self.choice.looks:
            worth = np.asarray(proposed.worth)
            first, rungs = rungs, self._rungs(scene, worth, costs, spent)
            if ((rungs <= IDM) & (rungs != first)).any():  # what optimises is predicted anew anyway
                proposed, again = timed(self._proposed, scene, rungs)
                planning += again
        plan, answering = timed(self._answered, proposed, rungs)
        return plan, rungs, worth, planning + answering

    def _rungs(self, scene: RoadScene, worth: Traffic, costs: Costs, spent: float) -> Rungs:
        """Return the rung of each of the others, whose answers are worth this much [reward]."""
        chosen = self.choice.choose(worth, costs, spent)
        return np.where(scene.moving & scene.present, chosen, NAIVE).astype(np.int32)

    def _proposed(self, scene: RoadScene, rungs: Rungs) -> Proposed:
        return proposed_for(scene, self.planning, self.weights, rungs, self._last)

    def _answered(self, proposed: Proposed, rungs: Rungs) -> RoadPlan:
        """Return the best plan, answered by those who optimise their reward, if there are any."""
        plan = answered_by(proposed, rungs) if (rungs > IDM).any() else proposed.plan
        return jax.tree.map(np.asarray, plan)

    def _planned(self, scene: RoadScene, rungs: Rungs) -> RoadPlan:
        return self._answered(self._proposed(scene, rungs), rungs)

    def _followed(self, plan: RoadPlan, late: bool) -> tuple[Controls, int, str]:
        """Return the controls to follow, the number of their status and their source; keep what is left of the plan."""
        wanted, grip = plan.controls, self.planning.grip
        if self._left > 1:
            rest, source = self._last, "last plan"
        else:
            rest, source = no_plan(self.planning)._replace(controls=np.full_like(wanted, [0.0, -grip])), "braking"
        status, self._left = fallback_status(bool(np.isfinite(wanted).all()), self._left, len(wanted))
        self._last = plan.handed_on() if status == PLANNED else rest.later()
        if status != PLANNED or late:
            return rest.controls, LATE if status == PLANNED else status, source
        hardest = plan.broken and wanted[0, 1] < -BRAKING_SHARE * grip
        return wanted, status, "braking" if hardest else SOURCES.get(int(plan.chosen), "proposal")

    def _prepared(self, scene: RoadScene) -> Costs:
        """Compile, and return what models cost, measured once there are others if the choice looks at it."""
        others = np.asarray(scene.moving & scene.present)
        rungs = np.outer(range(len(MODELS)), others).astype(np.int32)
        warm_up(plan_of, scene, self.planning, self.weights, rungs[0], self._last)
        if self.costs is None and self.choice.looks and others.any():
            # Noise only adds to times, and not to all repeats.
            seconds = np.min([[timed(self._planned, scene, each)[1] for each in rungs] for _ in range(REPEATS)], axis=0)
            seconds[: IDM + 1] = seconds[: IDM + 1].min()  # one program
            self.costs = Costs(float(seconds[0]), np.maximum.accumulate(seconds - seconds[0]) / others.sum())
        return self.costs or Costs(0.0, np.zeros(len(MODELS)))
