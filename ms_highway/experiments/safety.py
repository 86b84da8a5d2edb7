"""Count in simulated episodes how often controllers collide under limits on plans."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jax.sharding import Mesh
from scipy import stats

from ms_highway.experiments.analysis.findings import in_order, listed
from ms_highway.experiments.analysis.summary import CONFIDENCE
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.provenance import read_runs
from ms_highway.experiments.settings import SETTINGS_FILE, read_settings
from ms_highway.experiments.simulated import make_batch, run_episodes, summarised
from ms_highway.game.scenario import title
from ms_highway.runtime.progress import Progress, silent

__all__ = ["SAFETY_FILE", "Limit", "Safety", "count", "read_safety", "safety_cells", "safety_sentences"]

SAFETY_FILE = "safety.csv"

Limit = Sequence[float] | str | None
"""Bounds on plans, as ``control_limit`` in the configuration of `ms_highway.envs.base.InteractionEnv`."""

LIMIT = ["omega", "acceleration"]
COLUMNS = ["scenario", "controller", *LIMIT, "episodes", "collision_episodes", "reward"]
OMEGA_UNITS = {"paper": "1/m", "released": "rad/s"}


@dataclass(frozen=True)
class Safety:
    """What was counted.

    Attributes:
        directory: where it lies.
        table: a row per scenario, controller and limit, see `count`.
        settings: what the environments had in common.
        runs: what made it, see `ms_highway.experiments.provenance.this_run`.
    """

    directory: Path
    table: pd.DataFrame
    settings: dict[str, Any]
    runs: list[dict[str, Any]]


def count(
    comparison: Comparison,
    limits: Sequence[Limit],
    mesh: Mesh | None = None,
    progress: Progress = silent,
) -> pd.DataFrame:
    """Simulate the same episodes under each of several limits; a scenario is compiled once.

    Args:
        comparison: the episodes.
        limits: on plans of robot and human.
        mesh: devices, see `ms_highway.simulation.loop.simulate`.
        progress: called with a message before every batch.

    Returns:
        A row per scenario, controller and limit: bounds on the magnitude of ``omega`` [1/m, and in released semantics
        rad/s] and ``acceleration`` [m/s^2], infinite for none; ``episodes``; ``collision_episodes``, those in which the
        robot collides; its ``reward`` per step.

    Raises:
        ValueError: for anything unknown or impossible.
    """
    several = [replace(comparison, planning={**comparison.planning, "control_limit": limit}) for limit in limits]
    batches = [make_batch(one, scenario) for scenario in comparison.controllers for one in several]
    for one, other in combinations(batches[: len(limits)], 2):
        if np.array_equal(one.loop.game.planner.control_limit, other.loop.game.planner.control_limit):
            raise ValueError(f"two of the limits {list(limits)} are the same bounds; name each once")
    tables = []
    for batch in batches:
        bounds = [float(f"{bound:g}") for bound in np.asarray(batch.loop.game.planner.control_limit)]
        progress(f"{batch.scenario.name}: {batch.size} episodes within {bounds[0]:g}, {bounds[1]:g}")
        episodes = summarised(batch, batch.keys(), run_episodes(batch, batch.keys(), mesh))
        by_controller = episodes.assign(hit=episodes["collisions"] > 0).groupby(["scenario", "controller"], sort=False)
        counted = by_controller.agg(
            episodes=("seed", "size"), collision_episodes=("hit", "sum"), reward=("reward", "mean")
        )
        tables.append(counted.reset_index().assign(**dict(zip(LIMIT, bounds, strict=True))))
    return pd.concat(tables, ignore_index=True)[COLUMNS]


def read_safety(directory: Path) -> Safety:
    """Read what ``ms-highway safety`` wrote.

    Raises:
        ValueError: if a file cannot be read.
    """
    file = directory / SAFETY_FILE
    try:
        table = pd.read_csv(file)[COLUMNS]
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"{file} cannot be read ({error}); name a directory that `ms-highway safety` wrote") from error
    settings = read_settings(directory / SETTINGS_FILE)
    if settings.get("semantics") not in OMEGA_UNITS:
        raise ValueError(f"{directory / SETTINGS_FILE} says no semantics; run `ms-highway safety` again")
    return Safety(directory, table, settings, read_runs(directory))


def safety_cells(safety: Safety) -> pd.DataFrame:
    """Return texts, a row per scenario and controller: episodes with a collision under each limit."""
    table = safety.table
    texts = [f"{hit} of {all_}" for hit, all_ in zip(table["collision_episodes"], table["episodes"], strict=True)]
    limits = [_limit(bounds, safety) for bounds in table[LIMIT].to_numpy().tolist()]
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for key, limit, text in zip(zip(table["scenario"], table["controller"], strict=True), limits, texts, strict=True):
        rows.setdefault(key, dict(zip(("scenario", "controller"), key, strict=True)))[limit] = text
    return pd.DataFrame(list(rows.values())).fillna("")


def safety_sentences(safety: Safety) -> list[str]:
    """Return a sentence per limit on who collides how often, and one on what remains possible if nobody does.

    That is the upper end of the 90 % interval of a share (Clopper and Pearson 1934).
    """
    table, sentences = safety.table, []
    for bounds, rows in table.groupby(LIMIT, sort=False):
        groups = {str(name): some for name, some in rows.groupby("scenario", sort=False)}
        hits = [_hits(name, groups[name]) for name in in_order(groups) if groups[name]["collision_episodes"].any()]
        text = f"episodes with a collision are {'; '.join(hits)}" if hits else "no controller collides"
        sentences.append(f"Within {_limit(bounds, safety)}, {text}.")
    none = table.loc[table["collision_episodes"] == 0, "episodes"]
    if len(none):
        share = stats.binomtest(0, int(none.min())).proportion_ci(CONFIDENCE).high
        sentences.append(f"None in {none.min()} leaves open that up to {100 * share:.1f} % have one (90 % interval).")
    return sentences


def _hits(scenario: str, rows: pd.DataFrame) -> str:
    """Say who collided in a scenario, and how often."""
    hit = rows[rows["collision_episodes"] > 0]
    first, *others = zip(hit["collision_episodes"], hit["episodes"], hit["controller"], strict=True)
    if len(hit) == len(rows) > 1 and hit["collision_episodes"].nunique() == 1:
        return f"in {title(scenario)} {first[0]} of {first[1]} with every controller"
    text = [f"{first[0]} of {first[1]} with {first[2]}", *(f"{count} with {name}" for count, _, name in others)]
    return f"in {title(scenario)} {listed(text)}"


def _limit(bounds: Sequence[float], safety: Safety) -> str:
    """Return a limit as text."""
    omega, acceleration = bounds
    if not np.isfinite(bounds).all():
        return "no limits"
    return f"{omega:g} {OMEGA_UNITS[safety.settings['semantics']]} and {acceleration:g} m/s²"
