"""Compare drivers with what the driver ``search`` found from the same starts.

The search knows what will happen, but need not find the best: a regret may be negative.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from ms_highway.benchmarks.road import SEARCH
from ms_highway.benchmarks.road.episodes import Episode


class Found(NamedTuple):
    """What the search found from a start.

    Attributes:
        success: whether it is a success.
        reward: the sum over all steps.
        steps: of the environment.
        stood: how long the ego stood [s].
    """

    success: bool
    reward: float
    steps: int
    stood: float


Bound = Mapping[int, Found]
"""What was found, by the seed of the start."""


def bound_of(episodes: Sequence[Episode]) -> Bound:
    """Return the bound that episodes of the search make."""
    return {one.seed: Found(one.success, one.reward, one.steps, one.stood) for one in episodes}


def read_bounds(file: Path, traffic: str) -> dict[str, Bound]:
    """Read the bounds of scenes from a log of ``ms-highway bench road --drivers search``.

    Args:
        file: written by ``--log``.
        traffic: the type of the other vehicles.

    Raises:
        ValueError: naming the file and the remedy if it is no such log.
        OSError: if it cannot be read.
    """
    remedy = f"write one with ms-highway bench road --drivers {SEARCH} --log {file}"
    try:
        log = pd.read_csv(file, dtype={"seed": int, "success": bool, "reward": float, "steps": int, "stood": float})
        own = log[(log["driver"] == SEARCH) & (log["traffic"] == traffic)].set_index(["scene", "seed"], drop=True)
        own = own[list(Found._fields)]
        if not np.isfinite(own[["reward", "stood"]]).all(axis=None) or (own["steps"] < 1).any():
            raise ValueError("an episode without a step, a reward or a time")
        if own.index.has_duplicates:
            raise ValueError(f"{own.index[own.index.duplicated()][0]} is there twice")
    except (KeyError, ValueError) as error:
        raise ValueError(f"--bound: {file} is no log of episodes ({error}); {remedy}") from None
    if own.empty:
        raise ValueError(f"--bound: {file} has no episodes of {SEARCH!r} among {traffic!r} traffic; {remedy}")
    bounds: dict[str, dict[int, Found]] = {}
    for (scene, seed), *found in own.itertuples():
        bounds.setdefault(scene, {})[seed] = Found(*found)
    return dict(bounds)


def behind(episodes: Sequence[Episode], bound: Bound) -> dict[str, Any]:
    """Return how far a driver stays behind the search, from the starts that both have: figures for JSON.

    * ``bounded``: number of these starts;
    * ``solvable``: share of them that the search solves;
    * ``solved``: share of those that the driver solves, too; None without any;
    * ``regret``: what it earns less per step, over all steps of these starts, which a crash cuts short;
    * ``waited``: mean time that it stood longer than the search where both solve the start, shorter ones as 0 [s]; None
      without any.
    """
    both = [(one, bound[one.seed]) for one in episodes if one.seed in bound]
    if not both:
        return {}
    solvable = [one.success for one, found in both if found.success]
    longer = [max(one.stood - found.stood, 0.0) for one, found in both if one.success and found.success]
    return {
        "bounded": len(both),
        "solvable": len(solvable) / len(both),
        "solved": float(np.mean(solvable)) if solvable else None,
        "regret": _per_step(found for _, found in both) - _per_step(one for one, _ in both),
        "waited": float(np.mean(longer)) if longer else None,
    }


def _per_step(driven: Iterable[Found | Episode]) -> float:
    rewards, steps = zip(*((one.reward, one.steps) for one in driven), strict=True)
    return sum(rewards) / sum(steps)
