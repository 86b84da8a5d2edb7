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
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from itertools import count
from math import ceil
from pathlib import Path
from secrets import token_hex
from typing import TypeAlias
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
    REQUIRED,
    Comparison,
    EpisodeKey,
    by_column,
    check_table,
)
from ms_highway.experiments.directory import ResultsDirectory, write_table
from ms_highway.runtime.files import reading, whole_lines
from ms_highway.runtime.jax_settings import cores, low_latency_on_core, own_process
from ms_highway.runtime.sources import Sources, late_sources


@dataclass(frozen=True)
class ResultFiles:
    """Name the files and directories of results."""

    steps_file: str = "steps.csv"
    """Records of a live comparison, a row per step."""
    parts: str = "parts"
    """Directory of episodes that are not in `steps_file` yet, a file for each."""
    episodes: str = "episodes"
    """Directory of the parts of a sweep, with a row per episode."""
    steps: str = "steps"
    """Directory of the parts of a sweep, with a row per step."""
    remedy: str = "remove it, to have it computed again"
    """What to do about a piece that cannot be read."""


FILES = ResultFiles()

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
    """Drive the episodes that a directory lacks; put all into ``steps.csv`` at the end.

    Args:
        comparison: what to drive.
        directory: directory of the results.
        processes: number of processes that drive at once, each on a core of its own,
            but no more than there are cores. If fewer than 60 episodes are missing,
            this process alone drives them.
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

    # What the settings say of each scenario beside the configuration.
    environments: dict[str, InteractionEnv] = {}
    for scenario, controllers in comparison.controllers.items():
        asked = settings["asked"].setdefault(scenario, {})
        for name in controllers:
            asked[name] = max(comparison.seeds, asked.get(name, 0))
        env = interaction(make_environment(scenario, "naive", **comparison.config))
        settings["lengths"][scenario] = env.episode_steps
        environments[scenario] = env

    # Episodes that are there: only whole ones count.
    records = read_steps(results.path, settings, tells=True)
    if len(records) and list(records) != comparison.columns():
        columns = ", ".join(comparison.columns())
        raise ValueError(
            f"{results.path / FILES.steps_file}: its columns are not {columns}; choose"
            " another directory"
        )
    known = set(_episode_keys(records))
    asked_episodes = list(comparison.episodes())
    missing = [key for key in asked_episodes if key not in known]
    finished = len(asked_episodes) - len(missing)

    # Only now is anything measured or written.
    for scenario, env in environments.items():
        if env.settings.costs == "measured" and scenario not in settings["measured"]:
            env.measure()
            settings["measured"][scenario] = env.seconds
    results.write_settings(settings)
    yield finished

    # Drive, and keep each episode in a file of its own until all are there.
    parts = results.path / FILES.parts
    drive = partial(_drive, comparison, settings["measured"])
    for steps, late in _in_processes(drive, missing, min(processes, cores()), modules):
        results.add_late_sources(settings, late)
        write_table(steps, parts / f"{token_hex(8)}.csv")
        finished += 1
        yield finished
    if parts.exists():
        all_steps = read_steps(results.path, settings)
        write_table(all_steps, results.path / FILES.steps_file)
        shutil.rmtree(parts)


def run_batched(
    comparison: Comparison,
    directory: Path,
    part: int = 1024,
    steps: bool | None = None,
    compute: Compute = simulate_parts,
) -> Iterator[int]:
    """Simulate the episodes that a directory lacks, part by part, of a single scenario.

    Args:
        comparison: what to simulate.
        directory: directory of the results.
        part: number of episodes in a part; one part at a time is in memory.
        steps: whether a row per step is kept as well, in ``steps``; settings of results
            hold it as it is given.
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
    results = ResultsDirectory(directory)
    settings = {
        **comparison.common_config(),
        "controllers": comparison.controllers,
        "seeds": comparison.seeds,
        "first_seed": comparison.first_seed,
        "part": part,
        "steps": steps,
    }
    settings = results.take_up(settings, comparison.sources())

    # Parts that are there: only whole ones count.
    parts = episode_parts(comparison, part)
    finished = len(read_episodes(directory, comparison, part))
    there = [name for name in parts if (directory / FILES.episodes / name).exists()]
    if steps:
        steps_directory = directory / FILES.steps
        cut = []
        for name in there:
            if _rows(steps_directory / name) != batch.steps * len(parts[name]):
                cut.append(name)
                finished -= len(parts[name])
        there = [name for name in there if name not in cut]
        if cut:
            warn(
                f"{steps_directory}: parts that are not whole are computed again:"
                f" {len(cut)}",
                stacklevel=2,
            )
    missing = {name: places for name, places in parts.items() if name not in there}
    results.write_settings(settings)
    yield finished

    # Write the episodes last: with them, the part is done.
    kinds = (FILES.steps, FILES.episodes) if steps else (FILES.episodes,)
    for name, tables in compute(comparison, missing):
        results.add_late_sources(settings, late_sources())
        for kind in kinds:
            write_table(tables[kind], directory / kind / name)
        finished += len(parts[name])
        yield finished


def episode_parts(comparison: Comparison, part: int) -> dict[str, range]:
    """Return the places of the episodes of each part of a sweep.

    They are places in `Comparison.episodes`, by the name of the part's file.
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
    except (OSError, ValueError):
        # pyarrow's own errors are among these.
        return 0


def _in_processes(
    drive: Callable[[EpisodeKey], Driven],
    keys: Sequence[EpisodeKey],
    number: int,
    modules: Sequence[str],
) -> Iterator[Driven]:
    """Drive episodes in this process or, if they are many, in several.

    Yield what `_drive` returns, in any order. Each process drives neighbouring
    episodes, so that two processes rarely compile the same functions.
    """
    _environment.cache_clear()
    # With fewer episodes, further processes take more time to start than they save.
    least_episodes = 60
    if number == 1 or len(keys) < least_episodes:
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
    """Return the records of a comparison that `run` has finished, in its order."""
    return only(comparison, pd.read_csv(Path(directory) / FILES.steps_file))


def only(comparison: Comparison, records: pd.DataFrame) -> pd.DataFrame:
    """Return the records of a comparison's own episodes, in its order."""
    return pd.DataFrame(comparison.episodes(), columns=KEYS).merge(records)


def read_steps(directory: Path, settings: Mapping, tells: bool = False) -> pd.DataFrame:
    """Read and check the records of a directory.

    They include episodes that are not in ``steps.csv`` yet. Episodes that are not whole
    are left out. If two files hold an episode, the first one counts.

    Args:
        directory: directory of the results.
        settings: settings of the results. Rows are in the order of the controllers in
            ``asked``, the others last, then of the seeds.
        tells: whether to warn of episodes that are not whole.

    Raises:
        ValueError: for a file that cannot be read.
    """
    joined = directory / FILES.steps_file
    parts = sorted((directory / FILES.parts).glob("[!.]*.csv"))
    tables = []
    for file in [joined, *parts]:
        if not file.exists():
            continue
        remedy = "choose another directory" if file == joined else FILES.remedy
        with reading(file, remedy):
            steps, cut = _whole_episodes(file, settings)
        tables.append(steps)
        if cut and tells:
            warn(
                f"{file}: episodes that are not whole are computed again: {cut}",
                stacklevel=2,
            )
    records = pd.concat(tables) if tables else pd.DataFrame(columns=KEYS)
    if records.empty:
        return records

    # An episode counts once, from the first file that holds it.
    files = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    first = records[KEYS].assign(file=files).groupby(KEYS)["file"].transform("min")
    records = records[first == files]

    # Asked controllers come first, in their order.
    by = ["scenario", "controller"]
    asked = settings.get("asked", {})
    rows = [(scenario, name) for scenario, own in asked.items() for name in own]
    order = pd.concat([pd.DataFrame(rows, columns=by), records[by]]).drop_duplicates()
    return order.merge(records.sort_values(["seed", "step"]))


def _whole_episodes(file: Path, settings: Mapping) -> tuple[pd.DataFrame, int]:
    """Return the steps of the whole episodes in a CSV file, and the number of others.

    The others lack steps or have one twice.

    Raises:
        ValueError: if the file holds something else; any other of
            `ms_highway.runtime.files.DAMAGES`.
    """
    steps = pd.read_csv(whole_lines(file))
    check_table(steps, REQUIRED)
    by_episode = steps.groupby(KEYS, sort=False)

    # Whether the steps of an episode count from 0.
    counts_on = steps["step"].eq(by_episode.cumcount())
    in_order = counts_on.groupby([steps[key] for key in KEYS]).transform("all")

    # Whether it was driven to its end.
    counts = by_episode["step"].transform("size")
    lengths = steps["scenario"].map(settings.get("lengths", {})).fillna(counts)
    ended = counts == lengths
    if settings.get("terminate_on_collision"):
        ended |= by_episode["collision"].transform("last").astype(bool)

    whole = in_order & ended
    cut = len(steps[~whole][KEYS].drop_duplicates())
    return steps[whole], cut


def read_episodes(directory: Path, comparison: Comparison, part: int) -> pd.DataFrame:
    """Read and check the simulated episodes of a directory, a row for each.

    They are in the order of the parts.

    Args:
        directory: directory of the results.
        comparison: what was simulated.
        part: number of episodes in a part.

    Raises:
        ValueError: for a part that cannot be read, or holds other episodes.
    """
    tables = []
    keys = list(comparison.episodes())
    for name, places in episode_parts(comparison, part).items():
        file = directory / FILES.episodes / name
        if file.exists():
            with reading(file, FILES.remedy):
                table = pd.read_parquet(file)
                check_table(table)
                if _episode_keys(table) != keys[places.start : places.stop]:
                    raise ValueError("it holds other episodes than its number says")
                tables.append(table)
    return pd.concat(tables) if tables else pd.DataFrame(columns=KEYS)


def _episode_keys(table: pd.DataFrame) -> list[EpisodeKey]:
    """Return the scenario, controller and seed of every row."""
    return list(table[KEYS].itertuples(index=False, name=None))


def _drive(comparison: Comparison, measured: Mapping, key: EpisodeKey) -> Driven:
    """Drive one episode.

    Returns:
        Its records, and what modules have imported and read in this process so far.
    """
    scenario, controller, seed = key
    config = dict(comparison.config)
    # Budgets need a high quantile of the measured times, which they measure themselves.
    if scenario in measured and controller_config(controller)["type"] != "budget":
        config["costs"] = measured[scenario]
    env = _environment(scenario, controller, json.dumps(config))
    records = pd.DataFrame(episode(env, seed))
    records = records.assign(scenario=scenario, controller=controller, seed=seed)
    return records.reindex(columns=comparison.columns()), late_sources()


@lru_cache(maxsize=1)
def _environment(scenario: str, controller: str, config: str) -> gym.Env:
    """Make an environment, or reuse that of the last episode."""
    return make_environment(scenario, controller, **json.loads(config))


def make_environment(
    scenario: str,
    controller: str,
    render: bool = False,
    **config: object,
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
    env = gym.make(
        environment_id(scenario),
        render_mode="rgb_array" if render else None,
        config={**config, **robot_config(controller)},
    )
    return AgentDrives(env, controller) if is_agent(controller) else env


def interaction(env: gym.Env) -> InteractionEnv:
    """Return the environment of a scenario without its wrappers."""
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    return inner


def episode(env: gym.Env, seed: int) -> Iterator[dict]:
    """Run one episode with the robot's own controller; yield a record per step.

    A record has all of ``info``, and the columns of
    `ms_highway.experiments.comparison.Comparison.columns` from ``step`` on.
    """
    env.reset(seed=seed)
    inner = interaction(env)
    for step in count():
        _, reward, terminated, truncated, info = env.step(0)
        estimated = {
            name: gain for name, gain in info["gains"].items() if gain != NOT_ESTIMATED
        }
        yield {
            **info,
            **asdict(info["timing"]),
            **by_column(estimated, np.asarray(inner.car_states)),
            "step": step,
            "reward": reward,
        }
        if terminated or truncated:
            return
