"""Episodes in the environments, one tidy record per step, kept in files that an interrupted run goes on with."""

import csv
import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd

from ms_highway.compiled import measure_costs
from ms_highway.envs import ENVIRONMENTS, SCENARIOS, environment_id
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.configuration import HUMAN_REWARDS, controller_config, merged
from ms_highway.files import PART, append, read_json, replacing
from ms_highway.human_models import MODELS
from ms_highway.planner import Solver

__all__ = [
    "GROWING",
    "MAY_LACK",
    "NEEDED",
    "SETTINGS_FILE",
    "STEPS_FILE",
    "Comparison",
    "check_numbers",
    "check_settings",
    "columns",
    "episode",
    "episode_steps",
    "make_environment",
    "paper_controllers",
    "read",
    "read_settings",
    "run",
]

STEPS_FILE, SETTINGS_FILE = "steps.csv", "settings.json"
GROWING = ("measured", "asked")  # of the settings, what comparisons in the same directory add to
KEYS = ["scenario", "controller", "seed"]
TEXTS, NUMBERS = (
    ("scenario", "controller", "model", "status"),
    ("seed", "step", "reward", "planning_seconds", "decision_seconds"),
)
NEEDED = {*TEXTS, *NUMBERS, "collision"}  # of the columns, those that are never empty
MAY_LACK = "counted_seconds"  # numbers, where they are


def columns() -> list[str]:
    """Columns of a record of steps.

    ``counted_seconds`` is T(M), what decisions count for the step's plan; a gain, of which every known human model has
    one, is empty where none was estimated; states are in SI units after the step.
    """
    return [
        *KEYS,
        "step",
        "model",
        "reward",
        "collision",
        "planning_seconds",
        "counted_seconds",
        "decision_seconds",
        "compile_seconds",
        "status",
        *(f"gain_{name}" for name in MODELS),
        *(f"{car}_{number}" for car in ("robot", "human") for number in ("x", "y", "heading", "speed")),
    ]


def check_numbers(records: pd.DataFrame) -> None:
    """Look for texts in the columns of numbers that results are made from.

    Raises:
        ValueError: naming the column.
    """
    for name in (*NUMBERS, MAY_LACK, *(column for column in records if column.startswith("gain_"))):
        if not pd.api.types.is_numeric_dtype(records[name]):
            raise ValueError(f"has texts where numbers belong, in column {name}")


@dataclass(frozen=True)
class Comparison:
    """What is compared.

    Attributes:
        controllers: short names of the controllers of each scenario, by scenario.
        seeds: number of episodes of each controller; episode k is seeded with k more than the first.
        semantics: ``paper`` or ``released``.
        costs: T(M) in the decisions: ``published``, ``measured``, or seconds by model.
        solver: how the robot improves its plans, ``gradient`` or ``newton``, see `ms_highway.planner.climb`.
        human_reward: what humans drive for: ``learned``, ``published``, weights by name, or None for what belongs to
            the semantics.
        ladder: names of the human models that switching chooses from; without it, the scenario's own.
        first_seed: of the first episode, from which all others count on.
        planning: what differs from the scenarios' own of the keys `ms_highway.envs.configuration.PLANNING`, by key.
    """

    controllers: dict[str, list[str]]
    seeds: int = 30
    semantics: str = "paper"
    costs: Any = "published"
    solver: Solver = "gradient"
    human_reward: str | dict[str, float] | None = None
    ladder: list[str] | None = None
    first_seed: int = 0
    planning: Mapping[str, Any] = field(default_factory=dict)

    def episodes(self) -> Iterator[tuple[str, str, int]]:
        """Every (scenario, controller, seed)."""
        for scenario, controllers in self.controllers.items():
            for controller in controllers:
                for seed in range(self.first_seed, self.first_seed + self.seeds):
                    yield scenario, controller, seed

    def check(self) -> None:
        """Look for mistakes before anything is run or written.

        Raises:
            ValueError: for an unknown scenario, controller or solver, or impossible costs or weights.
        """
        for scenario, controllers in self.controllers.items():
            for controller in controllers:
                self.config(scenario, controller)

    def config(self, scenario: str, controller: str) -> dict[str, Any]:
        """The whole configuration of the environment of a scenario and a controller.

        Raises:
            ValueError: as `check`.
        """
        environment_id(scenario)
        changes = {**self.common_config(), "costs": self.costs, "controller": controller_config(controller)}
        return merged(ENVIRONMENTS[scenario].default_config(), changes)

    def steps(self, scenario: str) -> int:
        """The length of a scenario's episodes.

        Raises:
            ValueError: as `check`.
        """
        return episode_steps(scenario, self.common_config())

    def common_config(self) -> dict[str, Any]:
        """The configuration that all environments have in common."""
        reward = HUMAN_REWARDS[self.semantics] if self.human_reward is None else self.human_reward
        config = {"semantics": self.semantics, "solver": self.solver, "human_reward": reward}
        return {**config, **self.planning} | ({} if self.ladder is None else {"ladder": list(self.ladder)})


def episode_steps(scenario: str, config: Mapping[str, Any]) -> int:
    """The number of steps in an episode of a scenario that nothing ends early.

    Raises:
        ValueError: for an unknown scenario or an impossible configuration.
    """
    environment_id(scenario)
    whole = merged(ENVIRONMENTS[scenario].default_config(), config)
    return round(whole["duration"] * whole["policy_frequency"])


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
    _refuse_others(directory, {key: value for key, value in known.items() if key not in GROWING}, settings)
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


def read_settings(file: Path) -> dict[str, Any]:
    """What a directory's results were run with.

    Raises:
        ValueError: if the file cannot be read.
    """
    try:
        return dict(read_json(file))
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{file} cannot be read ({error}); choose another directory") from error


def check_settings(directory: Path, settings: Mapping[str, Any]) -> None:
    """Look whether results with these settings can begin or go on in a directory.

    Raises:
        ValueError: if it is none, or holds results of other settings, or other things.
    """
    if directory.exists() and not directory.is_dir():
        raise ValueError(f"--out is {directory}, which is a file; name a directory, there already or not")
    if (directory / SETTINGS_FILE).exists():
        _refuse_others(directory, read_settings(directory / SETTINGS_FILE), json.loads(json.dumps(settings)))
    elif directory.exists() and any(not file.name.startswith(PART) for file in directory.iterdir()):
        raise ValueError(f"{directory} is not empty, and has no {SETTINGS_FILE}; choose another directory with --out")


def _refuse_others(directory: Path, known: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Refuse a directory whose results have settings other than those that are wanted."""
    differing = [key for key in {**known, **settings} if known.get(key) != settings.get(key)]
    if differing:
        told = ", ".join(f"{key} {known.get(key)!r} instead of {settings.get(key)!r}" for key in differing)
        raise ValueError(f"{directory} holds results with {told}; choose another directory with --out")


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
