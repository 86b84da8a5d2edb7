"""Summarise the episodes of a driver in a scene."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ms_highway.benchmarks.road.episodes import Block, Episode

__all__ = ["UNPHYSICAL", "row", "summary"]

UNPHYSICAL = 10.0
"""Acceleration [m/s^2] that no tyres hold."""


def summary(block: Block, episodes: Sequence[Episode]) -> dict[str, Any]:
    """Return the figures of a driver in a scene, for JSON.

    * ``success``, ``off_road``: shares of the episodes in which the goal was reached, and the road was left;
    * ``collisions``, ``at_fault``: numbers of episodes in which the ego crashed, and was at fault;
    * ``reward_per_step``, ``return``: mean reward over all steps of all episodes, and its sum per episode;
    * ``mean_speed``: over all frames [m/s];
    * ``max_acceleration``, ``max_acceleration_of_centre``: largest in any frame [m/s^2];
    * ``jerk``: root mean square over all frames [m/s^3];
    * ``p50_ms``, ``p99_ms``: quantiles over all decisions of all episodes [ms], None without any;
    * ``steps``: mean number per episode;
    * ``sources``: shares of the decisions by what drove, where the driver says so;
    * ``rungs``: shares of the cars that each rung predicted;
    * ``episodes``, ``seeds``, ``traffic``, ``label``: their number, the first seed and how many, the type of the other
      vehicles, and ``unphysical`` if ``max_acceleration`` is above `UNPHYSICAL`.
    """
    motions = [episode.motion for episode in episodes]
    frames = [motion.frames for motion in motions]
    steps = sum(episode.steps for episode in episodes)
    sources, rungs = (sum((getattr(each, name) for each in episodes), Counter[str]()) for name in ("sources", "rungs"))
    decisions = 1e3 * np.concatenate([episode.decisions for episode in episodes])
    p50, p99 = np.quantile(decisions, [0.5, 0.99]).tolist() if decisions.size else (None, None)
    fastest_change = max(motion.max_acceleration for motion in motions)
    return {
        "success": _mean([episode.success for episode in episodes]),
        "collisions": sum(episode.crashed for episode in episodes),
        "at_fault": sum(episode.at_fault for episode in episodes),
        "off_road": _mean([episode.off_road for episode in episodes]),
        "reward_per_step": sum(episode.reward for episode in episodes) / steps,
        "return": _mean([episode.reward for episode in episodes]),
        "mean_speed": sum(motion.distance for motion in motions) / sum(motion.seconds for motion in motions),
        "max_acceleration": fastest_change,
        "max_acceleration_of_centre": max(motion.max_acceleration_of_centre for motion in motions),
        "jerk": float(np.sqrt(np.average([motion.squared_jerk for motion in motions], weights=frames))),
        "p50_ms": p50,
        "p99_ms": p99,
        "steps": steps / len(episodes),
        "sources": {name: count / sources.total() for name, count in sources.items()},
        "rungs": {name: count / rungs.total() for name, count in rungs.items()},
        "episodes": len(episodes),
        "seeds": [episodes[0].seed, len(episodes)],
        "traffic": block.traffic,
        "label": "unphysical" if fastest_change > UNPHYSICAL else "",
    }


def row(block: Block, episode: Episode) -> dict[str, Any]:
    """Return an episode as a row of a table."""
    apart = "motion", "decisions", "sources", "rungs"
    kept = {name: value for name, value in asdict(episode).items() if name not in apart}
    milliseconds = 1e3 * np.array(episode.decisions or (np.nan,))
    times = {"p50_ms": np.median(milliseconds), "max_ms": np.max(milliseconds)}
    names = {"scene": block.scene, "driver": block.driver, "traffic": block.traffic}
    return names | kept | asdict(episode.motion) | {name: float(value) for name, value in times.items()}


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values))
