"""Measure steadiness: how much small noise changes the path and the reward of the robot.

Noise is normal. Its standard deviation is s for x and y [m] and for the speed [m/s], and s over the speed limit for the
heading [rad], so that velocities change equally along the road and across it. It is added to the start of the robot
and of every human, or in every step to what the robot observes of them and of itself; never to scripted cars.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import per_episode
from ms_highway.experiments.summary import interval
from ms_highway.game.scenario import SPEED_LIMIT
from ms_highway.loop.devices import use_devices
from ms_highway.runtime.jax_settings import high_throughput, own_process

AFTER = 1, 5, 10, 20
"""Steps from the start after which the change of the robot's path is measured."""

NOISE_OF_A_METRE = 1.0, 1.0, 1 / SPEED_LIMIT, 1.0  # standard deviations of x, y, heading and speed for s = 1 m
RESOLUTION = 1e-6  # m, about the resolution of float32 near a start


def steadiness(
    comparison: Comparison,
    scenario: str,
    noises: Sequence[float],
    seen: bool = False,
    devices: int | None = None,
    modules: Sequence[str] = (),
) -> Iterator[tuple[str, dict]]:
    """Yield the name of every controller and its `changes`, measured in a process that first imports the modules."""
    settings = {"seeds": [comparison.first_seed, comparison.seeds], "seen": seen}
    with own_process(high_throughput, modules) as process:
        for name in comparison.controllers[scenario]:
            found = process.submit(changes, comparison, scenario, name, noises, seen, devices).result()
            yield name, {**settings, "noise": found}


def changes(
    comparison: Comparison,
    scenario: str,
    controller: str,
    noises: Sequence[float],
    seen: bool = False,
    devices: int | None = None,
) -> dict[str, dict[str, Any]]:
    """Drive a controller's episodes without and with noise, all in one batch, and compare them start by start.

    The noise of an episode is the same for all controllers, and proportional for all standard deviations.

    Args:
        comparison: controllers, at least two seeds, and configuration.
        scenario: one of its scenarios.
        controller: one of its controllers.
        noises: standard deviations [m].
        seen: whether the noise is in the observations of the robot, rather than in the start.
        devices: how many to use, see `ms_highway.loop.devices.use_devices`.

    Returns:
        By noise, for JSON:

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
    mesh = use_devices(devices)  # before JAX begins to compute
    batch, last = make_batch(comparison, scenario), AFTER[-1]
    if batch.steps < last:
        problem = f"episodes of {scenario} have {batch.steps} steps"
        raise ValueError(f"{problem}; make their duration at least {last} steps")
    seeds = range(comparison.first_seed, comparison.first_seed + comparison.seeds)
    shape = (*([batch.steps + 1] if seen else []), 1 + batch.humans, 4)
    # The second number of the seed keeps the noise independent of the starts, which are drawn by the seed alone.
    draws = [np.random.default_rng([seed, len(shape) - 1]).normal(scale=NOISE_OF_A_METRE, size=shape) for seed in seeds]
    sizes = [0.0, *noises]
    keys = [(controller, seed) for seed in seeds] * len(sizes)
    noise = np.concatenate([size * np.array(draws) for size in sizes])
    records = batch.simulate(keys, mesh, **{"errors" if seen else "shifts": noise})
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
    return found
