"""Episodes in the environments, one tidy record per step, kept in files that an interrupted run goes on with."""

import csv
import io
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd

from ms_highway.envs import SCENARIOS, environment_id
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.configuration import controller_config

__all__ = [
    "COLUMNS",
    "Comparison",
    "episode",
    "make_environment",
    "paper_controllers",
    "read",
    "run",
    "write_atomically",
]

STEPS_FILE, SETTINGS_FILE = "steps.csv", "settings.json"
KEYS = ["scenario", "controller", "seed"]
COLUMNS = [
    *KEYS,
    "step",
    "model",
    "reward",
    "collision",
    "planning_seconds",
    "decision_seconds",
    "compile_seconds",
    "status",
    "gain_naive",
    "gain_turn",
    "gain_tom",
    *(f"{car}_{number}" for car in ("robot", "human") for number in ("x", "y", "heading", "speed")),
]
"""Columns of a record of steps: states in SI units after the step, gains empty where none was estimated."""


@dataclass(frozen=True)
class Comparison:
    """What is compared.

    Attributes:
        controllers: short names of the controllers of each scenario, by scenario.
        seeds: number of episodes of each controller; episode k is seeded with k.
        semantics: ``paper`` or ``released``.
        costs: T(M) in the decisions: ``published``, ``measured``, or seconds by model.
    """

    controllers: dict[str, list[str]]
    seeds: int = 30
    semantics: str = "paper"
    costs: Any = "published"

    def episodes(self) -> Iterator[tuple[str, str, int]]:
        """Every (scenario, controller, seed)."""
        for scenario, controllers in self.controllers.items():
            for controller in controllers:
                for seed in range(self.seeds):
                    yield scenario, controller, seed

    def check(self) -> None:
        """Make every environment once, so that a mistake shows before anything is run or written.

        Raises:
            ValueError: for an unknown scenario or controller, or impossible costs.
        """
        for scenario, controllers in self.controllers.items():
            for controller in controllers:
                make_environment(scenario, controller, semantics=self.semantics, costs=self.costs).close()


def paper_controllers(scenario: str) -> list[str]:
    """The controllers that the paper compares in a scenario: every rung, then switching, aggressive and conservative.

    Raises:
        ValueError: for an unknown scenario.
    """
    environment_id(scenario)
    choice = SCENARIOS[scenario]
    return [*choice.ladder, *(f"switching:{price:g}" for price in choice.prices)]


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
    """Run one episode with the robot's own controller; yields a record per step, the columns from ``step`` on."""
    env.reset(seed=seed)
    inner = env.unwrapped
    assert isinstance(inner, InteractionEnv)
    done, step = False, 0
    while not done:
        _, reward, terminated, truncated, info = env.step(0)
        done = terminated or truncated
        record = {key: info[key] for key in COLUMNS if key in info} | {"step": step, "reward": reward}
        record |= {f"gain_{name}": gain for name, gain in info["gains"].items()}
        for car, state in zip(("robot", "human"), inner.car_states, strict=False):
            record |= {
                f"{car}_{name}": value for name, value in zip(("x", "y", "heading", "speed"), state, strict=True)
            }
        yield record
        step += 1


def run(comparison: Comparison, directory: Path) -> Iterator[int]:
    """Run the episodes that ``directory`` lacks and write each to its ``steps.csv`` when it ends.

    Yields how many episodes are there: first what an earlier run has left, then after every episode.

    Raises:
        ValueError: if the directory holds results of other settings, or records that cannot be read.
    """
    steps = directory / STEPS_FILE
    done = _take_up(comparison, directory)
    wanted = list(comparison.episodes())
    yield sum(key in done for key in wanted)
    config = {"semantics": comparison.semantics, "costs": comparison.costs}
    env, current = None, None
    with steps.open("a", newline="") as file:
        count = sum(key in done for key in wanted)
        for scenario, controller, seed in wanted:
            if (scenario, controller, seed) in done:
                continue
            if current != (scenario, controller):
                env, current = make_environment(scenario, controller, **config), (scenario, controller)
            assert env is not None
            text = io.StringIO()
            writer = csv.DictWriter(text, COLUMNS)
            for record in episode(env, seed):
                writer.writerow({"scenario": scenario, "controller": controller, "seed": seed, **record})
            file.write(text.getvalue())
            file.flush()
            os.fsync(file.fileno())
            count += 1
            yield count


def _take_up(comparison: Comparison, directory: Path) -> set[tuple[str, str, int]]:
    """Prepare the directory; the episodes that it holds whole. Half an episode at the end is dropped."""
    settings = {key: value for key, value in asdict(comparison).items() if key in ("semantics", "costs")}
    directory.mkdir(parents=True, exist_ok=True)
    steps, settings_file = directory / STEPS_FILE, directory / SETTINGS_FILE
    if not steps.exists():
        write_atomically(settings_file, json.dumps(settings, indent=2) + "\n")
        write_atomically(steps, ",".join(COLUMNS) + "\n")
        return set()
    known = json.loads(settings_file.read_text()) if settings_file.exists() else None
    if known != settings:
        raise ValueError(f"{directory} holds results of {known}, not of {settings}; choose another directory")
    text = steps.read_text()
    whole_lines = text[: text.rfind("\n") + 1]
    try:
        records = pd.read_csv(io.StringIO(whole_lines))
        lengths = records.groupby(KEYS).size()
    except (ValueError, KeyError) as error:
        raise ValueError(f"{steps} cannot be read ({error}); move it away or choose another directory") from error
    done = {key for key, length in lengths.items() if length == SCENARIOS[key[0]].steps}
    whole = [tuple(key) in done for key in records[KEYS].itertuples(index=False)]
    if whole_lines != text or not all(whole):
        lines = whole_lines.splitlines(keepends=True)
        write_atomically(steps, lines[0] + "".join(line for line, keep in zip(lines[1:], whole, strict=True) if keep))
    return done


def read(comparison: Comparison, directory: Path) -> pd.DataFrame:
    """The records of a comparison that `run` has finished in a directory, in the comparison's order."""
    records = pd.read_csv(directory / STEPS_FILE).set_index(KEYS)
    return pd.concat([records.loc[[key]] for key in comparison.episodes()]).reset_index()


def write_atomically(path: Path, content: str) -> None:
    """Write a text file under a temporary name and move it into place."""
    temporary = path.with_name(f".{path.name}.part")
    temporary.write_text(content)
    temporary.replace(path)
