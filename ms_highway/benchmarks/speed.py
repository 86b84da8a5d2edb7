"""Measure the speed of the closed loop, and its steadiness: how much small noise changes the robot's path and reward.

Speed is measured in environments, and in batches of many simulated episodes.

Noise is normal. Its standard deviation is s for x and y [m] and for the speed [m/s], and s over the speed limit for the
heading [rad], so that velocities change equally along the road and across it. It is added to the start of the robot
and of every human, or in every step to what the robot observes of them and of itself; never to scripted cars.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import pandas as pd

from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison, per_episode
from ms_highway.experiments.runner import episode, make_environment
from ms_highway.experiments.summary import interval
from ms_highway.game.scenario import SPEED_LIMIT
from ms_highway.loop.batch import simulate
from ms_highway.runtime.compilation import timed, use_devices

EPISODES = 5  # of the environment
SECONDS, RUNS = 2.0, 5  # largest time and number of runs of one batch size


def live_speed(comparison: Comparison, scenario: str, controller: str) -> dict:
    """Time a few episodes of a controller in the environment, after an episode that compiles.

    Returns:
        ``plan_us``: median (p50) and p99 of a plan; ``decision_us``: median of a decision; ``step_us``: median of a
        step without the plans of all cars and the decision; all in microseconds. ``environment``: steps per second,
        including resets.
    """
    env: Any = make_environment(scenario, controller, **comparison.config)
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


def batch_speed(
    comparison: Comparison, scenario: str, controller: str, sizes: Sequence[int], devices: int | None = None
) -> dict:
    """Time batches of a controller's episodes, after a first batch of one chunk per device, which may compile.

    Args:
        comparison: has the configuration.
        scenario: its name.
        controller: its name.
        sizes: numbers of episodes in a batch, ascending.
        devices: how many to use, see `ms_highway.runtime.compilation.use_devices`.

    Returns:
        ``batch``: steps per second by batch size; ``memory_mib``: peak memory of the process until then, by batch size;
        ``first_seconds``: duration of the first episodes, including any compilation; ``devices``: their number and
        kind.
    """
    used = use_devices(devices)  # before JAX begins to compute
    batch = make_batch(Comparison({scenario: [controller]}, sizes[-1], config=comparison.config), scenario)
    keys = batch.keys()
    first = timed(batch.simulate, keys[: batch.loop.together * len(used)], used)[1]
    rates, memory = {}, {}
    for size in sizes:
        times: list[float] = []
        while not times or (len(times) < RUNS and sum(times) < SECONDS):
            times.append(timed(batch.simulate, keys[:size], used)[1])
        rates[str(size)] = size * batch.steps / median(times)
        peak = Path("/proc/self/status").read_text().partition("VmHWM:")[2]  # as Linux reports it
        memory[str(size)] = int(peak.split()[0]) / 1024
    kind = used[0].device_kind
    return {"batch": rates, "memory_mib": memory, "first_seconds": first, "devices": f"{len(used)} of kind {kind}"}


# Steadiness

AFTER = 1, 5, 10, 20
"""Steps from the start after which the change of the robot's path is measured."""

NOISE_OF_A_METRE = 1.0, 1.0, 1 / SPEED_LIMIT, 1.0  # standard deviations of x, y, heading and speed for s = 1 m
RESOLUTION = 1e-6  # m, about the resolution of float32 near a start


def steadiness(
    comparison: Comparison,
    scenario: str,
    controller: str,
    noises: Sequence[float],
    seen: bool = False,
    devices: int | None = None,
) -> dict[str, Any]:
    """Drive a controller's episodes without and with noise, all in one batch, and compare them start by start.

    The noise of an episode is the same for all controllers, and proportional for all standard deviations.

    Args:
        comparison: controllers, at least two seeds, and configuration.
        scenario: one of its scenarios.
        controller: one of its controllers.
        noises: standard deviations [m].
        seen: whether the noise is in the observations of the robot, rather than in the start.
        devices: how many to use, see `ms_highway.runtime.compilation.use_devices`.

    Returns:
        For JSON, ``seeds``, the first and their number, ``seen``, and ``noise``, by standard deviation:

        * ``change_m``: by steps of `AFTER`, ``p50`` and ``p95``, quantiles over the starts of the distance between the
          robot's positions with and without noise [m];
        * ``growth``: the factor per step by which the median of this distance grows, ``exp`` of the slope of a straight
          line fitted to its logarithm up to the last step of `AFTER`;
        * ``reward``: ``mean`` change of the reward per step of an episode, ``low`` and ``high``, its 90 % interval over
          the starts (Student's t), and ``absolute``, the mean magnitude of the change;
        * ``collisions``: numbers of episodes with a collision, without and with noise;
        * ``success_changes``: the share of episodes whose success differs with and without noise; None where the
          scenario does not define success.

    Raises:
        ValueError: for anything unknown or impossible, and for episodes shorter than the last step of `AFTER`.
    """
    used = use_devices(devices)  # before JAX begins to compute
    batch, last = make_batch(comparison, scenario), AFTER[-1]
    if batch.steps < last:
        problem = f"episodes of {scenario} have {batch.steps} steps"
        raise ValueError(f"{problem}; make their duration at least {last} steps")
    seeds = comparison.seed_range
    shape = (*([batch.steps + 1] if seen else []), 1 + batch.humans, 4)
    # The second number of the seed keeps the noise independent of the starts, which are drawn by the seed alone.
    draws = [np.random.default_rng([seed, len(shape) - 1]).normal(scale=NOISE_OF_A_METRE, size=shape) for seed in seeds]
    sizes = [0.0, *noises]
    keys = [(controller, seed) for seed in seeds] * len(sizes)
    noise = np.concatenate([size * np.array(draws) for size in sizes])
    episodes = batch.episodes(keys)
    if seen:
        episodes = replace(episodes, errors=noise)
    else:
        episodes.starts[:, : noise.shape[1]] += noise
    records = simulate(batch.loop_of(controller), episodes, used)
    paths = np.asarray(records.states, float)[:, :last, 0, :2].reshape(len(sizes), len(seeds), last, 2)
    steps, rows = batch.steps_table(keys, records), len(seeds) * batch.steps
    without, *noisy = (per_episode(steps[start:][:rows]) for start in range(0, len(steps), rows))
    found = {}
    for size, path, own in zip(noises, paths[1:], noisy, strict=True):
        medians, high = np.quantile(np.linalg.norm(path - paths[0], axis=-1), (0.5, 0.95), axis=0)
        slope = np.polyfit(np.arange(last), np.log(np.maximum(medians, RESOLUTION)), 1)[0]
        gained = own["reward"] - without["reward"]
        low, top = interval(gained)
        reward = {"mean": gained.mean(), "low": low, "high": top, "absolute": gained.abs().mean()}
        changed = (own["success"] != without["success"]).mean() if "success" in own else None
        found[str(size)] = {
            "change_m": {str(step): {"p50": medians[step - 1], "p95": high[step - 1]} for step in AFTER},
            "growth": float(np.exp(slope)),
            "reward": reward,
            "collisions": [int((table["collisions"] > 0).sum()) for table in (without, own)],
            "success_changes": changed,
        }
    return {"seeds": [comparison.first_seed, comparison.seeds], "seen": seen, "noise": found}
