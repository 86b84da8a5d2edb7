"""Share the items of a computation among devices, chunk by chunk; the number of devices does not change results."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import cycle
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from ms_highway.runtime.jax_settings import cores, single_precision

AXIS = "items"  # of a mesh of devices
CHUNK = 8  # items that a processor computes together, one in each lane of AVX2
WIDE_CHUNK = 256  # items that an accelerator computes together
CHUNKS = 128  # computed by a device at a time


def usual_chunk() -> int:
    """Return the size of a chunk that suits the devices that JAX uses by default."""
    return CHUNK if jax.default_backend() == "cpu" else WIDE_CHUNK


def device_mesh(devices: Sequence[jax.Device] | None = None) -> Mesh:
    """Return a one-dimensional mesh of devices; by default, of all devices of this process."""
    return Mesh(np.array(jax.local_devices() if devices is None else devices), (AXIS,))


def use_devices(count: int | None = None) -> Mesh:
    """Return a mesh of as many devices as wanted, by default all; a CPU is split into one device per core at most.

    A CPU can be split only before JAX begins to compute; ``XLA_FLAGS`` may split it into more devices than cores.

    Raises:
        ValueError: if there are fewer devices than wanted.
    """
    if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        most = cores()
        with suppress(RuntimeError):  # JAX has begun, with the devices that it has
            jax.config.update("jax_num_cpu_devices", min(count or most, most))
    devices = jax.local_devices()
    if count is not None and not 0 < count <= len(devices):
        raise ValueError(f"{count} devices are wanted; this process has {len(devices)}, of kind {devices[0].platform}")
    return device_mesh(devices[:count])


def share_among(mesh: Mesh, function: Callable[[Any, Any], Any], items: Any, chunk: int) -> Any:
    """Compute a function of many items, shared by the devices of a mesh.

    Every device runs the same program, compiled for a single device, whatever the number of devices and items: XLA
    compiles a program for several devices differently, so that its results differ in the last digits.

    Args:
        mesh: of `device_mesh`.
        function: takes items, a pytree of arrays [chunk * `CHUNKS`, ...], and how many of them count, an array [1].
            Returns a pytree of arrays [chunk * `CHUNKS`, ...], with anything for items that do not count.
        items: pytree of arrays [n, ...] with n > 0.
        chunk: number of items that ``function`` computes together.

    Returns:
        A pytree of NumPy arrays [n, ...].
    """
    count, size = len(jax.tree.leaves(items)[0]), chunk * CHUNKS
    share = chunk * min(CHUNKS, -(-count // (chunk * mesh.size)))

    def compute(device: jax.Device, first: int) -> Any:
        places = np.arange(first, min(first + share, count))
        padded = np.pad(places, (0, size - len(places)), mode="edge")
        with single_precision():
            own = jax.tree.map(lambda part: np.asarray(part)[padded], items)
            results = function(*jax.device_put((own, np.array([len(places)])), device))
        return jax.tree.map(lambda part: part[: len(places)], jax.device_get(results))

    with ThreadPoolExecutor(mesh.size) as threads:
        computed = threads.map(compute, cycle(mesh.devices), range(0, count, share))
        results = list(computed)  # wait here: Python 3.11 forgets a thread if it is interrupted as it waits for its end
    return jax.tree.map(lambda *parts: np.concatenate(parts), *results)
