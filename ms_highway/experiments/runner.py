"""Run comparisons, live in the environments or in batches, and read their records.

A directory holds the results in pieces, each in a file that is either complete or
absent. A live run writes a CSV file per episode, with a row per step, and joins them in
``steps.csv`` at the end. A simulation writes Parquet files of many episodes, with a row
per episode; together, they need not fit in memory. A run that was stopped resumes with
the episodes that are in no file.
"""

import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from functools import lru_cache, partial
from itertools import count
from math import ceil
from pathlib import Path
from secrets import token_hex
from typing import Any, TypeAlias
from warnings import warn

import gymnasium as gym
import numpy as np
import pandas as pd

from ms_highway.choice.rule import NOT_ESTIMATED
from ms_highway.envs import environment_id
from ms_highway.envs.agents import AgentDrives, is_agent
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.registry import controller_config, robot_config
from ms_highway.experiments.batch import Tables, make_batch, simulate_parts
from ms_highway.experiments.comparison import (
    KEYS,
    NEEDED,
    Comparison,
    EpisodeKey,
    by_column,
    check_table,
)
from ms_highway.experiments.directory import ResultsDirectory, write_table
from ms_highway.runtime.files import reading, whole_lines
from ms_highway.runtime.jax_settings import cores, low_latency_on_core, own_process
from ms_highway.runtime.sources import Sources, late_sources

STEPS_FILE = "steps.csv"
PARTS = "parts"
EPISODES = "episodes"
STEPS = "steps"
REMEDY = "remove it, to have it computed again"
MIN_EPISODES = (
    60  # with fewer, further processes take more time to start than they save
)

Compute: TypeAlias = Callable[
    [Comparison, Mapping[str, range]], Iterator[tuple[str, Tables]]
]
"""Computes named parts, each a range of places in `Comparison.episodes`; yields them by
name, in any order.
"""

Driven: TypeAlias = tuple[pd.DataFrame, Sources]
"""The records of an episode, and the `ms_highway.runtime.sources.late_sources` of the
process that drove it.
"""


def run(
    comparison: Comparison,
    directory: str | Path,
    processes: int = 1,
    modules: Sequence[str] = (),
) -> Iterator[int]:
    """Drive the episodes that a directory lacks; put the records of all into
    ``steps.csv`` at the end.

    Args:
        comparison: what to drive.
        directory: directory of the results.
        processes: number of processes that drive at once, each on a core of its own,
            but no more than there are cores. If fewer than `MIN_EPISODES` episodes are
            missing, this process alone drives them.
        modules: modules that other processes import, for scenarios and models that they
            add.

    Yields:
        The number of finished episodes: first those of earlier runs, then after every
            episode.

    Raises:
        ValueError: if the directory holds results of other settings, or records that
            cannot be read.
    """
    results = ResultsDirectory(Path(directory))
    settings = results.take_up(comparison.common_config(), comparison.sources())
    for key in ("measured", "asked", "lengths"):
        settings.setdefault(key, {})

    # What each scenario needs to know beside the configuration.
    environments: dict[str, Any] = {}
    for scenario, controllers in comparison.controllers.items():
        asked = settings["asked"].setdefault(scenario, {})
        asked.update(
            {name: max(comparison.seeds, asked.get(name, 0)) for name in controllers}
        )
        environments[scenario] = make_environment(
            scenario, "naive", **comparison.config
        ).unwrapped
        settings["lengths"][scenario] = environments[scenario].episode_steps

    # Episodes that are there: only whole ones count.
    records = read_steps(results.path, settings, tells=True)
    if len(records) and list(records) != comparison.columns():
        columns = ", ".join(comparison.columns())
        raise ValueError(
            f"{results.path / STEPS_FILE}: its columns are not {columns}; choose"
            " another directory"
        )
    known = {*records[KEYS].itertuples(index=False, name=None)}
    wanted = list(comparison.episodes())
    missing = [key for key in wanted if key not in known]
    number = len(wanted) - len(missing)

    # Only now is anything measured or written.
    for scenario, env in environments.items():
        if env.settings.costs == "measured" and scenario not in settings["measured"]:
            env.measure()
            settings["measured"][scenario] = env.seconds
    results.write_settings(settings)
    yield number
    drive = partial(_driven, comparison, settings["measured"])
    for steps, late in _in_processes(drive, missing, min(processes, cores()), modules):
        results.add_late_sources(settings, late)
        write_table(steps, results.path / PARTS / f"{token_hex(8)}.csv")
        number += 1
        yield number
    if (results.path / PARTS).exists():
        write_table(read_steps(results.path, settings), results.path / STEPS_FILE)
        shutil.rmtree(results.path / PARTS)


def run_batched(
    comparison: Comparison,
    directory: Path,
    part: int = 1024,
    steps: bool = False,
    compute: Compute = simulate_parts,
) -> Iterator[int]:
    """Simulate the episodes that a directory lacks, part by part, of a single scenario.

    Args:
        comparison: what to simulate.
        directory: directory of the results.
        part: number of episodes in a part; one part at a time is in memory.
        steps: whether a row per step is kept as well, in ``steps``.
        compute: function that computes parts, here or elsewhere.

    Yields:
        The number of finished episodes: first those of earlier runs, then after every
            part.

    Raises:
        ValueError: if the comparison cannot be simulated, or the directory holds
            results of other settings or other files.
    """
    if len(comparison.controllers) != 1:
        raise ValueError(
            f"there are {len(comparison.controllers)} scenarios; a sweep is of one"
        )
    # Refuse what cannot be simulated before anything is written.
    batch = make_batch(comparison, *comparison.controllers)
    asked = {
        name: getattr(comparison, name)
        for name in ("controllers", "seeds", "first_seed")
    }
    results = ResultsDirectory(directory)
    settings = {**comparison.common_config(), **asked, "part": part, "steps": steps}
    settings = results.take_up(settings, comparison.sources())
    parts = episode_parts(comparison, part)

    # Parts that are there: only whole ones count.
    whole = len(read_episodes(directory, comparison, part))
    missing = {
        name: own
        for name, own in parts.items()
        if not (directory / EPISODES / name).exists()
    }
    if steps:
        rows = {
            name: batch.steps * len(own)
            for name, own in parts.items()
            if name not in missing
        }
        cut = [
            name
            for name, count in rows.items()
            if _rows(directory / STEPS / name) != count
        ]
        if cut:
            warn(
                f"{directory / STEPS}: parts that are not whole are computed again:"
                f" {len(cut)}",
                stacklevel=2,
            )
        missing = {
            name: own for name, own in parts.items() if name in missing or name in cut
        }
        whole -= sum(len(parts[name]) for name in cut)
    results.write_settings(settings)

    number = whole
    yield number
    kinds = (
        (STEPS, EPISODES) if steps else (EPISODES,)
    )  # episodes last: with them, the part is done
    for name, tables in compute(comparison, missing):
        results.add_late_sources(settings, late_sources())
        for kind in kinds:
            write_table(tables[kind], directory / kind / name)
        number += len(parts[name])
        yield number


def episode_parts(comparison: Comparison, part: int) -> dict[str, range]:
    """Return the places of the episodes of a sweep in `Comparison.episodes`, by the
    name of the file of their part.
    """
    places = range(len(list(comparison.episodes())))
    starts = places[::part]
    return {
        f"part-{number:06d}.parquet": places[start : start + part]
        for number, start in enumerate(starts)
    }


def _rows(file: Path) -> int:
    """Return the number of rows of a Parquet file, 0 if it is missing or cut."""
    import pyarrow.parquet

    try:
        return pyarrow.parquet.read_metadata(file).num_rows
    except (OSError, ValueError):  # pyarrow's own errors are among these
        return 0


def _in_processes(
    drive: Callable[[EpisodeKey], Driven],
    keys: Sequence[EpisodeKey],
    number: int,
    modules: Sequence[str],
) -> Iterator[Driven]:
    """Drive episodes in this process or, if they are many, in several; yield what
    `_driven` returns in any order.

    Each process drives neighbouring episodes, so that two processes rarely compile the
    same functions.
    """
    _environment.cache_clear()
    if number == 1 or len(keys) < MIN_EPISODES:
        yield from map(drive, keys)
        return
    pools = [
        own_process(partial(low_latency_on_core, core), modules)
        for core in range(number)
    ]
    share = ceil(len(keys) / number)
    try:
        driven = (
            pools[place // share].submit(drive, key) for place, key in enumerate(keys)
        )
        for done in as_completed(driven):
            yield done.result()
    except BrokenProcessPool as error:
        remedy = "start the same comparison again, and it resumes"
        raise OSError(f"a process that drove episodes has ended; {remedy}") from error
    finally:
        for pool in pools:
            pool.shutdown(cancel_futures=True)


def read(comparison: Comparison, directory: str | Path) -> pd.DataFrame:
    """Return the records of a comparison that `run` has finished in a directory, in the
    comparison's order.
    """
    return only(comparison, pd.read_csv(Path(directory) / STEPS_FILE))


def only(comparison: Comparison, records: pd.DataFrame) -> pd.DataFrame:
    """Return the records of a comparison's own episodes, in its order."""
    return pd.DataFrame(comparison.episodes(), columns=KEYS).merge(records)


def read_steps(directory: Path, settings: Mapping, tells: bool = False) -> pd.DataFrame:
    """Read and check the records of a directory, including episodes that are not in
    ``steps.csv`` yet.

    Episodes that are not whole are left out. If two files hold an episode, the first
    one counts.

    Args:
        directory: directory of the results.
        settings: settings of the results. Rows are in the order of the controllers in
            ``asked``, the others last, then of the seeds.
        tells: whether to warn of episodes that are not whole.

    Raises:
        ValueError: for a file that cannot be read.
    """
    tables = [pd.DataFrame(columns=KEYS)]
    for file in [
        directory / STEPS_FILE,
        *sorted((directory / PARTS).glob("[!.]*.csv")),
    ]:
        if file.exists():
            with reading(
                file, "choose another directory" if file.parent == directory else REMEDY
            ):
                steps, cut = _whole_episodes(file, settings)
            tables.append(steps)
            if cut and tells:
                warn(
                    f"{file}: episodes that are not whole are computed again: {cut}",
                    stacklevel=2,
                )
    records = pd.concat(tables[1:] or tables)
    if records.empty:
        return records

    # An episode counts once, from the first file that holds it.
    files = np.repeat(np.arange(len(tables) - 1), list(map(len, tables[1:])))
    first = records[KEYS].assign(file=files).groupby(KEYS)["file"].transform("min")
    records = records[first == files]

    asked = settings.get("asked", {})
    order = pd.DataFrame(
        [(name, each) for name in asked for each in asked[name]], columns=KEYS[:2]
    )
    order = pd.concat([order, records[KEYS[:2]]]).drop_duplicates()
    return order.merge(records.sort_values(["seed", "step"]))


def _whole_episodes(file: Path, settings: Mapping) -> tuple[pd.DataFrame, int]:
    """Return the steps of the whole episodes in a CSV file, and the number of those
    that lack steps or have one twice.

    Raises:
        ValueError: if the file holds something else; any other of
            `ms_highway.runtime.files.DAMAGES`.
    """
    steps = pd.read_csv(whole_lines(file))
    check_table(steps, NEEDED)

    # Of each episode: whether its steps count from 0, and whether it was driven to its
    # end.
    by_episode = steps.groupby(KEYS, sort=False)
    counts = by_episode["step"].transform("size")
    in_order = (
        steps["step"]
        .eq(by_episode.cumcount())
        .groupby([steps[key] for key in KEYS])
        .transform("all")
    )
    lengths = steps["scenario"].map(settings.get("lengths", {})).fillna(counts)
    ended = counts == lengths
    if settings.get("terminate_on_collision"):
        ended |= by_episode["collision"].transform("last").astype(bool)
    whole = in_order & ended
    cut = len(steps[~whole][KEYS].drop_duplicates())
    return steps[whole], cut


def read_episodes(directory: Path, comparison: Comparison, part: int) -> pd.DataFrame:
    """Read and check the simulated episodes of a directory, a row for each, in the
    order of the parts.

    Args:
        directory: directory of the results.
        comparison: what was simulated.
        part: number of episodes in a part.

    Raises:
        ValueError: for a part that cannot be read, or holds other episodes.
    """
    tables = [pd.DataFrame(columns=KEYS)]
    keys = list(comparison.episodes())
    for name, places in episode_parts(comparison, part).items():
        file = directory / EPISODES / name
        if file.exists():
            with reading(file, REMEDY):
                table = pd.read_parquet(file)
                check_table(table)
                if [*table[KEYS].itertuples(index=False, name=None)] != keys[
                    places.start : places.stop
                ]:
                    raise ValueError("it holds other episodes than its number says")
                tables.append(table)
    return pd.concat(tables[1:] or tables)


def _driven(comparison: Comparison, measured: Mapping, key: EpisodeKey) -> Driven:
    """Drive one episode; return its records, and what modules have imported and read in
    this process so far.
    """
    scenario, controller, seed = key
    config = dict(comparison.config)
    if (
        scenario in measured and controller_config(controller)["type"] != "budget"
    ):  # budgets need a high quantile
        config["costs"] = measured[scenario]
    env = _environment(scenario, controller, json.dumps(config))
    records = pd.DataFrame(episode(env, seed)).assign(
        scenario=scenario, controller=controller, seed=seed
    )
    return records.reindex(columns=comparison.columns()), late_sources()


@lru_cache(maxsize=1)
def _environment(scenario: str, controller: str, config: str) -> gym.Env:
    """Make an environment, or reuse that of the last episode."""
    return make_environment(scenario, controller, **json.loads(config))


def make_environment(
    scenario: str, controller: str, render: bool = False, **config: Any
) -> gym.Env:
    """Make the environment of a scenario with the robot driven by a controller.

    Args:
        scenario: name of the scenario.
        controller: short name of a controller or an agent, see
            `ms_highway.envs.registry.controller_config`.
        render: whether to render ``rgb_array`` frames.
        config: further configuration of the environment.

    Raises:
        ValueError: for an unknown scenario, controller or configuration.
    """
    whole = {**config, **robot_config(controller)}
    env = gym.make(
        environment_id(scenario),
        render_mode="rgb_array" if render else None,
        config=whole,
    )
    return AgentDrives(env, controller) if is_agent(controller) else env


def episode(env: gym.Env, seed: int) -> Iterator[dict]:
    """Run one episode with the robot's own controller; yield a record per step.

    A record has all of ``info``, and the columns of
    `ms_highway.experiments.comparison.Comparison.columns` from ``step`` on.
    """
    env.reset(seed=seed)
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    for step in count():
        _, reward, terminated, truncated, info = env.step(0)
        estimated = {
            name: gain for name, gain in info["gains"].items() if gain != NOT_ESTIMATED
        }
        columns = by_column(estimated, inner.car_states)
        yield {
            **info,
            **asdict(info["timing"]),
            **columns,
            "step": step,
            "reward": reward,
        }
        if terminated or truncated:
            return
