"""Decide live: compiled once, called with few arguments, timed warm."""

from dataclasses import replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from ms_highway.game.dynamics import recover_control
from ms_highway.game.features import reward
from ms_highway.game.game import Game
from ms_highway.metareasoning.rule import NOT_ESTIMATED, Decision, Memory, Outcome, Rule, first_memory
from ms_highway.planning.plans import Plan
from ms_highway.runtime.arrays import Array, Control, State, Vector
from ms_highway.runtime.compilation import Layout, in_one_kernel, pack, quick_options
from ms_highway.runtime.timing import timed, warm_up

EMPTY = jax.tree.structure(None)  # of the network of a rule that has none


class Observation(NamedTuple):
    """A step of the world that a decision is based on, in the world's units: cars, executed control, and plan."""

    before: State
    after: State
    control: Control
    plan: Plan


class CompiledDecision:
    """Decide by a rule in a game, compiled once for all rules and games of the same shapes.

    Args:
        rule: chooses the models.
        game: may differ in numbers from the games that it was compiled for.
    """

    def __init__(self, rule: Rule, game: Game) -> None:
        self._network = network = getattr(rule, "network", None)
        self._numbers, self._layout = pack((rule if network is None else replace(rule, network=None), game))
        self.rule, self.game = rule, game

    def __reduce__(self) -> tuple[Any, ...]:
        return CompiledDecision, (self.rule, self.game)  # compiled functions cannot be pickled

    @cached_property
    def _leaves(self) -> list[jax.Array]:
        return [jnp.asarray(leaf) for leaf in jax.tree.leaves(self._network)]

    @cached_property
    def function(self) -> jax.stages.Wrapped:
        """See `decide_function`; made at the first call, as JAX must not begin before the first step."""
        fuses = self.game.number == 1 and getattr(self.rule, "in_one_kernel", False)
        return decide_function(self._layout, jax.tree.structure(self._network), fuses)

    def decide(self, memory: Memory, observed: Observation) -> tuple[Decision, float]:
        """Return the decision, in NumPy arrays, with NaN where no gain was estimated, and the seconds that it took.

        Args:
            memory: of the steps before.
            observed: the last step.
        """
        decided, seconds = timed(self.function, *self.arguments(memory, observed))
        humans, rungs = self.game.number, len(self.rule.ladder)
        numbers, table = np.array(decided), (humans, rungs)
        chosen, step, checks, gains, failed = np.split(numbers, np.cumsum([humans, 1, humans * rungs, humans * rungs]))
        after = Memory(chosen.astype(np.int32), step[0].astype(np.int32), checks.astype(np.int32).reshape(table))
        gains = np.where(gains == NOT_ESTIMATED, np.nan, gains)
        return Decision(after, gains.reshape(table), failed[0] > 0), seconds

    def warm_up(self, state: State) -> float:
        """Compile and run once what has not run before; return the seconds spent."""
        return warm_up(self.function, *self.arguments(first_memory(self.rule, self.game.number), self.still(state)))

    def measure(self, state: State, repeats: int = 20, quantile: float = 0.5) -> float:
        """Measure the seconds of a warm decision in a state: a quantile, by default the median."""
        self.warm_up(state)
        later = first_memory(self.rule, self.game.number)._replace(step=np.ones((), np.int32))  # the first may be less
        return float(np.quantile([self.decide(later, self.still(state))[1] for _ in range(repeats)], quantile))

    def still(self, state: State) -> Observation:
        """Return the step before the first one, in which no car moved."""
        still = np.zeros((1 + self.game.number, self.game.planner.horizon, 2))
        return Observation(state, state, still[0, 0], Plan(still[0], still[1:]))

    def arguments(self, memory: Memory, observed: Observation) -> tuple[Array, ...]:
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

    def look(observed: Vector, numbers: Vector) -> Array:
        rule, game = layout.unpack(numbers)
        scale, horizon, last = game.planner.control_scale, game.planner.horizon, 1 + game.number
        memory, rest = _memory(rule, game, observed)
        plan, cars, control = jnp.split(rest, [2 * horizon * last, len(rest) - 2])
        before, after = cars.reshape(2, -1, 4)
        humans = recover_control(game.world, before[1:last], after[1:last]) / scale
        earned = reward(game.scene, game.robot, after)
        robot, *expected = plan.reshape(last, -1, 2) / scale
        outcome = Outcome(before, after, control / scale, humans, earned, Plan(robot, jnp.stack(expected)))
        return rule.look(game, memory, outcome)

    def look_and_choose(observed: Vector, numbers: Vector, *leaves: Array) -> Vector:
        rule, game = layout.unpack(numbers)
        memory, _ = _memory(rule, game, observed)
        seen = (in_one_kernel(look) if leaves and fuses else look)(observed, numbers)
        rule = replace(rule, network=jax.tree.unflatten(network, leaves)) if leaves else rule
        (rungs, step, checks), gains, failed = rule.choose(memory, seen)
        return jnp.concatenate([rungs, step[None], checks.ravel(), gains.ravel(), failed[None]])

    whole = fuses and network == EMPTY
    return jax.jit(in_one_kernel(look_and_choose) if whole else look_and_choose, compiler_options=quick_options())


def _memory(rule: Rule, game: Game, observed: Vector) -> tuple[Memory, Vector]:
    """Return the memory at the beginning of an array, and the rest of it."""
    humans, rungs = game.number, len(rule.ladder)
    remembered = humans + 1 + humans * rungs
    numbers = observed[:remembered].astype(jnp.int32)
    checks = numbers[humans + 1 :].reshape(humans, rungs)
    return Memory(numbers[:humans], numbers[humans], checks), observed[remembered:]
