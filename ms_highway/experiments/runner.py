"""Run episodes in the environments and keep their records, so that an interrupted run can be resumed."""

import csv
import io
from collections.abc import Iterator
from dataclasses import asdict
from itertools import count, groupby
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

from ms_highway.envs import environment_id
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.registry import controller_config
from ms_highway.experiments.comparison import Comparison, episode_steps
from ms_highway.experiments.directory import EXTENDED, ResultsDirectory
from ms_highway.experiments.records import CARS, KEYS, check_records, columns, gain_column, state_columns, whole_steps
from ms_highway.runtime.files import append, reading, replacing

STEPS_FILE = "steps.csv"


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


def episode(env: gym.Env, seed: int) -> Iterator[dict[str, Any]]:
    """Run one episode with the robot's own controller; yield a record per step, with the `columns` from ``step`` on."""
    env.reset(seed=seed)
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    rungs = [model.name for model in inner.settings.models]
    wanted = columns(rungs, rungs[1:] if inner.scenario.streams else ())
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


def run(comparison: Comparison, directory: str | Path) -> Iterator[int]:
    """Run the episodes that ``directory`` lacks and write each to its ``steps.csv`` when it ends.

    Yields:
        The number of episodes there: first of those that earlier runs have left, then after every episode.

    Raises:
        ValueError: if the directory holds results of other settings, or records that cannot be read.
    """
    results = ResultsDirectory(Path(directory))
    steps, wanted = results.path / STEPS_FILE, list(comparison.episodes())
    settings = results.take_up(comparison.common_config())
    done = _whole_episodes(steps, comparison) if steps.exists() else set()
    _extend(settings, comparison)
    results.write_settings(settings)
    if not steps.exists():
        with replacing(steps) as path:
            path.write_text(",".join(comparison.columns()) + "\n")
    lacking = [key for key in dict.fromkeys(wanted) if key not in done]
    number = len(wanted) - len(lacking)
    yield number
    for (scenario, controller), keys in groupby(lacking, key=lambda key: key[:2]):
        config = comparison.environment_config(scenario, controller)
        own = config["controller"]["type"] == "budget"  # which needs a high quantile of measured times, not medians
        costs = config["costs"] if own else settings["measured"].get(scenario, config["costs"])
        env = make_environment(scenario, controller, **{**comparison.config, "costs": costs})
        for _, _, seed in keys:
            text = io.StringIO()
            writer = csv.DictWriter(text, comparison.columns(), lineterminator="\n")
            for record in episode(env, seed):
                writer.writerow({"scenario": scenario, "controller": controller, "seed": seed, **record})
            append(steps, text.getvalue())
            number += 1
            yield number
        env.close()


def _extend(settings: dict[str, Any], comparison: Comparison) -> None:
    """Add the numbers of episodes that are asked for, and T(M) by scenario, which is measured once and kept."""
    settings |= {key: settings.get(key, {}) for key in EXTENDED}
    for scenario, controllers in comparison.controllers.items():
        asked = settings["asked"].setdefault(scenario, {})
        asked.update({name: max(comparison.seeds, asked.get(name, 0)) for name in controllers})
        measured = comparison.environment_config(scenario, "naive")["costs"] == "measured"
        if measured and scenario not in settings["measured"]:
            env = make_environment(scenario, "naive", **comparison.config).unwrapped
            assert isinstance(env, InteractionEnv)
            costs = env.costs(env.car_states)
            seconds = (costs.base + np.asarray(costs.each)).tolist()
            settings["measured"][scenario] = dict(
                zip([model.name for model in env.settings.models], seconds, strict=True)
            )


def _whole_episodes(steps: Path, comparison: Comparison) -> set[tuple[str, str, int]]:
    """Return the episodes that a file of records holds whole; remove anything else, which a stopped run has left.

    Raises:
        ValueError: if the file does not hold records of this version.
    """
    with reading(steps, "choose another directory"):
        text = steps.read_text()
        whole_lines = text[: text.rfind("\n") + 1]
        records = pd.read_csv(io.StringIO(whole_lines))
        if list(records) != comparison.columns():
            raise ValueError(f"its columns are not {', '.join(comparison.columns())}")
        check_records(records)
    lengths = {name: episode_steps(name, comparison.config) for name in records["scenario"].unique()}
    done = {key for key, length in whole_steps(records).items() if length == lengths[key[0]]}
    whole = [key in done for key in records[KEYS].itertuples(index=False, name=None)]
    if whole_lines != text or not all(whole):
        head, *lines = whole_lines.splitlines(keepends=True)
        with replacing(steps) as path:
            path.write_text(head + "".join(line for line, keep in zip(lines, whole, strict=True) if keep))
    return done


def read(comparison: Comparison, directory: str | Path) -> pd.DataFrame:
    """Return the records of a comparison that `run` has finished in a directory, in the comparison's order."""
    return pd.DataFrame(comparison.episodes(), columns=KEYS).merge(pd.read_csv(Path(directory) / STEPS_FILE))
