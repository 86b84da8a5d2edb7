"""Drive on a road: observe, infer, choose how to predict each car, plan, follow the plan or fall back."""

from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.control.controller import ControlStep
from ms_highway.control.fallback import LATE, PLANNED, STATUSES, fallback_status
from ms_highway.game.road import TRAFFIC, Places, RoadScene, Traffic, Traits
from ms_highway.metareasoning.belief import first_belief
from ms_highway.metareasoning.road import RungChoice, counted_rungs, updated_road_belief
from ms_highway.optimization.kalman import Gaussian
from ms_highway.planning.car_following import HARDEST
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import PACKAGE_MODELS
from ms_highway.planning.road.plan import LastPlan, Proposed, RoadPlan, answer_road, no_plan, propose_road
from ms_highway.planning.road.proposals import FULL_BRAKING, LAST_PLAN
from ms_highway.planning.road.settings import IDM, NAIVE, TOM, TURN, RoadPlanning, RoadWeights
from ms_highway.planning.road.traits import prior, traits_of, updated_traits
from ms_highway.runtime.arrays import Belief, Controls, Rungs
from ms_highway.runtime.compilation import jit_quickly
from ms_highway.runtime.forks import refuse_after_fork
from ms_highway.runtime.timing import timed, warm_up

SHIPPED_COSTS = Costs(0.0040, np.array([0.0, 0.0, 0.0013, 0.0013]))
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
        traits: estimated of the driver on each path, None if they are not.
    """

    path: Float[Any, "steps 3"]
    owners: Places
    source: str
    broken: bool = False
    traits: Traits | None = None

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
        traits: whether desired speeds and headways of others are estimated, and used to predict them.
        belief: whether the robot infers which model each driver follows, and counts on a yield only of those who have
            shown one.
    """

    planning: RoadPlanning
    choice: RungChoice
    weights: RoadWeights = field(default_factory=RoadWeights)
    costs: Costs | None = SHIPPED_COSTS
    traits: bool = False
    belief: bool = False

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the last plan, before a new episode."""
        self._last = no_plan(self.planning)
        self._left = 0  # controls of the last plan that are left, the executed one included
        self._seen = DriversSeen(self.traits, self.belief, float(self.planning.time_step))

    def step(self, scene: RoadScene) -> RoadStep:
        """Return what to do now."""
        refuse_after_fork()
        start, compiling = perf_counter(), 0.0
        if self._left == 0:
            _, compiling = timed(self._seen.prepare, scene, self.planning.steps)
        scene, belief = self._seen.look(scene)
        costs, preparing = timed(self._prepared, scene)
        compiling += preparing
        plan, rungs, worth, planning = self._chosen(scene, belief, costs, perf_counter() - start - compiling)
        deciding = perf_counter() - start - compiling - planning
        late = deciding + planning > 1e-3 * getattr(self.choice, "milliseconds", np.inf)
        controls, status, source = self._followed(plan, late)
        path = plan.path[: len(controls) if status in (PLANNED, LATE) else 0]
        self._seen.planned(scene, path)
        predicted = scene.present & (len(path) > 0)
        gains = np.tile(worth[:, None], len(PACKAGE_MODELS))
        gains[:, NAIVE] = np.nan
        return RoadStep(
            controls[0].astype(float),
            controls,
            plan.predictions[:, : len(path)],
            tuple(np.where(predicted, np.array(PACKAGE_MODELS)[rungs], "").tolist()),
            planning,
            deciding,
            compiling,
            PACKAGE_MODELS,
            gains,
            status=STATUSES[status],
            belief=belief,
            path=path,
            owners=np.asarray(scene.owners),
            source=source,
            broken=bool(plan.broken),
            traits=scene.traits,
        )

    def _chosen(
        self, scene: RoadScene, belief: Belief | None, costs: Costs, spent: float
    ) -> tuple[RoadPlan, Rungs, Traffic, float]:
        """Return the plan, the rung of each of the others, what their answers are worth, and its planning time."""
        rungs, worth = self._rungs(scene, belief, np.zeros(TRAFFIC), costs, spent), np.full(TRAFFIC, np.nan)
        proposed, planning = timed(self._proposed, scene, rungs)
        if self.choice.looks:
            worth = np.asarray(proposed.worth) * (1.0 if belief is None else belief[:, TOM])
            first, rungs = rungs, self._rungs(scene, belief, worth, costs, spent)
            if ((rungs <= IDM) & (rungs != first)).any():  # what optimises is predicted anew anyway
                proposed, again = timed(self._proposed, scene, rungs)
                planning += again
        plan, answering = timed(self._answered, proposed, rungs)
        return plan, rungs, worth, planning + answering

    def _rungs(self, scene: RoadScene, belief: Belief | None, worth: Traffic, costs: Costs, spent: float) -> Rungs:
        """Return the rung of each of the others, whose answers are worth this much [reward]."""
        chosen = self.choice.choose(worth, costs, spent)
        rungs = np.where(scene.moving & scene.present, chosen, NAIVE).astype(np.int32)
        return rungs if belief is None else counted_rungs(rungs, belief)

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
        rungs = np.outer(range(len(PACKAGE_MODELS)), others).astype(np.int32)
        warm_up(plan_of, scene, self.planning, self.weights, rungs[0], self._last)
        if self.costs is None and self.choice.looks and others.any():
            # Noise only adds to times, and not to all repeats.
            seconds = np.min([[timed(self._planned, scene, each)[1] for each in rungs] for _ in range(REPEATS)], axis=0)
            seconds[:TURN] = seconds[:TURN].min()  # one program
            self.costs = Costs(float(seconds[0]), np.maximum.accumulate(seconds - seconds[0]) / others.sum())
        return self.costs or Costs(0.0, np.zeros(len(PACKAGE_MODELS)))


Known = tuple[Gaussian, Belief]
Path = Float[Any, "steps 3"]


def _updated(known: Known, before: RoadScene, path: Path, now: RoadScene, time_step: float) -> Known:
    traits = updated_traits(known[0], before, now, time_step)
    return traits, updated_road_belief(known[1], before, path, now, time_step)


_prior, _update = jit_quickly(prior), jit_quickly(_updated)


class DriversSeen:
    """Estimates and belief about the drivers in sight, updated in every step of a robot.

    Args:
        traits: whether what drivers are like is estimated.
        belief: whether the model that each follows is inferred.
        time_step: between two steps [s].
    """

    def __init__(self, traits: bool, belief: bool, time_step: float) -> None:
        self.traits, self.belief, self.time_step = traits, belief, time_step
        self._before: tuple[RoadScene, Path] | None = None
        self._speeds: dict[int, float] = {}
        self._known: Known | None = None

    def prepare(self, scene: RoadScene, steps: int) -> None:
        """Compile, with a look at the road and the number of steps of plans."""
        seen = DriversSeen(self.traits, self.belief, self.time_step)
        seen.planned(seen.look(scene)[0], np.zeros((steps, 3), np.float32))
        seen.look(scene)

    def look(self, scene: RoadScene) -> tuple[RoadScene, Belief | None]:
        """Learn from a look at the road.

        Returns:
            The road, with the accelerations of others, and the traits of the drivers if they are estimated; and the
            probability of each model for the car on each path, None if it is not inferred.
        """
        seen, speeds = scene.names.tolist(), scene.states[:, 3].tolist()
        changes = [speed - self._speeds.get(name, speed) for name, speed in zip(seen, speeds, strict=True)]
        accelerations = np.nan_to_num(np.array(changes, np.float32) / self.time_step)
        scene = replace(scene, accelerations=accelerations.clip(-HARDEST, HARDEST).astype(np.float32))
        self._speeds = dict(zip(seen, speeds, strict=True))
        if not self.traits and not self.belief:
            return scene, None
        if self._before is None:
            self._known = _prior(scene), first_belief(len(scene.names))
        else:
            self._known = _update(self._known, *self._before, scene, self.time_step)
        estimates, belief = jax.tree.map(np.asarray, self._known)
        if self.traits:
            scene = replace(scene, traits=jax.tree.map(np.asarray, traits_of(estimates.mean)))
        return scene, belief if self.belief else None

    def planned(self, scene: RoadScene, path: Path) -> None:
        """Remember the robot's plan on the road that it looked at last; an empty one ends all learning until now."""
        self._before = (scene, path) if len(path) else None
