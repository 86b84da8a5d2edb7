"""Compile functions quickly, time them warm, and compute them for many items.

Many items are computed in batches, or shared among devices.
"""

import os
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, update_wrapper, wraps
from queue import SimpleQueue
from time import perf_counter
from typing import Generic, TypeAlias, TypeVar

import jax
import numpy as np

from ms_highway.runtime.jax_settings import cores, single_precision
from ms_highway.runtime.process import refuse_after_fork

Tree = TypeVar("Tree")
Result = TypeVar("Result")  # both are pytrees of arrays


@cache
def quick_options() -> dict[str, bool]:
    """Return compiler options that halve compilation time; this starts JAX.

    There are none if XLA does not know them, after JAX 0.11.0. They make small plans
    slower by a tenth, but not large ones.
    """
    options = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return {}
    return options


class Compiled(Generic[Result]):
    """A function that is compiled once for each structure of arguments.

    See `jit_quickly`.
    """

    def __init__(
        self,
        function: Callable[..., Result],
        options: Mapping[str, Hashable],
    ) -> None:
        self._function = function
        self._options = options
        self._compiled = dict[str, jax.stages.Wrapped]()
        update_wrapper(self, function)

    def of(self, *arguments: object) -> jax.stages.Wrapped:
        """Return the jitted function for arguments of this structure."""
        refuse_after_fork()
        structure = str(jax.tree.structure(arguments))
        if structure not in self._compiled:
            # A function of its own for each structure, as JAX caches by function.
            own_function = wraps(self._function)(
                lambda *arguments: self._function(*arguments)
            )
            options = {**quick_options(), **self._options}
            self._compiled[structure] = jax.jit(own_function, compiler_options=options)
        return self._compiled[structure]

    def __call__(self, *arguments: object) -> Result:
        """Compute in single precision."""
        with single_precision():
            return self.of(*arguments)(*arguments)


def jit_quickly(
    function: Callable[..., Result],
    **options: Hashable,
) -> Compiled[Result]:
    """Apply `jax.jit` with `quick_options` and further compiler options.

    The function computes in single precision. XLA is asked for its options at the first
    call, so that importing a module does not start JAX. Every structure of arguments,
    with the types of its dataclasses, has its own jitted function: JAX may take
    dataclasses of other types with the same fields for equal, and then uses what it
    compiled for another type.
    """
    return Compiled(function, options)


class ReusedArguments(Generic[Tree]):
    """Arguments of a computation, which are on JAX's device from the second use on.

    Putting them there takes longer than passing them once.
    """

    def __init__(self, tree: Tree) -> None:
        self.tree = tree
        self._uses = 0

    def take(self) -> Tree:
        """Return the arguments for one computation."""
        self._uses += 1
        if self._uses == 2:
            with single_precision():
                self.tree = jax.device_put(self.tree)
        return self.tree


def single(tree: Tree) -> Tree:
    """Return a tree of numbers as NumPy arrays in single precision.

    A function is compiled once for all such trees of equal shapes.
    """
    return jax.tree.map(lambda number: np.asarray(number, np.float32), tree)


@dataclass(frozen=True)
class GroupSizes:
    """Set how many items are computed together."""

    batch: int = 32
    """Items in a batch of `in_batches`.

    Larger batches are hardly faster, and waste more on the last one.
    """
    cpu_chunk: int = 8
    """Items in a chunk of `share_among` on a processor, one in each lane of AVX2."""
    accelerator_chunk: int = 256
    """Items in a chunk of `share_among` on an accelerator."""


GROUP_SIZES = GroupSizes()


def in_batches(function: Callable[[Tree], Result], items: Tree) -> Result:
    """Compute a function of all items; return NumPy arrays.

    The last batch is padded with copies of the last item, so that the function is
    compiled once for all n > 1. A single item is computed alone, as users often wait
    for it.

    Args:
        function: takes and returns a pytree of arrays [`GroupSizes.batch`, ...], or of
            arrays [1, ...].
        items: pytree of arrays [n, ...].
    """
    refuse_after_fork()
    count = len(jax.tree.leaves(items)[0])
    size = 1 if count == 1 else GROUP_SIZES.batch

    def compute(first: int) -> Result:
        """Compute the batch that begins with an item."""
        indices = range(first, first + size)
        batch = jax.tree.map(
            lambda array: np.take(array, indices, axis=0, mode="clip"), items
        )
        return function(batch)

    results = map(compute, range(0, count, size))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *results)


# Compiled functions that have run, with the shapes of their arguments.
_warm: set[Hashable] = set()


def warm_up(function: Callable[..., object], *arguments: object) -> float:
    """Compile and run a function that has not run before.

    Returns:
        The seconds spent; 0 if the function has run.
    """
    leaves, structure = jax.tree.flatten(arguments)
    key = (function, structure, tuple(np.shape(leaf) for leaf in leaves))
    if key in _warm:
        return 0.0
    start = perf_counter()
    with single_precision():
        jax.block_until_ready(function(*arguments))
    _warm.add(key)
    return perf_counter() - start


def timed(function: Callable[..., Result], *arguments: object) -> tuple[Result, float]:
    """Return the result of a warm computation, and the seconds until it was ready."""
    start = perf_counter()
    with single_precision():
        result = jax.block_until_ready(function(*arguments))
    return result, perf_counter() - start


# Many items, shared among devices

Devices: TypeAlias = Sequence[jax.Device]


def usual_chunk() -> int:
    """Return the size of a chunk that suits the devices that JAX uses by default."""
    refuse_after_fork()
    if jax.default_backend() == "cpu":
        return GROUP_SIZES.cpu_chunk
    return GROUP_SIZES.accelerator_chunk


def use_devices(count: int | None = None) -> Devices:
    """Return as many devices as wanted, by default all.

    A CPU is split into one device per core at most. It can be split only before JAX
    begins to compute; ``XLA_FLAGS`` may split it into more devices than cores.

    Raises:
        ValueError: if there are fewer devices than wanted.
    """
    refuse_after_fork()
    if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        most = cores()
        # JAX refuses once it has begun, with the devices that it has.
        with suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", min(count or most, most))
    devices = jax.local_devices()
    if count is not None and not 0 < count <= len(devices):
        raise ValueError(
            f"{count} devices are wanted; this process has {len(devices)}, of kind"
            f" {devices[0].platform}"
        )
    return devices[:count]


def share_among(
    devices: Devices,
    function: Callable[[Tree], Result],
    items: Tree,
    chunk: int,
) -> Result:
    """Compute a function of many items, chunk by chunk.

    A device takes the next chunk as soon as it is free. Every device runs the same
    program, compiled for a single device, whatever the number of devices and items: XLA
    compiles a program for several devices differently, so that its results differ in
    the last digits.

    Args:
        devices: of `use_devices`.
        function: takes and returns a pytree of arrays [chunk, ...].
        items: pytree of arrays [n, ...] with n > 0.
        chunk: number of items that ``function`` computes together; the last chunk is
            padded with its last item.

    Returns:
        A pytree of NumPy arrays [n, ...].
    """
    refuse_after_fork()
    count = len(jax.tree.leaves(items)[0])
    free_devices = SimpleQueue[jax.Device]()
    for device in devices:
        free_devices.put(device)

    def compute(first: int) -> Result:
        """Compute the chunk that begins with an item, on the next free device."""
        indices = np.arange(first, first + chunk).clip(max=count - 1)
        device = free_devices.get()
        try:
            with single_precision():
                own = jax.tree.map(lambda array: np.asarray(array)[indices], items)
                result = function(jax.device_put(own, device))
                return jax.device_get(result)
        finally:
            free_devices.put(device)

    with ThreadPoolExecutor(len(devices)) as threads:
        computed = threads.map(compute, range(0, count, chunk))
        # Wait here: Python 3.11 forgets a thread if it is interrupted while it waits
        # for the end of that thread.
        results = list(computed)
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *results)
