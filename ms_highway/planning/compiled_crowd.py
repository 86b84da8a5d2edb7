"""Plan live among several humans: compiled once for all assignments of models, timed warm."""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.game.crowd import Crowd
from ms_highway.game.dynamics import keep_velocity
from ms_highway.planning.compiled_plans import checked_state
from ms_highway.planning.crowd import RUNGS, CrowdPlan, plan_crowd, predict_human
from ms_highway.planning.way_out import Escape, keep_way_out
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.compilation import QUICKLY, known_options
from ms_highway.runtime.forks import refuse_after_fork
from ms_highway.runtime.packing import Layout, pack
from ms_highway.runtime.timing import timed, warm_up

__all__ = [
    "CompiledCrowdPlans",
    "CrowdCosts",
    "crowd_plan_function",
    "first_crowd_plan",
    "human_plan_function",
    "measure_crowd_costs",
    "way_out_function",
]


class CrowdCosts(NamedTuple):
    """Planning time, additive in the humans: ``T(assignment) = base + sum_i each[rung_i]`` [s].

    Attributes:
        base: of a plan in which every human is predicted naively.
        each: what a human adds under each rung; 0 for the first.
    """

    base: float | Float[Array, ""]
    each: Float[Array, "rungs"]


class CompiledCrowdPlans:
    """Plan in a crowd, compiled once for all crowds of the same shapes and for all assignments of rungs.

    Args:
        crowd: may differ in numbers from the crowds that it was compiled for.
    """

    def __init__(self, crowd: Crowd) -> None:
        self.crowd = crowd
        self._numbers, self._layout = pack(crowd)

    def plan(
        self, state: Float[np.ndarray, "cars 4"], rungs: Sequence[int], start: CrowdPlan | None = None
    ) -> tuple[CrowdPlan, float]:
        """Return the scaled plan in a `checked_state`, in NumPy arrays, and the seconds that it took.

        Args:
            state: all cars now.
            rungs: of every human, numbers of `ms_highway.planning.crowd.RUNGS`.
            start: scaled plan to improve; by default, `first_crowd_plan`.
        """
        begin = first_crowd_plan(self.crowd, state) if start is None else start
        robot, humans = (np.asarray(side, np.float32) for side in begin)
        function = crowd_plan_function(self._layout)
        plan, seconds = timed(function, self._numbers, state, np.asarray(rungs, np.int32), robot, humans)
        return jax.tree.map(np.asarray, plan), seconds

    def keep_way_out(
        self, state: Float[np.ndarray, "cars 4"], control: Float[np.ndarray, "2"]
    ) -> tuple[Float[np.ndarray, "2"], bool, float]:
        """Return the scaled control to execute, whether it is an escape's, and the seconds that it took.

        See `ms_highway.planning.way_out.keep_way_out`.
        """
        escape, seconds = timed(way_out_function(self._layout), self._numbers, state, np.asarray(control, np.float32))
        return np.asarray(escape.control), bool(escape.replaced), seconds

    def predict(self, state: Float[np.ndarray, "cars 4"], human: int) -> tuple[Float[np.ndarray, "steps 2"], float]:
        """Return a human's scaled plan for its own reward, and the seconds that it took; humans drive by it."""
        plan, seconds = timed(human_plan_function(self._layout), self._numbers, state, np.asarray(human, np.int32))
        return np.asarray(plan), seconds

    def warm_up(self, state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile and run the plans if they have not run before; return the seconds spent."""
        rungs, begin = np.zeros(self.crowd.humans, np.int32), first_crowd_plan(self.crowd, state)
        seconds = warm_up(crowd_plan_function(self._layout), self._numbers, state, rungs, *begin)
        return seconds + warm_up(way_out_function(self._layout), self._numbers, state, np.zeros(2, np.float32))

    def warm_up_humans(self, state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile and run the humans' plans if they have not run before; return the seconds spent."""
        return warm_up(human_plan_function(self._layout), self._numbers, state, np.zeros((), np.int32))


def first_crowd_plan(crowd: Crowd, state: Float[np.ndarray, "cars 4"]) -> CrowdPlan:
    """Return the scaled plan that plans start from by default, see `plan_crowd`, in NumPy arrays."""
    planner, cars = crowd.game.planner, np.asarray(state, np.float32)[: 1 + crowd.humans]
    controls: Any = np.zeros((len(cars), planner.horizon, 2), np.float32)
    if planner.solver != "gradient":
        controls += (keep_velocity(crowd.game.dynamics, cars) / np.asarray(planner.control_scale))[:, None]
    return CrowdPlan(controls[0], controls[1:])


@cache
def crowd_plan_function(layout: Layout) -> jax.stages.Wrapped:
    """Compile `plan_crowd` once for all crowds of a layout.

    The compiled function takes the numbers of a packed crowd, all cars now, the rungs, and the robot's and the humans'
    scaled controls to start from.
    """

    def plan(numbers: jax.Array, state: jax.Array, rungs: jax.Array, robot: jax.Array, humans: jax.Array) -> CrowdPlan:
        return plan_crowd(layout.unpack(numbers), state, rungs, CrowdPlan(robot, humans))

    return jax.jit(plan, compiler_options=known_options(QUICKLY))


@cache
def way_out_function(layout: Layout) -> jax.stages.Wrapped:
    """Compile `keep_way_out` once for all crowds of a layout.

    The compiled function takes the numbers of a packed crowd, all cars now, and the robot's scaled control.
    """

    def escape(numbers: jax.Array, state: jax.Array, control: jax.Array) -> Escape:
        return keep_way_out(layout.unpack(numbers).game, state, control)

    return jax.jit(escape, compiler_options=known_options(QUICKLY))


@cache
def human_plan_function(layout: Layout) -> jax.stages.Wrapped:
    """Compile `predict_human` once for all humans of all crowds of a layout.

    The compiled function takes the numbers of a packed crowd, all cars now, and the number of the human.
    """

    def plan(numbers: jax.Array, state: jax.Array, human: jax.Array) -> jax.Array:
        return predict_human(layout.unpack(numbers), state, human)

    return jax.jit(plan, compiler_options=known_options(QUICKLY))


def measure_crowd_costs(
    crowd: Crowd, state: Float[np.ndarray, "cars 4"], repeats: int = 20, quantile: float = 0.5
) -> CrowdCosts:
    """Measure T, a plan and the check of its way out, by warm plans in this state with all humans under the same rung.

    Args:
        crowd: with one human at least.
        state: all cars.
        repeats: number of plans timed under each rung.
        quantile: of their seconds: the median by default; close to 1 for budgets.

    Raises:
        ValueError: if the state is not a finite array [cars, 4] of two cars or more.
    """
    refuse_after_fork()
    plans, now = CompiledCrowdPlans(crowd), checked_state(state)
    plans.warm_up(now)

    def once(rung: int) -> float:
        plan, seconds = plans.plan(now, [rung] * crowd.humans)
        return seconds + plans.keep_way_out(now, np.asarray(plan.robot[0]))[2]

    seconds = [[once(rung) for _ in range(repeats)] for rung in range(len(RUNGS))]
    whole = np.quantile(seconds, quantile, axis=1)
    return CrowdCosts(float(whole[0]), np.maximum(whole - whole[0], 0.0) / crowd.humans)
