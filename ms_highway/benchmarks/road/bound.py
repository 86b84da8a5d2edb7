"""Compare drivers with a bound on what can be earned from the same starts: the episodes of ``search``."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from ms_highway.benchmarks.road import SEARCH
from ms_highway.benchmarks.road.episodes import Episode


class Found(NamedTuple):
    """What the search found from a start.

    Attributes:
        success: whether it is a success; else nobody is known to be able to solve it.
        earned: reward per step.
        stood: how long the ego stood [s].
    """

    success: bool
    earned: float
    stood: float


Bound = Mapping[int, Found]
"""What was found, by the seed of the start."""


def bound_of(episodes: Sequence[Episode]) -> Bound:
    """Return the bound that episodes of the search make."""
    return {one.seed: Found(one.success, one.reward / one.steps, one.stood) for one in episodes}


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
        log = pd.read_csv(file)
        own = log[(log["driver"] == SEARCH) & (log["traffic"] == traffic)]
        rows = zip(*(own[name] for name in ("scene", "seed", "success", "reward", "steps", "stood")), strict=True)
        found: dict[str, dict[int, Found]] = {}
        for scene, seed, success, reward, steps, stood in rows:
            found.setdefault(scene, {})[int(seed)] = Found(bool(success), float(reward) / int(steps), float(stood))
    except (KeyError, ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"--bound: {file} is no log of episodes ({error}); {remedy}") from None
    if not found:
        raise ValueError(f"--bound: {file} has no episodes of {SEARCH!r} among {traffic!r} traffic; {remedy}")
    return dict(found)


def behind(episodes: Sequence[Episode], bound: Bound) -> dict[str, Any]:
    """Return how far a driver stays behind a bound, from the starts that both have: figures for JSON.

    * ``bounded``: number of these starts;
    * ``solvable``: share of them that the search solves;
    * ``solved``: share of those that the driver solves, too; None without any;
    * ``regret``: mean reward per step that it earns less than the search;
    * ``waited``: mean time that it stood longer than the search, from the starts that the search solves [s].
    """
    both = [(one, bound[one.seed]) for one in episodes if one.seed in bound]
    if not both:
        return {}
    solvable = [(one, found) for one, found in both if found.success]
    return {
        "bounded": len(both),
        "solvable": len(solvable) / len(both),
        "solved": float(np.mean([one.success for one, _ in solvable])) if solvable else None,
        "regret": float(np.mean([found.earned - one.reward / one.steps for one, found in both])),
        "waited": float(np.mean([max(one.stood - found.stood, 0.0) for one, found in solvable])) if solvable else None,
    }
