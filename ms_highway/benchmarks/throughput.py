"""How many steps of the closed loop the environments take in a second, and the simulation of many episodes at once."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from statistics import median
from time import perf_counter
from typing import Any

from ms_highway.benchmarks.latency import most_memory, one_core
from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.loop.devices import use_devices
from ms_highway.runtime.jax_settings import high_throughput, own_process
from ms_highway.runtime.timing import timed

EPISODES = 5  # of the environment
SECONDS, RUNS = 2.0, 5  # of one batch, at most


def throughput(
    scenario: str,
    controllers: Sequence[str],
    sizes: Sequence[int],
    devices: int | None = None,
    modules: Sequence[str] = (),
    config: Mapping[str, Any] | None = None,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Measure the closed loop, warm: in the environment in this process, and in batches in another that it starts.

    Args:
        scenario: its name.
        controllers: short names of controllers.
        sizes: numbers of episodes in a batch.
        devices: how many to use, see `ms_highway.loop.devices.use_devices`.
        modules: to import in the other process, for scenarios and models that they add.
        config: of the environments.

    Yields:
        For every controller its name and:

        * ``environment``: steps per second of the environment's loop, with resets, on one core;
        * ``batch``: steps per second by batch size;
        * ``memory_mib``: the most memory that the process with the batches has had until then, by batch size;
        * ``first_seconds``: what the first episodes took, which may compile;
        * ``devices``: how many, and of what kind.

    Raises:
        ValueError: for anything unknown or impossible.
    """
    every = [Comparison({scenario: [controller]}, config=config or {}) for controller in controllers]
    with own_process(high_throughput, modules) as process:
        used = process.submit(_devices, devices).result()
        for controller, comparison in zip(controllers, every, strict=True):
            result = {"environment": _environment(scenario, comparison), "devices": used}
            batches = {
                str(size): process.submit(_batch, scenario, replace(comparison, seeds=size), devices).result()
                for size in sorted(sizes)
            }
            for place, name in enumerate(("batch", "memory_mib")):
                result[name] = {size: measured[place] for size, measured in batches.items()}
            yield controller, result | {"first_seconds": next(iter(batches.values()))[-1]}


def _environment(scenario: str, comparison: Comparison) -> float:
    """Steps per second with the comparison's only controller, after an episode that compiles."""
    (controller,) = comparison.controllers[scenario]
    env = make_environment(scenario, controller, **comparison.common_config())
    with one_core():
        list(episode(env, 0))
        start = perf_counter()
        steps = sum(1 for seed in range(1, 1 + EPISODES) for _ in episode(env, seed))
        seconds = perf_counter() - start
    env.close()
    return steps / seconds


def _devices(count: int | None) -> str:
    devices = use_devices(count).devices
    return f"{devices.size} of kind {devices[0].device_kind}"


def _batch(scenario: str, comparison: Comparison, devices: int | None) -> tuple[float, float, float]:
    """Time one batch, after one of a chunk on every device that it needs, which may compile.

    Returns:
        Steps per second, the most memory [MiB], and what the first chunks took [s].
    """
    batch = make_batch(comparison, scenario)
    keys, mesh = batch.keys(), use_devices(devices)
    times = [timed(batch.simulate, keys[: batch.loop.together * mesh.size], mesh)[1]]
    while len(times) < 2 or (len(times) <= RUNS and sum(times[1:]) < SECONDS):
        times.append(timed(batch.simulate, keys, mesh)[1])
    return len(keys) * batch.steps / median(times[1:]), most_memory(), times[0]
