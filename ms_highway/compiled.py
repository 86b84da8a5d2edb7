"""Compiled computations for those that plan live: compiled once, called with few arguments, timed warm.

Calling a compiled function costs about a microsecond per argument, which counts where a plan takes a hundred; so the
numbers of a game travel as one array.
"""

import os
from collections.abc import Callable, Hashable, Sequence
from functools import cache, partial
from math import prod
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.dynamics import recover_control
from ms_highway.game import Game
from ms_highway.human_models import HumanModel, JointPlan, cold_start
from ms_highway.reward import reward
from ms_highway.switching import Decision, Memory, decide

__all__ = [
    "Packed",
    "checked_state",
    "decide_function",
    "keep_compilations",
    "measure_costs",
    "pack",
    "plan_function",
    "timed",
    "warm_up",
]

State = Float[jax.Array, "cars 4"]


QUICKLY = {"xla_cpu_use_fusion_emitters": False}
"""Compiler options that halve compilation; they cost small plans a tenth of their speed, and large ones nothing."""


class Layout(NamedTuple):
    """What has to be known, beside its numbers, to build a pytree of arrays; hashable."""

    structure: jax.tree_util.PyTreeDef
    shapes: tuple[tuple[int, ...], ...]

    def unpack(self, numbers: Float[jax.Array, "n"]) -> Any:
        """The pytree of these numbers."""
        ends = np.cumsum([prod(shape) for shape in self.shapes])
        leaves = jnp.split(numbers, ends[:-1])
        return jax.tree.unflatten(
            self.structure, [leaf.reshape(shape) for leaf, shape in zip(leaves, self.shapes, strict=True)]
        )


class Packed(NamedTuple):
    """A pytree as one array of numbers, and how to build it again."""

    numbers: Float[jax.Array, "n"]
    layout: Layout


def pack(tree: Any) -> Packed:
    """A pytree of numbers, packed in float32."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [np.asarray(leaf, dtype=np.float32) for leaf in leaves]
    return Packed(
        jnp.asarray(np.concatenate([array.ravel() for array in arrays])),
        Layout(structure, tuple(array.shape for array in arrays)),
    )


@cache
def plan_function(model: HumanModel, layout: Layout) -> jax.stages.Wrapped:
    """``model.plan``, of a packed game, the state, and the plan to start from: compiled once for all that plan so."""

    @partial(jax.jit, compiler_options=QUICKLY if model.responds else None)
    def plan(numbers: Float[jax.Array, "n"], state: State, start: JointPlan) -> JointPlan:
        return model.plan(layout.unpack(numbers), state, start)

    return plan


@cache
def decide_function(layout: Layout) -> jax.stages.Wrapped:
    """`decide`, of a packed (Switching, Game) and of what was observed around the executed step.

    The compiled function takes the numbers, the memory, all cars before the step, the robot's control in the units of
    the world, and all cars after it.
    """

    @partial(jax.jit, compiler_options=QUICKLY)
    def observe_and_decide(
        numbers: Float[jax.Array, "n"], memory: Memory, before: State, control: Float[jax.Array, "2"], after: State
    ) -> Decision:
        switching, game = layout.unpack(numbers)
        scale = game.planner.control_scale
        human = recover_control(game.world, before[1], after[1]) / scale
        observed = reward(game.scene, game.robot, after)
        return decide(switching, game, memory, before, control / scale, human, observed)

    return observe_and_decide


_warm: set[Hashable] = set()  # compiled functions that have run with arguments of these shapes


def warm_up(function: Callable[..., Any], *arguments: Any) -> float:
    """Compile and run once what has not run before; seconds spent, 0 if it was warm already."""
    leaves, structure = jax.tree.flatten(arguments)
    key = (function, structure, tuple(np.shape(leaf) for leaf in leaves))
    if key in _warm:
        return 0.0
    start = perf_counter()
    jax.block_until_ready(function(*arguments))
    _warm.add(key)
    return perf_counter() - start


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Result of a warm computation, and the seconds it took until the result was there."""
    start = perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, perf_counter() - start


def checked_state(state: Float[np.ndarray, "cars 4"]) -> Float[np.ndarray, "cars 4"]:
    """A copy of the state in the core's precision; compiled functions take it over faster than JAX converts it.

    Raises:
        ValueError: if it is not a finite array [cars, 4] of two cars or more.
    """
    state = np.asarray(state)
    if state.ndim != 2 or state.shape[0] < 2 or state.shape[1] != 4:
        raise ValueError(f"a state has shape [cars, 4] with the robot, its partner and any others; got {state.shape}")
    if not np.isfinite(state).all():
        car, column = np.argwhere(~np.isfinite(state))[0]
        raise ValueError(
            f"the state of car {car} is not finite: {['x', 'y', 'heading', 'speed'][column]} is {state[car, column]}"
        )
    return state.astype(np.float32)


def measure_costs(
    game: Game, ladder: Sequence[HumanModel], state: Float[np.ndarray, "cars 4"], repeats: int = 20
) -> Float[np.ndarray, "rungs"]:
    """T(M) on this machine: the median seconds of a warm plan in this state, for each model.

    Raises:
        ValueError: if the state is not a finite array [cars, 4] of two cars or more.
    """
    numbers, layout = pack(game)
    arguments = numbers, checked_state(state), cold_start(game)
    costs = []
    for model in ladder:
        function = plan_function(model, layout)
        warm_up(function, *arguments)
        costs.append(median(timed(function, *arguments)[1] for _ in range(repeats)))
    return np.array(costs)


def keep_compilations(directory: Path | None = None) -> Path:
    """Keep compiled functions in a directory of the user's, for later runs; returns it.

    Args:
        directory: where; ``ms_highway`` in the user's cache directory without.
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    directory = directory or home / "ms_highway" / "compiled"
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    return directory
