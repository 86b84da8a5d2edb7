"""Measure the speed of the closed loop, in environments and in batches of many
simulated episodes.
"""

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import pandas as pd

from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.runtime.compilation import timed, use_devices

EPISODES = 5  # of the environment
SECONDS, RUNS = 2.0, 5  # largest time and number of runs of one batch size


def live_speed(comparison: Comparison, scenario: str, controller: str) -> dict:
    """Time a few episodes of a controller in the environment, after an episode that
    compiles.

    Returns:
        ``plan_us``: median (p50) and p99 of a plan; ``decision_us``: median of a
            decision; ``step_us``: median of a
        step without the plans of all cars and the decision; all in microseconds.
        ``environment``: steps per second, including resets.
    """
    env: Any = make_environment(scenario, controller, **comparison.config)
    steps = []
    list(episode(env, 0))
    start = end = perf_counter()
    for seed in range(1, 1 + EPISODES):
        for record in episode(env, seed):
            begun = end
            end = perf_counter()
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


def batch_speed(
    comparison: Comparison,
    scenario: str,
    controller: str,
    sizes: Sequence[int],
    devices: int | None = None,
) -> dict:
    """Time batches of a controller's episodes, after a first batch of one chunk per
    device, which may compile.

    Args:
        comparison: has the configuration.
        scenario: its name.
        controller: its name.
        sizes: numbers of episodes in a batch, ascending.
        devices: how many to use, see `ms_highway.runtime.compilation.use_devices`.

    Returns:
        ``batch``: steps per second by batch size; ``memory_mib``: peak memory of the
            process until then, by batch size;
        ``first_seconds``: duration of the first episodes, including any compilation;
            ``devices``: their number and
        kind.
    """
    used = use_devices(devices)  # before JAX begins to compute
    batch = make_batch(
        Comparison({scenario: [controller]}, sizes[-1], config=comparison.config),
        scenario,
    )
    keys = batch.keys()
    first = timed(batch.simulate, keys[: batch.loop.together * len(used)], used)[1]
    rates = {}
    memory = {}
    for size in sizes:
        times: list[float] = []
        while not times or (len(times) < RUNS and sum(times) < SECONDS):
            times.append(timed(batch.simulate, keys[:size], used)[1])
        rates[str(size)] = size * batch.steps / median(times)
        peak = (
            Path("/proc/self/status").read_text().partition("VmHWM:")[2]
        )  # as Linux reports it
        memory[str(size)] = int(peak.split()[0]) / 1024
    kind = used[0].device_kind
    return {
        "batch": rates,
        "memory_mib": memory,
        "first_seconds": first,
        "devices": f"{len(used)} of kind {kind}",
    }
