"""Run episodes in the environments and keep their records, so that an interrupted run can be resumed."""

import csv
import io
from collections.abc import Iterator
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd

from ms_highway.envs import ENVIRONMENTS, CrowdEnv, environment_id
from ms_highway.envs.base import InteractionEnv
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import CARS, KEYS, check_columns, columns, gain_column, state_columns, whole_steps
from ms_highway.experiments.resuming import cannot_resume, missing, resumed_settings
from ms_highway.experiments.settings import EXTENDED, SETTINGS_FILE, write_settings
from ms_highway.runtime.files import append, replacing

__all__ = ["STEPS_FILE", "episode", "make_environment", "read", "run"]

STEPS_FILE = "steps.csv"


def make_environment(scenario: str, controller: str, render: bool = False, **config: Any) -> gym.Env:
    """Make the environment of a scenario with the robot driven by a controller.

    Args:
        scenario: its name.
        controller: short name of the controller, see `InteractionEnv.controller_config`.
        render: whether to render ``rgb_array`` frames.
        config: further configuration of the environment.

    Raises:
        ValueError: for an unknown scenario, controller or configuration.
    """
    identity = environment_id(scenario)
    driver = ENVIRONMENTS[scenario].controller_config(controller)
    return gym.make(identity, render_mode="rgb_array" if render else None, config={**config, "controller": driver})


def episode(env: gym.Env, seed: int) -> Iterator[dict[str, Any]]:
    """Run one episode with the robot's own controller; yield a record per step, with the `columns` from ``step`` on."""
    env.reset(seed=seed)
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    wanted = columns((model.name for model in inner.models), isinstance(inner, CrowdEnv))
    done, step = False, 0
    while not done:
        _, reward, terminated, truncated, info = env.step(0)
        done = terminated or truncated
        values = {**info, **asdict(info["timing"])}
        record = {key: values[key] for key in wanted if key in values} | {"step": step, "reward": reward}
        record |= {gain_column(name): gain for name, gain in info["gains"].items()}
        for car, state in zip(CARS, inner.car_states, strict=False):
            record |= dict(zip(state_columns(car), state, strict=True))
        yield record
        step += 1


def run(comparison: Comparison, directory: str | Path) -> Iterator[int]:
    """Run the episodes that ``directory`` lacks and write each to its ``steps.csv`` when it ends.

    Yields:
        The number of episodes there: first of those that earlier runs have left, then after every episode.

    Raises:
        ValueError: if the directory holds results of other settings, or records that cannot be read.
    """
    directory = Path(directory)
    done, costs = _take_up(comparison, directory)
    wanted = list(comparison.episodes())
    lacking = missing(wanted, done)
    count = len(wanted) - len(lacking)
    yield count
    for (scenario, controller), keys in groupby(lacking, key=lambda key: key[:2]):
        config = ENVIRONMENTS[scenario].controller_config(controller)
        own = comparison.costs == "measured" and config["type"] == "budget"  # which needs a high quantile, not medians
        seconds = "measured" if own else costs[scenario]
        env = make_environment(scenario, controller, costs=seconds, **comparison.common_config())
        for _, _, seed in keys:
            text = io.StringIO()
            writer = csv.DictWriter(text, comparison.columns(), lineterminator="\n")
            for record in episode(env, seed):
                writer.writerow({"scenario": scenario, "controller": controller, "seed": seed, **record})
            append(directory / STEPS_FILE, text.getvalue())
            count += 1
            yield count
        env.close()


def _take_up(comparison: Comparison, directory: Path) -> tuple[set[tuple[str, str, int]], dict[str, Any]]:
    """Prepare the directory, and keep the settings and the number of episodes that are asked for.

    Returns:
        The episodes that it holds whole (an unfinished one at the end is removed), and T(M) by scenario; measured times
        are measured once, kept with the results, and used again when the run is resumed.
    """
    steps = directory / STEPS_FILE
    known: dict[str, Any] = {**comparison.common_config(), "costs": comparison.costs}
    if steps.exists() or (directory / SETTINGS_FILE).exists():
        known = resumed_settings(directory, known)
    known |= {key: known.get(key, {}) for key in EXTENDED}
    done = _whole_episodes(steps, comparison) if steps.exists() else set()
    if comparison.costs == "measured":
        for scenario in comparison.controllers.keys() - known["measured"].keys():
            known["measured"][scenario] = _measured(scenario, comparison.common_config())
    for scenario, controllers in comparison.controllers.items():
        asked = known["asked"].setdefault(scenario, {})
        asked.update({name: max(comparison.seeds, asked.get(name, 0)) for name in controllers})
    write_settings(directory, known)
    if not steps.exists():
        with replacing(steps) as path:
            path.write_text(",".join(comparison.columns()) + "\n")
    return done, {scenario: known["measured"].get(scenario, comparison.costs) for scenario in comparison.controllers}


def _measured(scenario: str, config: dict[str, Any]) -> dict[str, float]:
    """Measure the seconds of a warm plan on this machine, for every model on the scenario's ladder."""
    env = make_environment(scenario, "naive", costs="measured", **config).unwrapped
    assert isinstance(env, InteractionEnv)
    seconds = env.costs(env.car_states)
    return {model.name: float(cost) for model, cost in zip(env.models, seconds, strict=True)}


def _whole_episodes(steps: Path, comparison: Comparison) -> set[tuple[str, str, int]]:
    """Return the episodes that a file of records holds whole; remove anything else, which a stopped run has left.

    Raises:
        ValueError: if the file does not hold records of this version.
    """
    text = steps.read_text()
    whole_lines = text[: text.rfind("\n") + 1]
    try:
        records = pd.read_csv(io.StringIO(whole_lines))
        wanted = comparison.columns()
        if list(records) != wanted:
            raise ValueError(f"its columns are not {', '.join(wanted)}")
        check_columns(records)
        unknown = set(records["scenario"]) - set(ENVIRONMENTS)
        if unknown:
            raise ValueError(f"it holds unknown scenarios, {', '.join(map(str, unknown))}")
    except ValueError as error:
        remedy = "choose another directory, or --import the modules that its scenarios and models are from"
        raise cannot_resume(steps, error, remedy) from error
    lengths = {name: comparison.steps(name) for name in records["scenario"].unique()}
    sizes = whole_steps(records)
    done = {key for key, length in sizes.items() if length == lengths[key[0]]}
    whole = [tuple(key) in done for key in records[KEYS].itertuples(index=False)]
    if whole_lines != text or not all(whole):
        lines = whole_lines.splitlines(keepends=True)
        with replacing(steps) as path:
            path.write_text(lines[0] + "".join(line for line, keep in zip(lines[1:], whole, strict=True) if keep))
    return done


def read(comparison: Comparison, directory: str | Path) -> pd.DataFrame:
    """Return the records of a comparison that `run` has finished in a directory, in the comparison's order."""
    records = pd.read_csv(Path(directory) / STEPS_FILE)
    places = {key: place for place, key in enumerate(comparison.episodes())}
    order = [places.get(key, -1) for key in records[KEYS].itertuples(index=False, name=None)]
    chosen = records.assign(order=order).query("order >= 0").sort_values(["order", "step"])
    return chosen.drop(columns="order").reset_index(drop=True)
