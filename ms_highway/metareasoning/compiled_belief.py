"""Infer live which model every human follows: compiled once, timed warm."""

from functools import cache

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Bool, Float

from ms_highway.game.crowd import Crowd
from ms_highway.game.dynamics import recover_control
from ms_highway.metareasoning.belief import updated_belief
from ms_highway.planning.hypotheses import next_controls
from ms_highway.planning.road.settings import RUNGS
from ms_highway.runtime.compilation import QUICKLY, in_one_kernel, known_options
from ms_highway.runtime.packing import Layout, pack
from ms_highway.runtime.timing import timed, warm_up

__all__ = ["CompiledBelief", "belief_function", "counted_on"]

LEAST_RESPONSE = 0.3  # probability of turn or tom below which nobody counts on a human
RESPONDING = [RUNGS.index(name) for name in ("turn", "tom")]


class CompiledBelief:
    """Infer which model predicts every human best, compiled once for all crowds of the same shapes.

    Args:
        crowd: the game, with the humans' rewards as the robot believes them.

    Attributes:
        first: probabilities before anything was seen, the same for all models.
    """

    def __init__(self, crowd: Crowd) -> None:
        self.first: Float[np.ndarray, "humans models"] = np.full((crowd.humans, len(RUNGS)), 1 / len(RUNGS), np.float32)
        self._numbers, layout = pack(crowd)
        self._function = belief_function(layout)

    def update(
        self,
        belief: Float[np.ndarray, "humans models"],
        before: Float[np.ndarray, "cars 4"],
        after: Float[np.ndarray, "cars 4"],
        robot: Float[np.ndarray, "steps 2"],
    ) -> tuple[Float[np.ndarray, "humans models"], float]:
        """Return the probabilities of the models after a step, and the seconds that it took.

        Args:
            belief: probabilities before the step; before the first one, those of ``first``.
            before: all cars before the step.
            after: all cars after it.
            robot: scaled controls that the robot followed from there on.
        """
        single = (np.asarray(part, np.float32) for part in (belief, before, after, robot))
        updated, seconds = timed(self._function, self._numbers, *single)
        return np.asarray(updated), seconds

    def warm_up(self, state: Float[np.ndarray, "cars 4"], robot: Float[np.ndarray, "steps 2"]) -> float:
        """Compile and run once what has not run before; return the seconds spent."""
        single = (np.asarray(part, np.float32) for part in (self.first, state, state, robot))
        return warm_up(self._function, self._numbers, *single)


@cache
def belief_function(layout: Layout) -> jax.stages.Wrapped:
    """Compile `ms_highway.metareasoning.belief.updated_belief` once for all crowds of a layout.

    The compiled function takes the numbers of a packed crowd and what `CompiledBelief.update` takes.
    """

    def update(
        numbers: Float[jax.Array, "n"],
        belief: Float[jax.Array, "humans models"],
        before: Float[jax.Array, "cars 4"],
        after: Float[jax.Array, "cars 4"],
        robot: Float[jax.Array, "steps 2"],
    ) -> Float[jax.Array, "humans models"]:
        crowd: Crowd = layout.unpack(numbers)
        last = 1 + crowd.humans
        observed = recover_control(crowd.game.world, before[1:last], after[1:last])
        predicted = next_controls(crowd, before, robot)
        return updated_belief(belief, predicted, observed, jnp.asarray(crowd.game.world.time_step))

    return jax.jit(in_one_kernel(update), compiler_options=known_options(QUICKLY))


def counted_on(belief: Float[np.ndarray, "humans models"]) -> Bool[np.ndarray, "humans"]:
    """Return who may be counted on to respond: all but those whose actions turn and tom do not explain."""
    return belief[:, RESPONDING].sum(axis=1) >= LEAST_RESPONSE
