"""How steady driving is: how far a little noise changes where the robot drives, and what it earns.

Noise is normal, of a standard deviation s in x and y [m] and in the speed [m/s], and of s over the speed limit in the
heading [rad], so that the velocity changes alike along the road and across it. It is

* in the start of the robot and of every human. Scripted cars stay as they were drawn: they correct nothing, and another
  velocity of theirs would be another scene; or
* in what the robot sees of itself and of every human, in every step anew; scripted cars it sees as they are.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ms_highway.experiments.analysis.summary import interval
from ms_highway.experiments.batch import make_batch
from ms_highway.experiments.comparison import Comparison, episode_steps
from ms_highway.game.scenario import SPEED_LIMIT
from ms_highway.loop.devices import use_devices
from ms_highway.runtime.arrays import Array
from ms_highway.runtime.jax_settings import high_throughput, own_process

AFTER = 1, 5, 10, 20
"""Steps from the start after which the change of the robot's path is measured."""

NOISE_OF_A_METRE = 1.0, 1.0, 1 / SPEED_LIMIT, 1.0  # noise of x, y, heading and speed, for 1 m
RESOLUTION = 1e-6  # m, about that of float32 near a start


def steadiness(
    comparison: Comparison,
    scenario: str,
    noises: Sequence[float],
    devices: int | None = None,
    modules: Sequence[str] = (),
    seen: bool = False,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Drive the same episodes as drawn and with noise, in batches in a process of its own.

    Args:
        comparison: controllers, seeds, two at least, and configuration.
        scenario: one of its scenarios.
        noises: standard deviations [m].
        devices: how many to use, see `ms_highway.loop.devices.use_devices`.
        modules: to import in the other process, for scenarios and models that they add.
        seen: whether the noise is in what the robot sees, rather than in the start.

    Yields:
        For every controller its name and ``seeds``, the first and how many; ``seen``, whether the noise was in what the
        robot sees; and ``noise``, by noise what `changes` returns.

    Raises:
        ValueError: for anything unknown or impossible, and for episodes that are shorter than the longest of `AFTER`.
    """
    if (steps := episode_steps(scenario, comparison.config)) < AFTER[-1]:
        raise ValueError(f"episodes of {scenario} have {steps} steps; make their duration {AFTER[-1]} steps at least")
    with own_process(high_throughput, modules) as process:
        for controller in comparison.controllers[scenario]:
            noise = process.submit(changes, comparison, scenario, controller, noises, devices, seen).result()
            yield controller, {"seeds": [comparison.first_seed, comparison.seeds], "seen": seen, "noise": noise}


def changes(
    comparison: Comparison,
    scenario: str,
    controller: str,
    noises: Sequence[float],
    devices: int | None = None,
    seen: bool = False,
) -> dict[str, dict[str, Any]]:
    """Drive a controller's episodes as drawn and with noise, all in one batch, and compare them start by start.

    The noise of an episode is the same for all controllers, and in proportion for all standard deviations.

    Args:
        comparison: seeds and configuration.
        scenario: one of its scenarios.
        controller: one of its controllers there.
        noises: standard deviations s [m], see this module.
        devices: how many to use, see `ms_highway.loop.devices.use_devices`.
        seen: whether the noise is in what the robot sees, rather than in the start.

    Returns:
        By noise, for JSON:

        * ``change_m``: by steps of `AFTER`, ``p50`` and ``p95``, quantiles over the starts of the distance between the
          robot's positions with noise and without [m];
        * ``growth``: the factor per step by which the median of this distance grows, ``exp`` of the slope of the
          straight line through its logarithm over the steps up to the last of `AFTER`: below 1 where noise is
          forgotten, 1.05 where a car keeps its velocity, above that where it is amplified;
        * ``reward``: ``mean`` change of the reward per step of an episode, ``low`` and ``high`` its 90 % interval over
          the starts (Student's t), and ``absolute``, the mean of its magnitude;
        * ``collisions``: episodes with a collision, without noise and with it;
        * ``success_changes``: the share of the episodes that succeed with noise and not without, or the other way
          round; None where the scenario does not define success.
    """
    batch = make_batch(comparison, scenario)
    seeds = range(comparison.first_seed, comparison.first_seed + comparison.seeds)
    keys = [(controller, seed) for seed in seeds]
    steps = (batch.steps + 1,) if seen else ()
    noise = np.array([_noise(seed, (*steps, 1 + batch.humans)) for seed in seeds])
    sizes = (0.0, *noises)
    all_keys, noisy = keys * len(sizes), np.concatenate([size * noise for size in sizes])
    records = batch.simulate(all_keys, use_devices(devices), **{"errors" if seen else "shifts": noisy})
    paths = np.split(np.asarray(records.states, float)[:, : AFTER[-1], 0, :2], len(sizes))
    episodes = batch.episodes_table(batch.steps_table(all_keys, records))
    tables = episodes.groupby(np.repeat(np.arange(len(sizes)), len(keys)))
    before, *after = [table.reset_index(drop=True) for _, table in tables]
    return {
        str(size): {**_of_path(np.linalg.norm(path - paths[0], axis=-1)), **_of_outcome(before, own)}
        for size, path, own in zip(noises, paths[1:], after, strict=True)
    }


def _noise(seed: int, shape: tuple[int, ...]) -> Array:
    """Draw the noise of an episode for s = 1 m, of cars or of steps and cars, from other numbers than its start."""
    return np.random.default_rng([seed, len(shape)]).normal(scale=NOISE_OF_A_METRE, size=(*shape, 4))


def _of_path(distances: Array) -> dict[str, Any]:
    """Return the figures of the path from distances [starts, steps]."""
    medians, high = np.quantile(distances, (0.5, 0.95), axis=0)
    slope = np.polyfit(np.arange(len(medians)), np.log(np.maximum(medians, RESOLUTION)), 1)[0]
    change = {str(step): {"p50": float(medians[step - 1]), "p95": float(high[step - 1])} for step in AFTER}
    return {"change_m": change, "growth": float(np.exp(slope))}


def _of_outcome(before: pd.DataFrame, after: pd.DataFrame) -> dict[str, Any]:
    """Return the figures of reward, collisions and success from tables of the same starts."""
    gained = after["reward"] - before["reward"]
    low, high = map(float, interval(gained))
    succeeds = "success" in before
    return {
        "reward": {"mean": float(gained.mean()), "low": low, "high": high, "absolute": float(gained.abs().mean())},
        "collisions": [int((table["collisions"] > 0).sum()) for table in (before, after)],
        "success_changes": float((after["success"] != before["success"]).mean()) if succeeds else None,
    }
