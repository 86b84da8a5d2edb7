"""Decide live for a crowd: compiled once, timed warm."""

from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.crowd import Crowd
from ms_highway.game.dynamics import recover_control
from ms_highway.game.features import reward
from ms_highway.metareasoning.crowd.rule import CrowdDecision, CrowdMemory, CrowdOutcome, CrowdRule, first_crowd_memory
from ms_highway.planning.crowd import CrowdPlan
from ms_highway.runtime.compilation import QUICKLY, known_options
from ms_highway.runtime.packing import Layout, pack
from ms_highway.runtime.timing import timed, warm_up

__all__ = ["CompiledCrowdDecision", "CrowdObservation", "crowd_decision_function"]


class CrowdObservation(NamedTuple):
    """A step of the world that a decision is based on; controls are scaled.

    Attributes:
        before, after: all cars.
        control: that the robot executed.
        plan: that the robot followed, and the humans' controls that it expected.
    """

    before: Float[np.ndarray, "cars 4"]
    after: Float[np.ndarray, "cars 4"]
    control: Float[np.ndarray, "2"]
    plan: CrowdPlan


class CompiledCrowdDecision:
    """Decide by a rule in a crowd, compiled once for all rules and crowds of the same shapes.

    Args:
        rule: chooses the rungs.
        crowd: may differ in numbers from the crowds that it was compiled for.
    """

    def __init__(self, rule: CrowdRule, crowd: Crowd) -> None:
        self.crowd = crowd
        self._numbers, self._layout = pack((rule, crowd))

    def decide(self, memory: CrowdMemory, observed: CrowdObservation) -> tuple[CrowdDecision, float]:
        """Return the decision, in NumPy arrays, and the seconds that it took.

        Args:
            memory: of the steps before.
            observed: the last step.
        """
        decision, seconds = timed(crowd_decision_function(self._layout), self._numbers, memory, _single(observed))
        return jax.tree.map(np.asarray, decision), seconds

    def warm_up(self, state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile and run once what has not run before; return the seconds spent."""
        first, still = first_crowd_memory(self.crowd.humans), _single(self.nothing_happened(state))
        return warm_up(crowd_decision_function(self._layout), self._numbers, first, still)

    def measure(self, state: Float[np.ndarray, "cars 4"], repeats: int = 20, quantile: float = 0.5) -> float:
        """Measure the seconds of a warm decision in a state: a quantile, by default the median."""
        self.warm_up(state)
        memory, still = first_crowd_memory(self.crowd.humans), self.nothing_happened(state)
        later = memory._replace(step=np.ones((), np.int32))  # rules may have less to do before the first step
        return float(np.quantile([self.decide(later, still)[1] for _ in range(repeats)], quantile))

    def nothing_happened(self, state: Float[np.ndarray, "cars 4"]) -> CrowdObservation:
        """Return the step before the first one, in which no car moved."""
        still: Any = np.zeros((1 + self.crowd.humans, self.crowd.game.planner.horizon, 2), np.float32)
        return CrowdObservation(state, state, still[0, 0], CrowdPlan(still[0], still[1:]))


def _single(observed: CrowdObservation) -> CrowdObservation:
    """Return an observation in single precision."""
    return jax.tree.map(lambda part: np.asarray(part, np.float32), observed)


@cache
def crowd_decision_function(layout: Layout) -> jax.stages.Wrapped:
    """Compile a rule's decisions once for all of a layout.

    The compiled function takes the packed (rule, crowd), the memory and a `CrowdObservation`.
    """

    def decide(numbers: Float[jax.Array, "n"], memory: CrowdMemory, observed: CrowdObservation) -> CrowdDecision:
        rule, crowd = layout.unpack(numbers)
        game, last = crowd.game, 1 + crowd.humans
        executed = recover_control(game.world, observed.before[1:last], observed.after[1:last])
        earned = reward(game.scene, game.robot, observed.after)
        scale = jnp.asarray(game.planner.control_scale)
        outcome = CrowdOutcome(
            observed.before, observed.after, observed.control, executed / scale, earned, observed.plan
        )
        return rule.choose(crowd, memory, outcome)

    return jax.jit(decide, compiler_options=known_options(QUICKLY))
