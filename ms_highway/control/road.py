"""Drive on a road: choose how to predict each car, plan, and fall back where a plan is none."""

from dataclasses import dataclass, replace
from functools import cache, partial
from time import perf_counter

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float, Int

from ms_highway.control.drivers_seen import DriversSeen
from ms_highway.game.road import TRAFFIC, RoadScene, Traits
from ms_highway.metareasoning.road import RoadCosts, RungChoice
from ms_highway.metareasoning.road_belief import counted_on
from ms_highway.planning.road.plan import (
    REFINED,
    Memory,
    RoadPlan,
    first_memory,
    highest_gains,
    plan_road,
    propose,
)
from ms_highway.planning.road.proposals import FULL_BRAKING, LAST_PLAN
from ms_highway.planning.road.settings import RUNGS, TOM, RoadPlanning, RoadWeights
from ms_highway.planning.road.traffic import situation_of
from ms_highway.runtime.compilation import quick_options
from ms_highway.runtime.forks import refuse_after_fork
from ms_highway.runtime.timing import timed, warm_up

__all__ = ["RoadDriver", "RoadStep"]

NOTICEABLE = 0.2  # share of a plan's time below which a model costs nothing
SOURCES = {REFINED: "refined", LAST_PLAN: "last plan"} | dict.fromkeys(FULL_BRAKING, "braking")
REPEATS = 5  # plans that are timed for the costs of models


@dataclass(frozen=True)
class RoadStep:
    """Record of one step of a driver.

    Attributes:
        control: curvature of the rear axle's path [1/m] and acceleration [m/s^2].
        path: x, y and heading of the robot's centre, as planned, world coordinates; no steps if the plan failed.
        predictions: x and y of others, world coordinates; no steps if the plan failed.
        rungs: name of the model that predicts each path of others; empty where none does.
        owners: number of the car that each path belongs to, -1 without one.
        gains: bounds on what each answer is worth [reward].
        planning_seconds: wall time of the plan, without compilation.
        decision_seconds: wall time of choosing the models.
        compile_seconds: wall time of compiling and measuring costs in this step.
        source: what drives: ``refined``, ``proposal``, ``last plan`` or ``braking``.
        broken: whether the best plan breaks a constraint: it hits somebody, leaves the road or lacks the room to stop.
        failed: whether the plan is not finite, so that the last plan or, without one, braking drives.
        traits: estimated of the driver on each path, None if they are not.
        belief: probability of each of `RUNGS` for the driver on each path, None if none is kept.
    """

    control: Float[np.ndarray, "2"]
    path: Float[np.ndarray, "steps 3"]
    predictions: Float[np.ndarray, "traffic steps 2"]
    rungs: tuple[str, ...]
    owners: Int[np.ndarray, "traffic"]
    gains: Float[np.ndarray, "traffic"]
    planning_seconds: float
    decision_seconds: float
    compile_seconds: float
    source: str
    broken: bool = False
    failed: bool = False
    traits: Traits | None = None
    belief: Float[np.ndarray, "traffic models"] | None = None


@cache
def _look_function() -> jax.stages.Wrapped:
    """Compile the gains, with others who keep their speed."""

    def look(scene: RoadScene, planning: RoadPlanning, weights: RoadWeights, memory: Memory) -> jax.Array:
        nobody = jnp.zeros(TRAFFIC, int)
        return highest_gains(propose(situation_of(scene, planning, weights), nobody, memory).scores)

    return jax.jit(look, compiler_options=quick_options())


@cache
def _plan_function(refines: bool) -> jax.stages.Wrapped:
    """Compile `plan_road` once for all scenes, rungs, limits and weights."""
    return jax.jit(partial(plan_road, refines=refines), compiler_options=quick_options())


class RoadDriver:
    """Drive a robot on any road, one step at a time.

    Args:
        planning: limits and wishes; may be replaced between steps.
        choice: of the models that predict others.
        refines: whether the best proposal is refined.
        weights: what counts.
        costs: of models; measured in the first step with others by default.
        traits: whether desired speeds and headways of others are estimated, and used to predict them.
        belief: whether the robot infers which model each driver follows, and counts on a yield only of those who have
            shown one.
    """

    def __init__(
        self,
        planning: RoadPlanning,
        choice: RungChoice,
        refines: bool = True,
        weights: RoadWeights | None = None,
        costs: RoadCosts | None = None,
        traits: bool = False,
        belief: bool = False,
    ) -> None:
        self.planning, self.choice, self.refines = planning, choice, refines
        self.weights = weights or RoadWeights()
        self.costs = costs
        self.traits, self.belief = traits, belief
        self.reset()

    def reset(self) -> None:
        """Forget the last plan, before a new episode."""
        self._memory = first_memory(self.planning)
        self._left = 0  # controls of the last plan that are left
        self._seen = DriversSeen(self.traits, float(self.planning.time_step))

    def step(self, scene: RoadScene) -> RoadStep:
        """Return what to do now."""
        refuse_after_fork()
        begin, looking = perf_counter(), 0.0
        if self.traits or self.belief:
            if self._left == 0:
                self._seen.prepare(scene, self.planning.steps)
            start = perf_counter()
            scene = self._seen.look(scene)
            looking = perf_counter() - start
        belief = self._seen.belief if self.belief else None
        costs = self._prepared(scene)
        compiling = perf_counter() - begin - looking
        start = perf_counter()
        gains = np.zeros(TRAFFIC, np.float32)
        if self.choice.looks:
            gains = np.asarray(_look_function()(scene, self.planning, self.weights, self._memory))
        if belief is not None:
            gains = gains * belief[:, TOM]
        deciding = looking + perf_counter() - start
        rungs = np.where(scene.moving & scene.present, self.choice.choose(gains, costs, deciding), 0)
        if belief is not None:
            rungs = counted_on(rungs, belief)
        deciding = looking + perf_counter() - start
        plan, seconds = self._planned(scene, rungs.astype(np.int32))
        plan = jax.tree.map(np.asarray, plan)
        step = self._taken(scene, plan, rungs, gains, seconds, deciding, compiling)
        self._seen.planned(scene, step.path)
        return replace(step, traits=scene.traits, belief=belief)

    def _planned(self, scene: RoadScene, rungs: Int[np.ndarray, "traffic"]) -> tuple[RoadPlan, float]:
        return timed(_plan_function(self.refines), scene, self.planning, self.weights, rungs, self._memory)

    def _taken(
        self,
        scene: RoadScene,
        plan: RoadPlan,
        rungs: Int[np.ndarray, "traffic"],
        gains: Float[np.ndarray, "traffic"],
        planning: float,
        deciding: float,
        compiling: float,
    ) -> RoadStep:
        """Remember a plan, or fall back where it is not finite."""
        controls, path, predictions = map(np.asarray, (plan.controls, plan.path, plan.predictions))
        hardest = bool(plan.broken) and controls[0, 1] < -0.95 * self.planning.grip
        source = "braking" if hardest else SOURCES.get(int(plan.chosen), "proposal")
        names = tuple(RUNGS[rung] if there else "" for rung, there in zip(rungs, scene.present, strict=True))
        failed = not np.isfinite(controls).all()
        if not failed:
            self._left = len(controls)
        elif self._left > 0:
            controls, source = np.asarray(self._memory.controls), "last plan"
        else:
            controls, source = np.tile(np.array([0.0, -self.planning.grip], np.float32), (len(controls), 1)), "braking"
        self._left -= 1
        self._memory = Memory(np.concatenate([controls[1:], controls[-1:]]), path[-1, :2])
        if failed:
            path, predictions, names = path[:0], predictions[:, :0], ("",) * len(names)
        return RoadStep(
            control=controls[0].astype(float),
            path=path,
            predictions=predictions,
            rungs=names,
            owners=np.asarray(scene.owners),
            gains=gains,
            planning_seconds=planning,
            decision_seconds=deciding,
            compile_seconds=compiling,
            source=source,
            broken=bool(plan.broken),
            failed=failed,
        )

    def _prepared(self, scene: RoadScene) -> RoadCosts:
        """Compile, and return what models cost, measured once there are others if the choice looks at it."""
        given = scene, self.planning, self.weights
        warm_up(_plan_function(self.refines), *given, np.zeros(TRAFFIC, np.int32), self._memory)
        if self.choice.looks:
            warm_up(_look_function(), *given, self._memory)
        if self.costs is None and self.choice.looks and np.any(scene.moving & scene.present):
            self.costs = self._measured(scene)
        return self.costs or RoadCosts(0.0, np.zeros(len(RUNGS)))

    def _measured(self, scene: RoadScene) -> RoadCosts:
        others = np.asarray(scene.moving & scene.present)

        def median(rung: int) -> float:
            rungs = np.where(others, rung, 0).astype(np.int32)
            return float(np.median([self._planned(scene, rungs)[1] for _ in range(REPEATS)]))

        whole = np.array([median(rung) for rung in range(len(RUNGS))])
        more = np.where(whole > (1 + NOTICEABLE) * whole[0], whole - whole[0], 0.0)
        return RoadCosts(float(whole[0]), more / others.sum())
