"""Run comparisons, live in the environments or in batches, and read their records.

A directory holds the results in pieces, each in a file that is either complete or absent. A live run writes a CSV file
per episode, with a row per step, and joins them in ``steps.csv`` at the end. A simulation writes Parquet files of many
episodes, with a row per episode; together, they need not fit in memory. A run that was stopped resumes with the
episodes that are in no file.
"""

import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from functools import lru_cache, partial
from itertools import count
from math import ceil
from pathlib import Path
from secrets import token_hex
from typing import Any, TypeAlias

import gymnasium as gym
import pandas as pd

from ms_highway.choice.rule import NOT_ESTIMATED
from ms_highway.envs import environment_id
from ms_highway.envs.agents import AgentDrives, is_agent
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.registry import controller_config, robot_config
from ms_highway.experiments.batch import Tables, make_batch, simulate_parts
from ms_highway.experiments.comparison import KEYS, NEEDED, Comparison, EpisodeKey, by_column, check_table
from ms_highway.experiments.directory import EXTENDED, ResultsDirectory, write_table
from ms_highway.runtime.files import reading
from ms_highway.runtime.jax_settings import cores, low_latency_on_core, own_process

STEPS_FILE, PARTS = "steps.csv", "parts"
EPISODES = "episodes"
REMEDY = "remove it, to have it computed again"
MIN_EPISODES = 60  # with fewer, further processes take more time to start than they save

Compute: TypeAlias = Callable[[Comparison, Mapping[str, range]], Iterator[tuple[str, Tables]]]
"""Computes named parts, each a range of places in `Comparison.episodes`; yields them by name, in any order."""


def run(
    comparison: Comparison, directory: str | Path, processes: int = 1, modules: Sequence[str] = ()
) -> Iterator[int]:
    """Drive the episodes that a directory lacks; put the records of all into ``steps.csv`` at the end.

    Args:
        comparison: what to drive.
        directory: directory of the results.
        processes: number of processes that drive at once, each on a core of its own, but no more than there are cores.
            If fewer than `MIN_EPISODES` episodes are missing, this process alone drives them.
        modules: modules that other processes import, for scenarios and models that they add.

    Yields:
        The number of finished episodes: first those of earlier runs, then after every episode.

    Raises:
        ValueError: if the directory holds results of other settings, or records that cannot be read.
    """
    results = ResultsDirectory(Path(directory))
    settings = results.take_up(comparison.common_config())
    settings |= {key: settings.get(key, {}) for key in EXTENDED}
    records = read_steps(results.path, settings)
    if len(records) and list(records) != comparison.columns():
        columns = ", ".join(comparison.columns())
        raise ValueError(f"{results.path / STEPS_FILE}: its columns are not {columns}; choose another directory")
    for scenario, controllers in comparison.controllers.items():
        asked = settings["asked"].setdefault(scenario, {})
        asked.update({name: max(comparison.seeds, asked.get(name, 0)) for name in controllers})
        env: Any = make_environment(scenario, "naive", **comparison.config).unwrapped
        if env.settings.costs == "measured" and scenario not in settings["measured"]:
            env.measure()
            settings["measured"][scenario] = env.seconds
    results.write_settings(settings)

    known, wanted = {*records[KEYS].itertuples(index=False, name=None)}, list(comparison.episodes())
    missing = [key for key in wanted if key not in known]
    number = len(wanted) - len(missing)
    yield number
    drive = partial(_driven, comparison, settings["measured"])
    for steps in _in_processes(drive, missing, min(processes, cores()), modules):
        write_table(steps, results.path / PARTS / f"{token_hex(8)}.csv")
        number += 1
        yield number
    if (results.path / PARTS).exists():
        write_table(read_steps(results.path, settings), results.path / STEPS_FILE)
        shutil.rmtree(results.path / PARTS)


def run_batched(
    comparison: Comparison, directory: Path, part: int = 1024, steps: bool = False, compute: Compute = simulate_parts
) -> Iterator[int]:
    """Simulate the episodes that a directory lacks, part by part, of a single scenario.

    Args:
        comparison: what to simulate.
        directory: directory of the results.
        part: number of episodes in a part; one part at a time is in memory.
        steps: whether a row per step is kept as well, in ``steps``.
        compute: function that computes parts, here or elsewhere.

    Yields:
        The number of finished episodes: first those of earlier runs, then after every part.

    Raises:
        ValueError: if the comparison cannot be simulated, or the directory holds results of other settings or other
            files.
    """
    if len(comparison.controllers) != 1:
        raise ValueError(f"there are {len(comparison.controllers)} scenarios; a sweep is of one")
    make_batch(comparison, *comparison.controllers)  # refuses what cannot be simulated before anything is written
    asked = {name: getattr(comparison, name) for name in ("controllers", "seeds", "first_seed")}
    results = ResultsDirectory(directory)
    results.write_settings(results.take_up({**comparison.common_config(), **asked, "part": part, "steps": steps}))
    keys = list(comparison.episodes())
    places = [range(len(keys))[first : first + part] for first in range(0, len(keys), part)]
    parts = {f"part-{number:06d}.parquet": own for number, own in enumerate(places)}
    number = len(read_episodes(directory, {name: keys[own.start : own.stop] for name, own in parts.items()}))
    yield number
    kinds = ("steps", EPISODES) if steps else (EPISODES,)  # episodes last: with them, the part is done
    missing = {name: own for name, own in parts.items() if not (directory / EPISODES / name).exists()}
    for name, tables in compute(comparison, missing):
        for kind in kinds:
            write_table(tables[kind], directory / kind / name)
        number += len(parts[name])
        yield number


def _in_processes(
    drive: Callable[[EpisodeKey], pd.DataFrame], keys: Sequence[EpisodeKey], number: int, modules: Sequence[str]
) -> Iterator[pd.DataFrame]:
    """Drive episodes in this process or, if they are many, in several; yield their records in any order.

    Each process drives neighbouring episodes, so that two processes rarely compile the same functions.
    """
    _environment.cache_clear()
    if number == 1 or len(keys) < MIN_EPISODES:
        yield from map(drive, keys)
        return
    pools = [own_process(partial(low_latency_on_core, core), modules) for core in range(number)]
    share = ceil(len(keys) / number)
    try:
        driven = (pools[place // share].submit(drive, key) for place, key in enumerate(keys))
        for done in as_completed(driven):
            yield done.result()
    except BrokenProcessPool as error:
        remedy = "start the same comparison again, and it resumes"
        raise OSError(f"a process that drove episodes has ended; {remedy}") from error
    finally:
        for pool in pools:
            pool.shutdown(cancel_futures=True)


def read(comparison: Comparison, directory: str | Path) -> pd.DataFrame:
    """Return the records of a comparison that `run` has finished in a directory, in the comparison's order."""
    return only(comparison, pd.read_csv(Path(directory) / STEPS_FILE))


def only(comparison: Comparison, records: pd.DataFrame) -> pd.DataFrame:
    """Return the records of a comparison's own episodes, in its order."""
    return pd.DataFrame(comparison.episodes(), columns=KEYS).merge(records)


def read_steps(directory: Path, settings: Mapping) -> pd.DataFrame:
    """Read and check the records of a directory, including episodes that are not in ``steps.csv`` yet.

    Args:
        directory: directory of the results.
        settings: settings of the results. Rows are in the order of the controllers in ``asked``, the others last, then
            of the seeds.

    Raises:
        ValueError: for a file that cannot be read.
    """
    records = _read(directory, [STEPS_FILE, f"{PARTS}/[!.]*.csv"], NEEDED)
    if records.empty:
        return records
    asked = settings.get("asked", {})
    order = pd.DataFrame([(name, each) for name in asked for each in asked[name]], columns=KEYS[:2])
    order = pd.concat([order, records[KEYS[:2]]]).drop_duplicates()
    return order.merge(records.drop_duplicates([*KEYS, "step"]).sort_values(["seed", "step"]))


def read_episodes(directory: Path, parts: Mapping[str, list[EpisodeKey]] | None = None) -> pd.DataFrame:
    """Read and check the simulated episodes of a directory, a row for each, in the order of the parts.

    Args:
        directory: directory of the results.
        parts: episodes of each part by the name of its file, to be checked; by default, they are not.

    Raises:
        ValueError: for a part that cannot be read, or holds other episodes.
    """
    return _read(directory, [f"{EPISODES}/part-*.parquet"], [], parts)


def _read(
    directory: Path,
    patterns: Iterable[str],
    needed: Sequence[str],
    parts: Mapping[str, list[EpisodeKey]] | None = None,
) -> pd.DataFrame:
    """Return the rows of all files; check their columns and, if they are parts, their episodes."""
    tables = [pd.DataFrame(columns=KEYS)]
    for file in (file for pattern in patterns for file in sorted(directory.glob(pattern))):
        with reading(file, "choose another directory" if file.parent == directory else REMEDY):
            tables.append(pd.read_parquet(file) if file.suffix == ".parquet" else pd.read_csv(file))
            check_table(tables[-1], needed)
            if parts and parts.get(file.name) != [*tables[-1][KEYS].itertuples(index=False, name=None)]:
                raise ValueError("it holds other episodes than its number says")
    return pd.concat(tables[1:] or tables)


def _driven(comparison: Comparison, measured: Mapping, key: EpisodeKey) -> pd.DataFrame:
    """Drive one episode and return its records."""
    scenario, controller, seed = key
    config = dict(comparison.config)
    if scenario in measured and controller_config(controller)["type"] != "budget":  # budgets need a high quantile
        config["costs"] = measured[scenario]
    env = _environment(scenario, controller, json.dumps(config))
    records = pd.DataFrame(episode(env, seed)).assign(scenario=scenario, controller=controller, seed=seed)
    return records.reindex(columns=comparison.columns())


@lru_cache(maxsize=1)
def _environment(scenario: str, controller: str, config: str) -> gym.Env:
    """Make an environment, or reuse that of the last episode."""
    return make_environment(scenario, controller, **json.loads(config))


def make_environment(scenario: str, controller: str, render: bool = False, **config: Any) -> gym.Env:
    """Make the environment of a scenario with the robot driven by a controller.

    Args:
        scenario: name of the scenario.
        controller: short name of a controller or an agent, see `ms_highway.envs.registry.controller_config`.
        render: whether to render ``rgb_array`` frames.
        config: further configuration of the environment.

    Raises:
        ValueError: for an unknown scenario, controller or configuration.
    """
    whole = {**config, **robot_config(controller)}
    env = gym.make(environment_id(scenario), render_mode="rgb_array" if render else None, config=whole)
    return AgentDrives(env, controller) if is_agent(controller) else env


def episode(env: gym.Env, seed: int) -> Iterator[dict]:
    """Run one episode with the robot's own controller; yield a record per step.

    A record has all of ``info``, and the columns of `ms_highway.experiments.comparison.Comparison.columns` from
    ``step`` on.
    """
    env.reset(seed=seed)
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    for step in count():
        _, reward, terminated, truncated, info = env.step(0)
        estimated = {name: gain for name, gain in info["gains"].items() if gain != NOT_ESTIMATED}
        columns = by_column(estimated, inner.car_states)
        yield {**info, **asdict(info["timing"]), **columns, "step": step, "reward": reward}
        if terminated or truncated:
            return
