"""Decisions as a car needs them live: compiled once, called with few arguments, timed warm."""

from functools import cache, partial
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import recover_control
from ms_highway.game.features import reward
from ms_highway.game.game import Game
from ms_highway.metareasoning.switching import Decision, Memory, Switching, decide
from ms_highway.runtime.compilation import QUICKLY, in_one_kernel, known_options
from ms_highway.runtime.packing import Layout, pack
from ms_highway.runtime.timing import timed, warm_up

__all__ = ["CompiledDecision", "Observation", "decide_function"]


class Observation(NamedTuple):
    """What a decision looks at: a step of the world, in the world's units."""

    before: Float[np.ndarray, "cars 4"]
    control: Float[np.ndarray, "2"]
    after: Float[np.ndarray, "cars 4"]


class CompiledDecision:
    """The decisions of Algorithm 1 in a game, compiled once for all games of the same shapes.

    Args:
        switching: ladder, costs, lambda and the numbers of the algorithm.
        game: what is played.
    """

    def __init__(self, switching: Switching, game: Game) -> None:
        self._numbers, self._layout = pack((switching, game))

    def decide(self, memory: Memory, observed: Observation) -> tuple[Decision, float]:
        """The decision, in NumPy numbers, and the seconds that it took.

        Args:
            memory: of the steps before.
            observed: the last step: all cars before it, the control that the robot executed, all cars after it.
        """
        decided, seconds = timed(self.function, *self.arguments(memory, observed))
        rung, step, *checks, up, down = np.asarray(decided)
        memory = Memory(*(np.asarray(part, dtype=np.int32) for part in (rung, step, checks)))
        return Decision(memory, up, down), seconds

    def warm_up(self, memory: Memory, state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile and run once what has not run before; seconds spent, 0 if it was warm already."""
        arguments = self.arguments(memory, Observation(state, np.zeros(2), state))
        return warm_up(self.function, *arguments)

    @property
    def function(self) -> jax.stages.Wrapped:
        """The compiled function, which takes `arguments`; see `decide_function`."""
        return decide_function(self._layout)

    def arguments(self, memory: Memory, observed: Observation) -> tuple[np.ndarray, np.ndarray]:
        """What a `decide_function` takes."""
        parts = [np.ravel(part) for part in (*memory, *observed)]
        return np.concatenate(parts, dtype=np.float32), self._numbers


@cache
def decide_function(layout: Layout) -> jax.stages.Wrapped:
    """`decide`, compiled once for all that decide so.

    The compiled function takes an `observation` with the robot's control in the units of the world, and the numbers of
    a packed (Switching, Game). It returns the new memory, packed, and the gains of going up and down.
    """

    @partial(jax.jit, compiler_options=known_options(QUICKLY))
    @in_one_kernel
    def observe_and_decide(observed: Float[jax.Array, "m"], numbers: Float[jax.Array, "n"]) -> Float[jax.Array, "k"]:
        switching, game = layout.unpack(numbers)
        remembered = 2 + len(switching.ladder)
        (rung, step, *checks), rest = observed[:remembered].astype(jnp.int32), observed[remembered:]
        before, control, after = jnp.split(rest, [(len(rest) - 2) // 2, (len(rest) + 2) // 2])
        before, after = before.reshape(-1, 4), after.reshape(-1, 4)
        scale = game.planner.control_scale
        human = recover_control(game.world, before[1], after[1]) / scale
        earned = reward(game.scene, game.robot, after)
        decision = decide(
            switching, game, Memory(rung, step, jnp.stack(checks)), before, control / scale, human, earned
        )
        memory = decision.memory
        return jnp.stack([memory.rung, memory.step, *memory.last_check, decision.gain_up, decision.gain_down])

    return observe_and_decide
