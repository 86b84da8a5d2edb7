"""Decide live: compiled once, called with few arguments, timed warm."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import recover_control
from ms_highway.game.features import reward
from ms_highway.game.game import Game
from ms_highway.metareasoning.rule import Decision, Memory, Outcome, Rule
from ms_highway.planning.human_models import JointPlan
from ms_highway.runtime.compilation import QUICKLY, in_one_kernel, known_options
from ms_highway.runtime.packing import Layout, pack
from ms_highway.runtime.timing import timed, warm_up

__all__ = ["CompiledDecision", "Observation", "decide_function"]


EMPTY = jax.tree.structure(None)  # of the network of a rule that has none


class Observation(NamedTuple):
    """A step of the world that a decision is based on, in the world's units: cars, executed control, and both plans."""

    before: Float[np.ndarray, "cars 4"]
    after: Float[np.ndarray, "cars 4"]
    control: Float[np.ndarray, "2"]
    plan: tuple[Float[np.ndarray, "steps 2"], Float[np.ndarray, "steps 2"]]


class CompiledDecision:
    """Decide by a rule in a game, compiled once for all rules and games of the same shapes.

    Args:
        rule: chooses the model.
        game: may differ in numbers from the games that it was compiled for.
    """

    def __init__(self, rule: Rule, game: Game) -> None:
        small = rule if rule.network is None else replace(rule, network=None)
        self._numbers, self._layout = pack((small, game))
        leaves, self._network = jax.tree.flatten(rule.network)
        self._leaves = [jnp.asarray(leaf) for leaf in leaves]
        self._steps, self._rungs, self._fuses = game.planner.horizon, len(rule.ladder), rule.in_one_kernel

    def decide(self, memory: Memory, observed: Observation) -> tuple[Decision, float]:
        """Return the decision, in NumPy numbers, and the seconds that it took.

        Args:
            memory: of the steps before.
            observed: the last step.
        """
        decided, seconds = timed(self.function, *self.arguments(memory, observed))
        parts = np.split(np.asarray(decided), [1, 2, 2 + self._rungs, 2 + 2 * self._rungs])
        rung, step, checks = (part.astype(np.int32) for part in parts[:3])
        return Decision(Memory(rung[0], step[0], checks), parts[3], parts[4][0] > 0), seconds

    def warm_up(self, memory: Memory, state: Float[np.ndarray, "cars 4"]) -> float:
        """Compile and run once what has not run before; return the seconds spent."""
        return warm_up(self.function, *self.arguments(memory, self.nothing_happened(state)))

    def nothing_happened(self, state: Float[np.ndarray, "cars 4"]) -> Observation:
        """Return the step before the first one, in which no car moved."""
        still = np.zeros((self._steps, 2))
        return Observation(state, state, still[0], (still, still))

    @property
    def function(self) -> jax.stages.Wrapped:
        """Compiled function, which takes `arguments`; see `decide_function`."""
        return decide_function(self._layout, self._network, self._fuses)

    def arguments(self, memory: Memory, observed: Observation) -> tuple[np.ndarray | jax.Array, ...]:
        """Return the arguments of a `decide_function`."""
        *world, plan = observed
        parts = [np.ravel(part) for part in (*memory, *plan, *world)]
        return np.concatenate(parts, dtype=np.float32), self._numbers, *self._leaves


@cache
def decide_function(layout: Layout, network: jax.tree_util.PyTreeDef = EMPTY, fuses: bool = True) -> jax.stages.Wrapped:
    """Compile a rule's decisions once for all of a layout.

    The compiled function takes memory and `Observation` in one array, the packed (rule, game) and the leaves of the
    rule's network. It returns the `Decision` in one array. Where there is a network, it stays outside of the kernel,
    which would copy it. Without ``fuses``, there is no kernel, see `ms_highway.metareasoning.rule.Rule`.
    """

    def look(observed: Float[jax.Array, "m"], numbers: Float[jax.Array, "n"]) -> Float[jax.Array, "k"]:
        rule, game = layout.unpack(numbers)
        scale, planned = game.planner.control_scale, 4 * game.planner.horizon
        memory, rest = _memory(rule, observed)
        plan, cars, control = jnp.split(rest, [planned, len(rest) - 2])
        before, after = cars.reshape(2, -1, 4)
        human = recover_control(game.world, before[1], after[1]) / scale
        earned = reward(game.scene, game.robot, after)
        expected = JointPlan(*(plan.reshape(2, -1, 2) / scale))
        return rule.look(game, memory, Outcome(before, after, control / scale, human, earned, expected))

    def look_and_choose(
        observed: Float[jax.Array, "m"], numbers: Float[jax.Array, "n"], *leaves: jax.Array
    ) -> Float[jax.Array, "k"]:
        rule, _ = layout.unpack(numbers)
        memory, _ = _memory(rule, observed)
        seen = (in_one_kernel(look) if leaves and fuses else look)(observed, numbers)
        rule = replace(rule, network=jax.tree.unflatten(network, leaves)) if leaves else rule
        (rung, step, checks), gains, failed = rule.choose(memory, seen)
        return jnp.concatenate([jnp.stack([rung, step]), checks, gains, failed[None]])

    whole = fuses and network == EMPTY
    return jax.jit(
        in_one_kernel(look_and_choose) if whole else look_and_choose, compiler_options=known_options(QUICKLY)
    )


def _memory(rule: Rule, observed: Float[jax.Array, "m"]) -> tuple[Memory, Float[jax.Array, "n"]]:
    """Return the memory at the beginning of an array, and the rest of it."""
    remembered = 2 + len(rule.ladder)
    rung, step, *checks = observed[:remembered].astype(jnp.int32)
    return Memory(rung, step, jnp.stack(checks)), observed[remembered:]
