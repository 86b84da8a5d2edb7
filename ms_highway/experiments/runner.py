"""Run episodes in the environments and keep their records in files that an interrupted run goes on with."""

import csv
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd

from ms_highway.envs import SCENARIOS, environment_id
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.drivers import controller_config
from ms_highway.experiments.comparison import Comparison, episode_steps
from ms_highway.experiments.records import KEYS, NEEDED, check_numbers, columns
from ms_highway.experiments.settings import GROWING, SETTINGS_FILE, read_settings, refuse_others
from ms_highway.planning.compiled import measure_costs
from ms_highway.runtime.files import append, replacing

__all__ = ["STEPS_FILE", "episode", "make_environment", "read", "run"]

STEPS_FILE = "steps.csv"


def make_environment(scenario: str, controller: str, render: bool = False, **config: Any) -> gym.Env:
    """The environment of a scenario with the robot driven by a controller.

    Args:
        scenario: its name.
        controller: short name of the controller, see `controller_config`.
        render: whether ``rgb_array`` frames will be asked for.
        config: further configuration of the environment.

    Raises:
        ValueError: for an unknown scenario, controller or configuration.
    """
    identity, driver = environment_id(scenario), controller_config(controller)
    return gym.make(identity, render_mode="rgb_array" if render else None, config={**config, "controller": driver})


def episode(env: gym.Env, seed: int) -> Iterator[dict[str, Any]]:
    """Run one episode with the robot's own controller; yields a record per step, `columns` from ``step`` on."""
    env.reset(seed=seed)
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    done, step, wanted = False, 0, columns()
    while not done:
        _, reward, terminated, truncated, info = env.step(0)
        done = terminated or truncated
        told = {**info, **asdict(info["timing"])}
        record = {key: told[key] for key in wanted if key in told} | {"step": step, "reward": reward}
        record |= {f"gain_{name}": gain for name, gain in info["gains"].items()}
        for car, state in zip(("robot", "human"), inner.car_states, strict=False):
            record |= {
                f"{car}_{name}": value for name, value in zip(("x", "y", "heading", "speed"), state, strict=True)
            }
        yield record
        step += 1


def run(comparison: Comparison, directory: str | Path) -> Iterator[int]:
    """Run the episodes that ``directory`` lacks and write each to its ``steps.csv`` when it ends.

    Yields how many episodes are there: first what an earlier run has left, then after every episode.

    Raises:
        ValueError: if the directory holds results of other settings, or records that cannot be read.
    """
    directory = Path(directory)
    done, costs = _take_up(comparison, directory)
    wanted = list(comparison.episodes())
    count = sum(key in done for key in wanted)
    yield count
    for (scenario, controller), group in groupby(wanted, key=lambda key: key[:2]):
        missing = [seed for _, _, seed in group if (scenario, controller, seed) not in done]
        if not missing:
            continue
        env = make_environment(scenario, controller, costs=costs[scenario], **comparison.common_config())
        for seed in missing:
            text = io.StringIO()
            writer = csv.DictWriter(text, columns(), lineterminator="\n")
            for record in episode(env, seed):
                writer.writerow({"scenario": scenario, "controller": controller, "seed": seed, **record})
            append(directory / STEPS_FILE, text.getvalue())
            count += 1
            yield count
        env.close()


def _take_up(comparison: Comparison, directory: Path) -> tuple[set[tuple[str, str, int]], dict[str, Any]]:
    """Prepare the directory.

    Returns:
        The episodes that it holds whole (half an episode at the end is dropped), and T(M) by scenario; measured times
        are measured once, kept with the results, and used again when the run goes on. How many episodes were asked for
        is kept as well.
    """
    steps, settings_file = directory / STEPS_FILE, directory / SETTINGS_FILE
    settings = {**comparison.common_config(), "costs": comparison.costs}
    known = read_settings(settings_file) if settings_file.exists() or steps.exists() else settings
    known = {**known, **{key: known.get(key, {}) for key in GROWING}}
    refuse_others(directory, {key: value for key, value in known.items() if key not in GROWING}, settings)
    done = _whole_episodes(steps, comparison.common_config()) if steps.exists() else set()
    if comparison.costs == "measured":
        for scenario in comparison.controllers.keys() - known["measured"].keys():
            known["measured"][scenario] = _measured(scenario, comparison.common_config())
    for scenario, controllers in comparison.controllers.items():
        asked = known["asked"].setdefault(scenario, {})
        asked.update({name: max(comparison.seeds, asked.get(name, 0)) for name in controllers})
    with replacing(settings_file) as path:
        path.write_text(json.dumps(known, indent=2) + "\n")
    if not steps.exists():
        with replacing(steps) as path:
            path.write_text(",".join(columns()) + "\n")
    return done, {scenario: known["measured"].get(scenario, comparison.costs) for scenario in comparison.controllers}


def _measured(scenario: str, config: dict[str, Any]) -> dict[str, float]:
    """Seconds of a warm plan on this machine, for every model on the scenario's ladder."""
    env = make_environment(scenario, "naive", **config).unwrapped
    assert isinstance(env, InteractionEnv)
    seconds = measure_costs(env.game, env.models, env.car_states)
    return {model.name: float(cost) for model, cost in zip(env.models, seconds, strict=True)}


def _whole_episodes(steps: Path, config: Mapping[str, Any]) -> set[tuple[str, str, int]]:
    """The episodes that a file of records holds whole; anything after them, from a run that was stopped, is removed.

    Raises:
        ValueError: if the file does not hold records of this version.
    """
    text = steps.read_text()
    whole_lines = text[: text.rfind("\n") + 1]
    try:
        records = pd.read_csv(io.StringIO(whole_lines))
        if list(records) != columns():
            raise ValueError(f"its columns are not {', '.join(columns())}")
        check_numbers(records)
        unknown = set(records["scenario"]) - set(SCENARIOS)
        if unknown:
            raise ValueError(f"it holds unknown scenarios, {', '.join(map(str, unknown))}")
    except ValueError as error:
        remedy = "choose another directory, or --import the modules that its scenarios and models are from"
        raise ValueError(f"{steps} cannot be gone on with ({error}); {remedy}") from error
    lengths = {name: episode_steps(name, config) for name in records["scenario"].unique()}
    sizes = records.dropna(subset=list(NEEDED)).groupby(KEYS).size()
    done = {key for key, length in sizes.items() if length == lengths[key[0]]}
    whole = [tuple(key) in done for key in records[KEYS].itertuples(index=False)]
    if whole_lines != text or not all(whole):
        lines = whole_lines.splitlines(keepends=True)
        with replacing(steps) as path:
            path.write_text(lines[0] + "".join(line for line, keep in zip(lines[1:], whole, strict=True) if keep))
    return done


def read(comparison: Comparison, directory: str | Path) -> pd.DataFrame:
    """The records of a comparison that `run` has finished in a directory, in the comparison's order."""
    records = pd.read_csv(Path(directory) / STEPS_FILE)
    places = {key: place for place, key in enumerate(comparison.episodes())}
    order = [places.get(key, -1) for key in records[KEYS].itertuples(index=False, name=None)]
    chosen = records.assign(order=order).query("order >= 0").sort_values(["order", "step"])
    return chosen.drop(columns="order").reset_index(drop=True)
