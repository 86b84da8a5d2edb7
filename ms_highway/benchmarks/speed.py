"""Measure the speed of the closed loop: in environments, and in batches of many simulated episodes."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import pandas as pd

from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.loop.devices import use_devices
from ms_highway.runtime.jax_settings import high_throughput, low_latency_on_core, own_process
from ms_highway.runtime.timing import timed

EPISODES = 5  # of the environment
SECONDS, RUNS = 2.0, 5  # largest time and number of runs of one batch size


def speed(
    scenario: str,
    controllers: Sequence[str],
    config: Mapping,
    sizes: Sequence[int] = (),
    devices: int | None = None,
    modules: Sequence[str] = (),
) -> Iterator[tuple[str, dict]]:
    """Measure the warm closed loop of each controller, live on one core and in batches, each in its own process.

    Args:
        scenario: its name.
        controllers: short names of controllers.
        config: of the environments.
        sizes: numbers of episodes in a batch.
        devices: how many the batches use, see `ms_highway.loop.devices.use_devices`.
        modules: to import in these processes, for scenarios and models that they add.

    Yields:
        For every controller its name and the figures of `live_speed`; with batches, also:

        * ``batch``: steps per second by batch size;
        * ``memory_mib``: peak memory of the process with the batches until then, by batch size;
        * ``first_seconds``: duration of the first episodes, including any compilation;
        * ``devices``: their number and kind.

    Raises:
        ValueError: for anything unknown or impossible.
    """
    every = {name: Comparison({scenario: [name]}, max([*sizes, 1]), config=config) for name in controllers}
    one_core = partial(low_latency_on_core, 0)
    with own_process(one_core, modules) as live, own_process(high_throughput, modules) as batches:
        for controller, comparison in every.items():
            result = live.submit(live_speed, scenario, controller, config).result()
            if sizes:
                result |= batches.submit(_batch_speed, comparison, scenario, sorted(sizes), devices).result()
            yield controller, result


def live_speed(scenario: str, controller: str, config: Mapping) -> dict:
    """Time a few episodes in the environment, after an episode that compiles.

    Returns:
        ``plan_us``: median (p50) and p99 of a plan; ``decision_us``: median of a decision; ``step_us``: median of a
        step without the plans of all cars and the decision; all in microseconds. ``environment``: steps per second,
        including resets.
    """
    env: Any = make_environment(scenario, controller, **config)
    steps = []
    list(episode(env, 0))
    start = end = perf_counter()
    for seed in range(1, 1 + EPISODES):
        for record in episode(env, seed):
            begun, end = end, perf_counter()
            cars = (env.unwrapped.robot, *env.unwrapped.humans)
            plans = sum(car.last_step.planning_seconds for car in cars if car.last_step)
            rest = end - begun - plans - record["decision_seconds"]
            steps.append([record["planning_seconds"], record["decision_seconds"], rest])
    env.close()
    microseconds = 1e6 * pd.DataFrame(steps, columns=["plan", "decision", "rest"])
    middle = microseconds.median()
    return {
        "plan_us": {"p50": middle["plan"], "p99": microseconds["plan"].quantile(0.99)},
        "decision_us": middle["decision"],
        "step_us": middle["rest"],
        "environment": len(steps) / (end - start),
    }


def _batch_speed(comparison: Comparison, scenario: str, sizes: Sequence[int], devices: int | None) -> dict:
    """Time batches of a comparison's episodes, after a first batch of one chunk per device, which may compile."""
    mesh = use_devices(devices)  # before JAX begins to compute
    batch, used = make_batch(comparison, scenario), mesh.devices
    keys = batch.keys()
    first = timed(batch.simulate, keys[: batch.loop.together * used.size], mesh)[1]
    rates, memory = {}, {}
    for size in sizes:
        times: list[float] = []
        while not times or (len(times) < RUNS and sum(times) < SECONDS):
            times.append(timed(batch.simulate, keys[:size], mesh)[1])
        rates[str(size)] = size * batch.steps / median(times)
        peak = Path("/proc/self/status").read_text().partition("VmHWM:")[2]  # as Linux reports it
        memory[str(size)] = int(peak.split()[0]) / 1024
    kind = used.flat[0].device_kind
    return {"batch": rates, "memory_mib": memory, "first_seconds": first, "devices": f"{used.size} of kind {kind}"}
