"""Run episodes of a comparison and keep their records part by part, so that an interrupted run goes on where it was.

A part is an episode in the environments, or many that are simulated together (`ms_highway.experiments.sweep`). What
computes parts yields them as they are done, in any order, and this process alone writes them: a part is either whole in
the results or computed again.
"""

import io
import json
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, lru_cache, partial
from itertools import count
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Protocol

import gymnasium as gym
import pandas as pd

from ms_highway.envs import environment_id
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.registry import controller_config
from ms_highway.experiments.comparison import Comparison, EpisodeKey, episode_steps
from ms_highway.experiments.directory import EXTENDED, ResultsDirectory, comparison_config
from ms_highway.experiments.records import CARS, KEYS, check_records, columns, gain_column, state_columns
from ms_highway.runtime.files import reading, replacing
from ms_highway.runtime.jax_settings import cores, low_latency_on_core, start_worker

STEPS_FILE, PARTS = "steps.csv", "parts"
FEWEST = 60  # episodes that are worth the seconds in which further processes start


class Parts(Protocol):
    """Results that are computed and kept part by part."""

    @property
    def episodes(self) -> int:
        """How many are wanted."""

    def missing(self) -> dict[Any, int]:
        """Return the parts that are not there yet, and how many episodes each has."""

    def write(self, part: Any, rows: Any) -> None:
        """Write a part, whole."""


def run_parts(parts: Parts, compute: Callable[[Sequence[Any]], Iterator[tuple[Any, Any]]]) -> Iterator[int]:
    """Compute the parts that are missing and write each when it is done.

    Args:
        parts: what is wanted, and where it is kept.
        compute: computes parts and yields each with its rows, in any order.

    Yields:
        The number of episodes there: first of those that earlier runs have left, then after every part.

    Raises:
        ValueError: if what is there cannot be read, or is of other settings.
    """
    missing = parts.missing()
    number = parts.episodes - sum(missing.values())
    yield number
    for part, rows in compute(list(missing)):
        parts.write(part, rows)
        number += missing[part]
        yield number


def run(
    comparison: Comparison, directory: str | Path, processes: int = 1, modules: Sequence[str] = ()
) -> Iterator[int]:
    """Run the episodes that ``directory`` lacks, write each when it ends, and all to ``steps.csv`` at the end.

    Args:
        comparison: what to run.
        directory: of the results.
        processes: how many run episodes at once, each on a core of its own, if there are so many cores and at least
            `FEWEST` episodes to run; otherwise, this process alone does.
        modules: to import in other processes, for scenarios and models that they add.

    Yields:
        The number of episodes there: first of those that earlier runs have left, then after every episode.

    Raises:
        ValueError: if the directory holds results of other settings, or records that cannot be read.
    """
    results = ResultsDirectory(Path(directory))
    settings = results.take_up(comparison.common_config())
    settings |= {key: settings.get(key, {}) for key in EXTENDED}
    for scenario, controllers in comparison.controllers.items():
        asked = settings["asked"].setdefault(scenario, {})
        asked.update({name: max(comparison.seeds, asked.get(name, 0)) for name in controllers})
    episodes = LiveEpisodes(comparison, results.path, settings)
    counts = run_parts(episodes, partial(_drive, episodes, min(processes, cores()), modules))
    already = next(counts)  # refuses what cannot be resumed, before anything is written
    for scenario in comparison.controllers:
        measured = comparison.environment_config(scenario, "naive")["costs"] == "measured"
        if measured and scenario not in settings["measured"]:
            settings["measured"][scenario] = measured_seconds(scenario, comparison)
    results.write_settings(settings)
    yield already
    yield from counts
    episodes.collect()


def read(comparison: Comparison, directory: str | Path) -> pd.DataFrame:
    """Return the records of a comparison that `run` has finished in a directory, in the comparison's order."""
    return pd.DataFrame(comparison.episodes(), columns=KEYS).merge(pd.read_csv(Path(directory) / STEPS_FILE))


def read_steps(directory: Path, settings: Mapping[str, Any]) -> pd.DataFrame:
    """Return the records of whole episodes, also of parts that have not been put into ``steps.csv`` yet; check them.

    Earlier versions wrote step by step and may have left an episode unfinished, which counts as not driven.

    Args:
        directory: of a comparison.
        settings: of its results. Rows are sorted by the controllers in ``asked``, others last, then by seed.

    Raises:
        ValueError: for a file that cannot be read.
    """
    file, tables = directory / STEPS_FILE, [pd.DataFrame(columns=[*KEYS, "step"])]
    for each in (*directory.glob(STEPS_FILE), *(directory / PARTS).glob("[!.]*.csv")):
        with reading(each, "choose another directory"):
            text = each.read_text()
            tables.append(pd.read_csv(io.StringIO(text[: text.rfind("\n") + 1])))
    if not tables[1:]:
        return tables[0]
    with reading(file, "choose another directory"):
        records = pd.concat(tables[1:])
        check_records(records)
        records = _whole_episodes(records.drop_duplicates([*KEYS, "step"]), settings)
    asked = settings.get("asked", {})
    order = pd.DataFrame([(name, each) for name in asked for each in asked[name]], columns=KEYS[:2])
    order = pd.concat([order, records[KEYS[:2]]]).drop_duplicates()
    return order.merge(records.sort_values(["seed", "step"]))


def _whole_episodes(records: pd.DataFrame, settings: Mapping[str, Any]) -> pd.DataFrame:
    """Return the records of episodes that have all of their steps."""
    config = comparison_config(settings)
    lengths = {name: episode_steps(name, config) for name in records["scenario"].unique()}
    episodes = records.groupby(KEYS)
    count, last = episodes["step"].transform("size"), episodes["step"].transform("max")
    ended = count == records["scenario"].map(lengths)
    if config.get("terminate_on_collision"):
        ended |= episodes["collision"].transform("last").astype(bool)
    return records[ended & (count == last + 1)]


@dataclass(frozen=True)
class LiveEpisodes:
    """The episodes of a comparison in the environments; each is a part.

    Attributes:
        comparison: what is wanted.
        directory: of the results.
        settings: of the results, see `ms_highway.experiments.directory.ResultsDirectory`.
    """

    comparison: Comparison
    directory: Path
    settings: dict[str, Any]

    @cached_property
    def places(self) -> dict[EpisodeKey, int]:
        """Number of each wanted episode."""
        return {key: place for place, key in enumerate(self.comparison.episodes())}

    @property
    def episodes(self) -> int:
        """How many are wanted."""
        return len(self.places)

    def missing(self) -> dict[EpisodeKey, int]:
        """Return the episodes that are not there yet."""
        there = {*self.collect()[KEYS].itertuples(index=False, name=None)}
        return {key: 1 for key in self.places if key not in there}

    def write(self, key: EpisodeKey, records: pd.DataFrame) -> None:
        """Write an episode."""
        with replacing(self.directory / PARTS / f"{self.places[key]}.csv") as path:
            records.to_csv(path, index=False)

    def collect(self) -> pd.DataFrame:
        """Put all parts into ``steps.csv`` and return its records.

        Raises:
            ValueError: if they cannot be read, or have other columns.
        """
        records, columns = read_steps(self.directory, self.settings), self.comparison.columns()
        file, parts = self.directory / STEPS_FILE, self.directory / PARTS
        if len(records) and list(records) != columns:
            raise ValueError(f"{file}: its columns are not {', '.join(columns)}; choose another directory")
        if parts.exists():
            with replacing(file) as path:
                records.to_csv(path, index=False)
            shutil.rmtree(parts)
        return records

    def drive(self, key: EpisodeKey) -> pd.DataFrame:
        """Run one episode and return its records."""
        scenario, controller, seed = key
        config, seconds = dict(self.comparison.config), self.settings["measured"].get(scenario)
        if seconds and controller_config(controller)["type"] != "budget":  # which needs a high quantile, not medians
            config["costs"] = seconds
        env = _environment(scenario, controller, json.dumps(config))
        records = pd.DataFrame(episode(env, seed)).assign(scenario=scenario, controller=controller, seed=seed)
        return records.reindex(columns=self.comparison.columns())


@lru_cache(maxsize=1)
def _environment(scenario: str, controller: str, config: str) -> gym.Env:
    """Make an environment, or use that of the episode before again."""
    return make_environment(scenario, controller, **json.loads(config))


def _drive(
    episodes: LiveEpisodes, processes: int, modules: Sequence[str], keys: Sequence[EpisodeKey]
) -> Iterator[tuple[EpisodeKey, pd.DataFrame]]:
    """Run episodes in this process, or many in several, each on a core; yield each with its records.

    Every other process begins at the end, so that two rarely compile the same functions.
    """
    _environment.cache_clear()
    if processes == 1 or len(keys) < FEWEST:
        yield from ((key, episodes.drive(key)) for key in keys)
        return
    workers = [start_worker(episodes.drive, partial(low_latency_on_core, core), modules) for core in range(processes)]
    remaining, driven = deque(keys), dict[int, EpisodeKey]()

    def start(place: int) -> None:
        if remaining:
            driven[place] = remaining.pop() if place % 2 else remaining.popleft()
            workers[place].send(driven[place])

    for place in range(processes):
        start(place)
    while driven:
        ready = wait([workers[place] for place in driven])
        for place in [place for place in driven if workers[place] in ready]:
            key = driven.pop(place)
            try:
                records = workers[place].recv()
            except EOFError as error:
                lost = "the process that drove {}, {}, seed {} has ended".format(*key)
                raise OSError(f"{lost}; start the same comparison again, which resumes") from error
            if isinstance(records, Exception):
                raise records
            start(place)
            yield key, records


def make_environment(scenario: str, controller: str, render: bool = False, **config: Any) -> gym.Env:
    """Make the environment of a scenario with the robot driven by a controller.

    Args:
        scenario: its name.
        controller: short name of the controller, see `ms_highway.envs.registry.controller_config`.
        render: whether to render ``rgb_array`` frames.
        config: further configuration of the environment.

    Raises:
        ValueError: for an unknown scenario, controller or configuration.
    """
    whole = {**config, "controller": controller_config(controller)}
    return gym.make(environment_id(scenario), render_mode="rgb_array" if render else None, config=whole)


def measured_seconds(scenario: str, comparison: Comparison) -> dict[str, float]:
    """Measure T(M) of a scenario's ladder on this machine; return it by model [s]."""
    env = make_environment(scenario, "naive", **comparison.config).unwrapped
    assert isinstance(env, InteractionEnv)
    env.measure()
    return env.seconds


def episode(env: gym.Env, seed: int) -> Iterator[dict[str, Any]]:
    """Run one episode with the robot's own controller; yield a record per step, with the `columns` from ``step`` on."""
    env.reset(seed=seed)
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    rungs = [model.name for model in inner.settings.models]
    wanted = columns(rungs, rungs[1:] if inner.scenario.streams else None)
    for step in count():
        _, reward, terminated, truncated, info = env.step(0)
        values = {**info, **asdict(info["timing"])}
        record = {key: values[key] for key in wanted if key in values} | {"step": step, "reward": reward}
        record |= {gain_column(name): gain for name, gain in info["gains"].items()}
        for car, state in zip(CARS, inner.car_states, strict=False):
            record |= dict(zip(state_columns(car), state, strict=True))
        yield record
        if terminated or truncated:
            return
