"""Drive episodes of a comparison in the environments, and read their records.

Every episode is written to a file of its own when it ends, by one process: it is either whole in the results or driven
again. All of them together become ``steps.csv`` at the end.
"""

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from functools import lru_cache, partial
from itertools import count
from math import ceil
from pathlib import Path
from secrets import token_hex
from typing import Any

import gymnasium as gym
import pandas as pd

from ms_highway.envs import environment_id
from ms_highway.envs.agents import AgentDrives, is_agent
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.registry import controller_config, robot_config
from ms_highway.experiments.comparison import Comparison, EpisodeKey
from ms_highway.experiments.directory import EXTENDED, ResultsDirectory
from ms_highway.experiments.records import KEYS, by_column, check_records
from ms_highway.runtime.files import reading, replacing
from ms_highway.runtime.jax_settings import cores, low_latency_on_core, own_process

STEPS_FILE, PARTS = "steps.csv", "parts"
FEWEST = 60  # episodes that are worth the seconds in which further processes start


def run(
    comparison: Comparison, directory: str | Path, processes: int = 1, modules: Sequence[str] = ()
) -> Iterator[int]:
    """Drive the episodes that a directory lacks; put the records of all into ``steps.csv`` at the end.

    Args:
        comparison: what to drive.
        directory: of the results.
        processes: how many drive at once, each on a core of its own, if there are so many cores and at least `FEWEST`
            episodes to drive; otherwise, this process alone does.
        modules: to import in other processes, for scenarios and models that they add.

    Yields:
        The number of episodes there: first of those that earlier runs have left, then after every episode.

    Raises:
        ValueError: if the directory holds results of other settings, or records that cannot be read.
    """
    results = ResultsDirectory(Path(directory))
    settings = results.take_up(comparison.common_config())
    settings |= {key: settings.get(key, {}) for key in EXTENDED}
    records, parts = read_steps(results.path, settings), results.path / PARTS
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
    there, wanted = {*records[KEYS].itertuples(index=False, name=None)}, list(comparison.episodes())
    missing = [key for key in wanted if key not in there]
    number = len(wanted) - len(missing)
    yield number
    for driven in _episodes(comparison, settings["measured"], missing, min(processes, cores()), modules):
        with replacing(parts / f"{token_hex(8)}.csv") as path:
            driven.to_csv(path, index=False)
        number += 1
        yield number
    if parts.exists():
        records = read_steps(results.path, settings)
        with replacing(results.path / STEPS_FILE) as path:
            records.to_csv(path, index=False)
        shutil.rmtree(parts)


def _episodes(
    comparison: Comparison, measured: Mapping[str, Any], keys: list[EpisodeKey], processes: int, modules: Sequence[str]
) -> Iterator[pd.DataFrame]:
    """Drive episodes in this process, or many in several, each on a core; yield their records in any order.

    Each process has a share of neighbours, so that two rarely compile the same functions.
    """
    _environment.cache_clear()
    if processes == 1 or len(keys) < FEWEST:
        yield from (_driven(comparison, measured, key) for key in keys)
        return
    pools = [own_process(partial(low_latency_on_core, core), modules) for core in range(processes)]
    share = ceil(len(keys) / processes)
    try:
        driven = (pools[place // share].submit(_driven, comparison, measured, key) for place, key in enumerate(keys))
        for done in as_completed(driven):
            yield done.result()
    except BrokenProcessPool as error:
        remedy = "start the same comparison again, which resumes"
        raise OSError(f"a process that drove episodes has ended; {remedy}") from error
    finally:
        for pool in pools:
            pool.shutdown(cancel_futures=True)


def _driven(comparison: Comparison, measured: Mapping[str, Any], key: EpisodeKey) -> pd.DataFrame:
    """Drive one episode and return its records."""
    scenario, controller, seed = key
    config = dict(comparison.config)
    if scenario in measured and controller_config(controller)["type"] != "budget":  # which needs a high quantile
        config["costs"] = measured[scenario]
    env = _environment(scenario, controller, json.dumps(config))
    records = pd.DataFrame(episode(env, seed)).assign(scenario=scenario, controller=controller, seed=seed)
    return records.reindex(columns=comparison.columns())


@lru_cache(maxsize=1)
def _environment(scenario: str, controller: str, config: str) -> gym.Env:
    """Make an environment, or use that of the episode before again."""
    return make_environment(scenario, controller, **json.loads(config))


def read(comparison: Comparison, directory: str | Path) -> pd.DataFrame:
    """Return the records of a comparison that `run` has finished in a directory, in the comparison's order."""
    return only(comparison, pd.read_csv(Path(directory) / STEPS_FILE))


def only(comparison: Comparison, records: pd.DataFrame) -> pd.DataFrame:
    """Return the records of a comparison's own episodes, in its order."""
    return pd.DataFrame(comparison.episodes(), columns=KEYS).merge(records)


def read_steps(directory: Path, settings: Mapping[str, Any]) -> pd.DataFrame:
    """Return the records of a directory, also of episodes that are not in ``steps.csv`` yet; check them.

    Args:
        directory: of a comparison.
        settings: of its results. Rows are sorted by the controllers in ``asked``, others last, then by seed.

    Raises:
        ValueError: for a file that cannot be read.
    """
    tables = []
    for file in (*directory.glob(STEPS_FILE), *(directory / PARTS).glob("[!.]*.csv")):
        with reading(file, "choose another directory"):
            tables.append(pd.read_csv(file))
    if not tables:
        return pd.DataFrame(columns=[*KEYS, "step"])
    with reading(directory / STEPS_FILE, "choose another directory"):
        records = pd.concat(tables)
        check_records(records)
    asked = settings.get("asked", {})
    order = pd.DataFrame([(name, each) for name in asked for each in asked[name]], columns=KEYS[:2])
    order = pd.concat([order, records[KEYS[:2]]]).drop_duplicates()
    return order.merge(records.drop_duplicates([*KEYS, "step"]).sort_values(["seed", "step"]))


def make_environment(scenario: str, controller: str, render: bool = False, **config: Any) -> gym.Env:
    """Make the environment of a scenario with the robot driven by a controller.

    Args:
        scenario: its name.
        controller: short name of a controller or an agent, see `ms_highway.envs.registry.controller_config`.
        render: whether to render ``rgb_array`` frames.
        config: further configuration of the environment.

    Raises:
        ValueError: for an unknown scenario, controller or configuration.
    """
    whole = {**config, **robot_config(controller)}
    env = gym.make(environment_id(scenario), render_mode="rgb_array" if render else None, config=whole)
    return AgentDrives(env, controller) if is_agent(controller) else env


def episode(env: gym.Env, seed: int) -> Iterator[dict[str, Any]]:
    """Run one episode with the robot's own controller; yield a record per step.

    It has the columns from ``step`` on, see `ms_highway.experiments.records.columns`, and all of ``info``.
    """
    env.reset(seed=seed)
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    for step in count():
        _, reward, terminated, truncated, info = env.step(0)
        columns = by_column(info["gains"], inner.car_states)
        yield {**info, **asdict(info["timing"]), **columns, "step": step, "reward": reward}
        if terminated or truncated:
            return
