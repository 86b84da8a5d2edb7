"""Records of steps: their columns, and what is picked out of them."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from ms_highway.planning.human_models import MODELS

__all__ = ["KEYS", "MAY_LACK", "NEEDED", "check_numbers", "columns", "common_seeds", "one_episode", "switches"]

KEYS = ["scenario", "controller", "seed"]
TEXTS, NUMBERS = (
    ("scenario", "controller", "model", "status"),
    ("seed", "step", "reward", "planning_seconds", "decision_seconds"),
)
NEEDED = {*TEXTS, *NUMBERS, "collision"}  # of the columns, those that are never empty
MAY_LACK = "counted_seconds"  # numbers, where they are


def columns() -> list[str]:
    """Columns of a record of steps.

    ``counted_seconds`` is T(M), what decisions count for the step's plan; a gain, of which every known human model has
    one, is empty where none was estimated; states are in SI units after the step.
    """
    return [
        *KEYS,
        "step",
        "model",
        "reward",
        "collision",
        "planning_seconds",
        "counted_seconds",
        "decision_seconds",
        "compile_seconds",
        "status",
        *(f"gain_{name}" for name in MODELS),
        *(f"{car}_{number}" for car in ("robot", "human") for number in ("x", "y", "heading", "speed")),
    ]


def check_numbers(records: pd.DataFrame) -> None:
    """Look for texts in the columns of numbers that results are made from.

    Raises:
        ValueError: naming the column.
    """
    for name in (*NUMBERS, MAY_LACK, *(column for column in records if column.startswith("gain_"))):
        if not pd.api.types.is_numeric_dtype(records[name]):
            raise ValueError(f"has texts where numbers belong, in column {name}")


def one_episode(records: pd.DataFrame, scenario: str, controller: str, seed: int) -> pd.DataFrame:
    """The records of one episode, in order of its steps.

    Raises:
        ValueError: if there are none.
    """
    chosen = (records["scenario"] == scenario) & (records["controller"] == controller) & (records["seed"] == seed)
    if not chosen.any():
        raise ValueError(f"there is no episode of {controller!r} in {scenario!r} with seed {seed} in these records")
    return records[chosen].sort_values("step")


def common_seeds(records: pd.DataFrame, scenario: str, controllers: Sequence[str]) -> list[int]:
    """Seeds of the episodes that all of these controllers, one at least, have driven, ascending."""
    rows = records[records["scenario"] == scenario]
    return sorted(set.intersection(*(set(rows.loc[rows["controller"] == name, "seed"]) for name in controllers)))


def switches(episode: pd.DataFrame) -> list[int]:
    """The first step of an episode, and those that were planned with another model than the step before."""
    models = episode["model"].to_numpy()
    return [0, *(np.flatnonzero(models[1:] != models[:-1]) + 1).tolist()]
