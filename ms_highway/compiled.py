"""Compiled computations for those that plan live: compiled once, called with few arguments, timed warm.

Calling a compiled function costs about a microsecond per argument, which counts where a plan takes a hundred; so the
numbers of a game travel as one array.
"""

import os
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import cache, partial, wraps
from math import prod
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.compilations import check_owner, use_checked_cache
from ms_highway.dynamics import Array, recover_control
from ms_highway.game import Game
from ms_highway.human_models import HumanModel, JointPlan, cold_start, plan_within_limits
from ms_highway.reward import reward
from ms_highway.switching import Memory, decide

__all__ = [
    "Packed",
    "checked_state",
    "cores",
    "decide_function",
    "forget",
    "high_throughput",
    "in_one_kernel",
    "jit_quickly",
    "keep_compilations",
    "known_options",
    "low_latency",
    "measure_costs",
    "observation",
    "pack",
    "packed_memory",
    "plan_function",
    "refuse_after_fork",
    "timed",
    "warm_up",
]

State = Float[jax.Array, "cars 4"]

QUICKLY = {"xla_cpu_use_fusion_emitters": False}
"""Compiler options that halve compilation, where XLA knows them (JAX up to 0.11.0); they cost small plans a tenth of
their speed, and large ones nothing."""


KERNEL_BYTES = 100_000
"""Loops that touch less per iteration become one kernel: those of a plan or a decision do, those of batches, which
run faster as many vectorised kernels, do not."""


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

    numbers: Float[np.ndarray, "n"]
    layout: Layout


def pack(tree: Any) -> Packed:
    """A pytree of numbers, packed in float32; compiled functions take them over faster than JAX converts them."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [np.asarray(leaf, dtype=np.float32) for leaf in leaves]
    return Packed(
        np.concatenate([array.ravel() for array in arrays]),
        Layout(structure, tuple(array.shape for array in arrays)),
    )


def low_latency() -> None:
    """Set JAX up for many small computations on the CPU, before it computes anything.

    It holds for the whole process and for those that it starts. Two things make up much of a plan's time: handing a
    computation over to another thread, and starting a hundred kernels per iteration. The first is switched off; against
    the second, XLA is told to compile loops of up to `KERNEL_BYTES` per iteration as one kernel, as it does by itself
    only with much smaller ones. Where ``XLA_FLAGS`` has that option already or names a file, it stays as it is; and
    where JAX has begun already, plans are slower.

    The last digits of plans are others than without it, as everything that is compiled otherwise rounds otherwise.
    Chaotic episodes make much of them: in Stay Back, single episodes may end otherwise, and means over 30 of them
    differ in the first digit. So whoever compares with results of the command needs this call as well.
    """
    option = "xla_cpu_small_while_loop_byte_threshold"
    _tell_xla(option, f"--xla_backend_extra_options={option}={KERNEL_BYTES}")
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def high_throughput() -> None:
    """Set JAX up for many episodes at once (`ms_highway.simulation`) on the CPU, before it computes anything.

    It holds for the whole process and for those that it starts. XLA is told to keep to instructions of AVX2: wider ones
    gain little here, and with them the last digits of a number depend on its place in a batch, of which chaotic
    episodes make much. Where ``XLA_FLAGS`` has that option already or names a file, it stays as it is.
    """
    _tell_xla("xla_cpu_max_isa", "--xla_cpu_max_isa=AVX2")


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _tell_xla(option: str, flag: str) -> None:
    flags = os.environ.get("XLA_FLAGS", "")
    if option not in flags and (not flags or flags.startswith("-")):
        os.environ["XLA_FLAGS"] = f"{flags} {flag}".strip()


def in_one_kernel(function: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """The same function of float arrays, the first of which begins with a finite number, as a loop that runs once.

    See `low_latency`; without that, the loop does no harm. XLA must not see that it runs once, nor that what it works
    on stays the same, or else it would take it apart. NaN where the first number is NaN.
    """

    @wraps(function)
    def looped(*arguments: jax.Array) -> jax.Array:
        shape = jax.eval_shape(function, *arguments)

        def run(carry: tuple[jax.Array, tuple[jax.Array, ...], jax.Array]) -> tuple[Any, ...]:
            _, given, _ = carry
            return jnp.bool(True), tuple(jnp.zeros_like(argument) for argument in given), function(*given)

        first = jnp.isnan(arguments[0].ravel()[0]), arguments, jnp.full(shape.shape, jnp.nan, shape.dtype)
        return jax.lax.while_loop(lambda carry: ~carry[0], run, first)[-1]

    return looped


def jit_quickly(
    function: Callable[..., Any], *, static_argnums: tuple[int, ...] = (), options: Mapping[str, Any] | None = None
) -> Callable[..., Any]:
    """`jax.jit` with the compiler options `QUICKLY`, and any others, as far as this version of XLA knows them.

    XLA is asked when the function is first called: whoever only imports a module does not start JAX.

    Args:
        function: what to compile.
        static_argnums: see `jax.jit`.
        options: further compiler options by name.
    """
    chosen = {**QUICKLY, **(options or {})}

    @cache
    def compiled() -> jax.stages.Wrapped:
        return jax.jit(function, static_argnums=static_argnums, compiler_options=known_options(chosen))

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return compiled()(*arguments)

    return call


def known_options(options: Mapping[str, Hashable]) -> dict[str, Hashable]:
    """Those of the compiler options that this version of XLA knows; starts JAX."""
    return {name: value for name, value in options.items() if _knows(name, value)}


@cache
def _knows(option: str, value: Hashable) -> bool:
    try:
        jax.jit(lambda: 0, compiler_options={option: value}).lower().compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return False
    return True


@cache
def plan_function(model: HumanModel, layout: Layout) -> jax.stages.Wrapped:
    """`plan_within_limits`, compiled once for all that plan with this model.

    The compiled function takes the numbers of a packed game, all cars now, and the plan to start from; plans are arrays
    [2, steps, 2] of the robot's and the human's scaled controls.
    """

    def plan(
        numbers: Float[jax.Array, "n"], state: State, start: Float[jax.Array, "2 steps 2"]
    ) -> Float[jax.Array, "2 steps 2"]:
        return jnp.stack(plan_within_limits(model, layout.unpack(numbers), state, JointPlan(*start)))

    if model.responds:  # through LAPACK (`eigh` or `solve`), whose calls no kernel can hold
        return jax.jit(plan, compiler_options=known_options(QUICKLY))
    return jax.jit(in_one_kernel(plan))


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


def packed_memory(memory: Memory) -> Float[np.ndarray, "n"]:
    """A memory of switching as one array: the rung, the step, and each rung's last check."""
    return np.concatenate([np.ravel(part) for part in memory]).astype(np.float32)


def observation(
    memory: Float[np.ndarray, "n"],
    before: Float[Array, "cars 4"],
    control: Float[np.ndarray, "2"],
    after: Float[Array, "cars 4"],
) -> Float[np.ndarray, "m"]:
    """What a `decide_function` looks at: packed memory, cars before a step, control executed in it, cars after it."""
    return np.concatenate([memory, np.ravel(before), control, np.ravel(after)], dtype=np.float32)


_warm: set[Hashable] = set()  # compiled functions that have run with arguments of these shapes
_forked = False  # whether this process was forked from one in which JAX had begun


def _note_fork() -> None:
    from jax._src import xla_bridge  # JAX tells it nowhere else

    global _forked
    _forked = _forked or xla_bridge.backends_are_initialized()


if hasattr(os, "register_at_fork"):  # Windows forks nothing
    os.register_at_fork(after_in_child=_note_fork)


def refuse_after_fork() -> None:
    """Refuse to compute in a process that was forked after JAX had begun, where it would wait for ever.

    Raises:
        RuntimeError: there.
    """
    if _forked:
        remedy = "start it with context='forkserver' or 'spawn', or before JAX begins in the process that starts it"
        raise RuntimeError(f"JAX cannot compute in a process forked from one in which it had begun; {remedy}")


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


def forget() -> None:
    """Forget all that this process has compiled."""
    jax.clear_caches()
    _warm.clear()


def timed(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    """Result of a warm computation, and the seconds it took until the result was there."""
    start = perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, perf_counter() - start


def checked_state(state: Float[np.ndarray, "cars 4"]) -> Float[np.ndarray, "cars 4"]:
    """A copy of the state in the core's precision; compiled functions take it over faster than JAX converts it.

    Raises:
        ValueError: if it is not a finite array [cars, 4] of two cars or more, in that precision.
    """
    state = np.asarray(state)
    if state.ndim != 2 or state.shape[0] < 2 or state.shape[1] != 4:
        raise ValueError(f"a state has shape [cars, 4] with the robot, its partner and any others; got {state.shape}")
    with np.errstate(over="ignore"):
        single = state.astype(np.float32)
    if not np.isfinite(single).all():
        car, column = np.argwhere(~np.isfinite(single))[0]
        value, name = state[car, column], ["x", "y", "heading", "speed"][column]
        why = ", too large for single precision" if np.isfinite(value) else ""
        raise ValueError(f"the state of car {car} is not finite: {name} is {value}{why}")
    return single


def measure_costs(
    game: Game, ladder: Sequence[HumanModel], state: Float[np.ndarray, "cars 4"], repeats: int = 20
) -> Float[np.ndarray, "rungs"]:
    """T(M) on this machine: the median seconds of a warm plan in this state, for each model.

    Raises:
        ValueError: if the state is not a finite array [cars, 4] of two cars or more.
    """
    refuse_after_fork()
    numbers, layout = pack(game)
    arguments = numbers, checked_state(state), jnp.stack(cold_start(game))
    costs = []
    for model in ladder:
        function = plan_function(model, layout)
        warm_up(function, *arguments)
        costs.append(median(timed(function, *arguments)[1] for _ in range(repeats)))
    return np.array(costs)


def keep_compilations(directory: Path | None = None) -> Path:
    """Keep compiled functions in a directory of the user's, for later runs; returns it.

    Args:
        directory: where; without, what the environment variable ``JAX_COMPILATION_CACHE_DIR`` names, or else
            ``ms_highway/compiled`` in the user's cache directory.

    Raises:
        OSError: if that cannot be made, or others can write to it: then nothing is kept, nor used.
    """
    chosen, cache = os.environ.get("JAX_COMPILATION_CACHE_DIR"), os.environ.get("XDG_CACHE_HOME")
    home = Path(cache) if cache and Path(cache).is_absolute() else Path.home() / ".cache"
    directory = directory or (Path(chosen) if chosen else home / "ms_highway" / "compiled")
    jax.config.update("jax_compilation_cache_dir", None)
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_owner(directory)
    jax.config.update("jax_compilation_cache_dir", str(directory))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    use_checked_cache()
    return directory
