"""Measure the speed of the closed loop, in environments and in batches of episodes."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from time import perf_counter

import pandas as pd

from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.runner import episode, interaction, make_environment
from ms_highway.runtime.compilation import timed, use_devices


def live_speed(comparison: Comparison, scenario: str, controller: str) -> dict:
    """Time a few episodes of a controller in the environment.

    They follow an episode that compiles.

    Returns:
        ``plan_us``: median (p50) and p99 of a plan; ``decision_us``: median of a
            decision; ``step_us``: median of a step without the plans of all cars and
            the decision; all in microseconds. ``environment``: steps per second,
            including resets.
    """
    env = make_environment(scenario, controller, **comparison.config)
    inner = interaction(env)
    seeds = range(1, 6)
    list(episode(env, 0))

    steps = []
    start = perf_counter()
    end = start
    for seed in seeds:
        for record in episode(env, seed):
            begun = end
            end = perf_counter()
            planning = record["planning_seconds"]
            deciding = record["decision_seconds"]
            of_all_cars = sum(
                car.last_step.planning_seconds
                for car in (inner.robot, *inner.humans)
                if car.last_step
            )
            rest = end - begun - of_all_cars - deciding
            steps.append([planning, deciding, rest])
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
    """Time batches of a controller's episodes.

    A first batch of one chunk per device may compile.

    Args:
        comparison: has the configuration.
        scenario: its name.
        controller: its name.
        sizes: numbers of episodes in a batch, ascending.
        devices: how many to use, see `ms_highway.runtime.compilation.use_devices`.

    Returns:
        ``batch``: steps per second by batch size; ``memory_mib``: peak memory of the
            process until then, by batch size;
            ``first_seconds``: duration of the first episodes, including any
            compilation; ``devices``: their number and kind.
    """
    most_runs = 5
    most_seconds = 2.0

    # This comes before JAX begins to compute.
    used = use_devices(devices)
    asked = Comparison({scenario: [controller]}, sizes[-1], config=comparison.config)
    batch = make_batch(asked, scenario)
    keys = batch.keys()
    chunks = keys[: batch.loop.together * len(used)]
    _, first = timed(batch.simulate, chunks, used)

    rates = {}
    memory = {}
    for size in sizes:
        times: list[float] = []
        while not times or (len(times) < most_runs and sum(times) < most_seconds):
            _, seconds = timed(batch.simulate, keys[:size], used)
            times.append(seconds)
        rates[str(size)] = size * batch.steps / median(times)
        memory[str(size)] = _peak_memory()
    return {
        "batch": rates,
        "memory_mib": memory,
        "first_seconds": first,
        "devices": f"{len(used)} of kind {used[0].device_kind}",
    }


def _peak_memory() -> float:
    """Return the largest memory of this process so far, as Linux reports it [MiB]."""
    _, _, peak = Path("/proc/self/status").read_text().partition("VmHWM:")
    return int(peak.split()[0]) / 1024
