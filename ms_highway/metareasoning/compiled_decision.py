"""Decide live: compiled once, called with few arguments, timed warm."""

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
    """A step of the world that a decision is based on, in the world's units."""

    before: Float[np.ndarray, "cars 4"]
    control: Float[np.ndarray, "2"]
    after: Float[np.ndarray, "cars 4"]


class CompiledDecision:
    """Decide by Algorithm 1 in a game, compiled once for all games of the same shapes.

    Args:
        switching: ladder, costs, lambda and the numbers of the algorithm.
        game: may differ in numbers from the games that it was compiled for.
    """

    def __init__(self, switching: Switching, game: Game) -> None:
        self._numbers, self._layout = pack((switching, game))

    def decide(self, memory: Memory, observed: Observation) -> tuple[Decision, float]:
        """Return the decision, in NumPy numbers, and the seconds that it took.

        Args:
            memory: of the steps before.
            observed: the last step.
        """
        decided, seconds = timed(self.function, *self.arguments(memory, observed))
        rung, step, *checks, up, down = np.asarray(decided)
        memory = Memory(*(np.asarray(part, dtype=np.int32) for part in (rung, step, checks)))
        return Decision(memory, up, down), seconds

    def warm_up(self, memory: Memory, state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile and run once what has not run before; return the seconds spent."""
        arguments = self.arguments(memory, Observation(state, np.zeros(2), state))
        return warm_up(self.function, *arguments)

    @property
    def function(self) -> jax.stages.Wrapped:
        """Compiled function, which takes `arguments`; see `decide_function`."""
        return decide_function(self._layout)

    def arguments(self, memory: Memory, observed: Observation) -> tuple[np.ndarray, np.ndarray]:
        """Return the arguments of a `decide_function`."""
        parts = [np.ravel(part) for part in (*memory, *observed)]
        return np.concatenate(parts, dtype=np.float32), self._numbers


@cache
def decide_function(layout: Layout) -> jax.stages.Wrapped:
    """Compile `decide` once for all of a layout.

    The compiled function takes memory and `Observation` in one array, and the numbers of a packed (Switching, Game). It
    returns the new memory and the gains of going up and down in one array.
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
