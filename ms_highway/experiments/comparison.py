"""Define comparisons and their records of steps; check and summarise records."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import ClassVar, TypeAlias

import numpy as np
import pandas as pd
from jaxtyping import Float

from ms_highway.envs import ENVIRONMENTS, scenario_name
from ms_highway.envs.registry import controller_settings, robot_config
from ms_highway.envs.settings import HUMAN_REWARDS
from ms_highway.planning.ladders import known_models, rung_names
from ms_highway.runtime.definitions import definition_sources
from ms_highway.runtime.sources import Sources, digest, imported_sources

EpisodeKey: TypeAlias = tuple[str, str, int]
"""An episode: its scenario, the short name of its controller, and its seed."""

KEYS = ["scenario", "controller", "seed"]
"""Columns that identify the episode of a step."""

MEASURED = ("planning_seconds", "decision_seconds", "compile_seconds")
"""Columns of measured times, which simulations do not have."""

REQUIRED = [*KEYS, "step", "model", "status", "reward", "collision", *MEASURED[:2]]
"""Columns that records of live steps must have, without empty cells."""

STATES = [
    f"{car}_{name}"
    for car in ("robot", "human")
    for name in ("x", "y", "heading", "speed")
]
"""Columns of the states of the first two cars."""


@dataclass(frozen=True)
class Comparison:
    """What is compared, in scenarios with one human or several.

    Attributes:
        controllers: short names of the controllers of each scenario, by its name or id.
        seeds: number of episodes of each controller.
        first_seed: seed of the first episode; the others have the following seeds.
        config: values that differ from the environments' default configuration, by key.
    """

    always_recorded: ClassVar[tuple[str, ...]] = (
        "semantics",
        "solver",
        "human_reward",
        "costs",
    )
    """Keys that results record unless the scenarios have different defaults."""

    controllers: Mapping[str, Sequence[str]]
    seeds: int = 30
    first_seed: int = 0
    config: Mapping = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check everything before an episode is run or a file written.

        Raises:
            ValueError: for an unknown scenario or controller, an impossible
                configuration, or a controller that does not fit it.
        """
        named = {
            scenario_name(scenario): controllers
            for scenario, controllers in self.controllers.items()
        }
        object.__setattr__(self, "controllers", named)
        for scenario, controllers in named.items():
            for controller in controllers:
                self.environment_config(scenario, controller)

    @property
    def seed_range(self) -> range:
        """The seeds of each controller's episodes."""
        return range(self.first_seed, self.first_seed + self.seeds)

    def episodes(self) -> Iterator[EpisodeKey]:
        """Yield every (scenario, controller, seed)."""
        for scenario, controllers in self.controllers.items():
            yield from product([scenario], controllers, self.seed_range)

    def environment_config(self, scenario: str, controller: str) -> dict:
        """Return the whole configuration of a scenario's environment.

        Raises:
            ValueError: for the same reasons as `Comparison`.
        """
        environment = ENVIRONMENTS[scenario_name(scenario)]
        return environment.checked_config({**self.config, **robot_config(controller)})

    def common_config(self) -> dict:
        """Return the common configuration, under which results are resumed.

        It has the keys `always_recorded` and all keys of ``config``.
        """
        configs = []
        for name in self.controllers:
            config = {**ENVIRONMENTS[name].default_config(), **self.config}
            if not config["human_reward"]:
                config["human_reward"] = HUMAN_REWARDS[config["semantics"]]
            configs.append(config)

        # Leave out what differs among the scenarios.
        common = {}
        for key in self.always_recorded:
            first = configs[0][key]
            if all(config[key] == first for config in configs):
                common[key] = first
        common |= self.config
        if "ladder" in self.config:
            common["ladder"] = rung_names(self.config["ladder"])
        return common

    def sources(self) -> dict[str, dict[str, Sources]]:
        """Return digests of what the user named and imported.

        They are by scenario and controller. Each controller depends on all imported
        modules, as scenarios, drivers and features may come from them; on what was
        added by names that its configuration or the scenario has; and on its own files.
        """
        sources: dict[str, dict[str, Sources]] = {}
        config = json.dumps(self.config, default=str)
        for name, controllers in self.controllers.items():
            scenario = ENVIRONMENTS[name].scenario
            features = [*scenario.robot_weights, *scenario.human_weights]
            for controller in controllers:
                # All names that may stand for something of the user's.
                names = [name, controller, *scenario.ladder, *features, config]
                definitions = definition_sources(" ".join(names))
                files = controller_settings(controller).files()
                digests = {file: digest(Path(file)) for file in files}
                own = imported_sources() | definitions | digests
                sources.setdefault(name, {})[controller] = own
        return sources

    def columns(self) -> list[str]:
        """Return the columns of a record of steps.

        ``counted_seconds`` is T of the step's plan, as decisions count it.
        ``gain_MODEL``, for every known human model and every rung, is the highest gain
        over the first rung, before the price of its time, that was estimated for a
        human, and empty if none was. States are those of the robot and the first human
        after the step, in SI units. With several humans, ``model`` is the most
        expensive model in use, ``humans_MODEL`` the number of humans that each rung
        above the first predicts, and ``success`` whether the robot has succeeded so
        far.
        """
        steps = [
            *("step", "model", "reward", "collision"),
            *("planning_seconds", "counted_seconds"),
            *("decision_seconds", "compile_seconds"),
            "status",
        ]
        rungs: list[str] = []
        counts: list[str] = []
        scenarios = [ENVIRONMENTS[name].scenario for name in self.controllers]
        for scenario in scenarios:
            ladder = rung_names(self.config.get("ladder", scenario.ladder))
            rungs.extend(ladder)
            if scenario.streams:
                counts.extend(f"humans_{name}" for name in ladder[1:])
        gains = [f"gain_{name}" for name in known_models(rungs)]

        columns = [*KEYS, *steps, *gains, *STATES]
        if any(scenario.streams for scenario in scenarios):
            columns += [*dict.fromkeys(counts), "success"]
        return columns


def paper_controllers(scenario: str) -> list[str]:
    """Return the controllers that are compared by default.

    They are every rung, then switching at both lambdas.

    Raises:
        ValueError: for an unknown scenario.
    """
    choice = ENVIRONMENTS[scenario_name(scenario)].scenario
    switching = [f"switching:{price:g}" for price in choice.prices]
    return [*rung_names(choice.ladder), *switching]


def by_column(
    gains: Mapping[str, object],
    states: Float[np.ndarray, "*batch cars 4"],
) -> dict[str, object]:
    """Return the columns of records for gains by model and for states.

    Records have the states of the first two cars.
    """
    robot_and_human = states[..., :2, :]
    cars_first = np.moveaxis(robot_and_human, (-2, -1), (0, 1))  # [2, 4, ...]
    fields = cars_first.reshape(len(STATES), *np.shape(states)[:-2])
    columns = {f"gain_{name}": gain for name, gain in gains.items()}
    return columns | dict(zip(STATES, fields, strict=True))


def models_of(table: pd.DataFrame, what: str) -> list[str]:
    """Return the known models that have a column in a table, cheapest first.

    Args:
        table: the table.
        what: first part of the columns ``WHAT_MODEL``, such as ``gain`` of
            ``gain_tom``.
    """
    prefix = f"{what}_"
    columns = [str(column) for column in table]
    names = {
        column.removeprefix(prefix) for column in columns if column.startswith(prefix)
    }
    return [name for name in known_models(names) if name in names]


def per_episode(steps: pd.DataFrame, models: Iterable[str] = ()) -> pd.DataFrame:
    """Return a row per episode, in the order of the steps.

    Columns are ``scenario``, ``controller`` and ``seed``, and:

    * means over the steps, empty if a step's cell is empty: ``reward``,
      ``counted_seconds`` and, if they were measured, ``planning_seconds`` and
      ``decision_seconds``;
    * shares of the steps: ``share_MODEL``, planned with a model; ``way_out``, driven to
      keep a way out; and, if times were measured, ``late``, driven with an old plan
      because the new one was late;
    * numbers of steps: ``collisions``, in which the robot collided; and ``fallbacks``,
      whose plan failed;
    * with several humans: ``success``, 0 or 1, at the end of the episode; and the means
      of ``humans_MODEL``. ``share_MODEL`` then counts the steps in which the model is
      the most expensive one in use.

    Args:
        steps: records, in which the steps of an episode follow each other.
        models: models whose shares are wanted; by default, all known ones.
    """
    models = list(models) or known_models(steps["model"].unique())
    measured = [name for name in MEASURED[:2] if name in steps]
    counts = [f"humans_{name}" for name in models_of(steps, "humans")]

    # What is averaged over the steps, and what is counted in them.
    shares = {f"share_{name}": steps["model"] == name for name in models}
    shares["way_out"] = steps["status"] == "way out"
    if measured:
        shares["late"] = steps["status"] == "late"
    failed = ("previous plan", "braking")
    sums = {
        "collisions": steps["collision"],
        "fallbacks": steps["status"].isin(failed),
    }

    # An episode begins with each step 0.
    number_of_episode = (steps["step"] == 0).cumsum()
    rows = steps.assign(**shares, **sums)
    episodes = rows.groupby(number_of_episode)

    # Means of columns without empty cells.
    averaged = episodes[["reward", "counted_seconds", *measured, *counts, *shares]]
    is_complete = averaged.count().eq(episodes.size(), axis=0)
    means = averaged.mean().where(is_complete)

    totals = episodes[list(sums)].sum()
    table = episodes[KEYS].first().join(means).join(totals)
    if "success" in steps:
        # It is empty where there is one human.
        last = episodes["success"].last()
        table["success"] = last if last.isna().any() else last.astype(int)
    return table.reset_index(drop=True)


def check_table(table: pd.DataFrame, needed: Sequence[str] = ()) -> None:
    """Check that a table of steps or episodes holds needed columns and finite numbers.

    Args:
        table: the table.
        needed: columns that must be there in addition to those of every table. Those of
            `REQUIRED` have no empty cell.

    Raises:
        ValueError: naming what is wrong, and where.
    """
    absent = sorted({*KEYS, "reward", "counted_seconds", *needed} - {*table})
    if absent:
        raise ValueError(f"it has no column {', '.join(absent)}")
    texts = ("scenario", "controller", "model", "status")
    for name in table.columns.intersection(texts):
        empty = table[name].isna()
        if empty.any() and name in REQUIRED:
            raise ValueError(f"it has no {name} in row {1 + int(empty.argmax())}")
    for name in table.columns.difference(texts):
        numbers = pd.to_numeric(table[name], errors="coerce").astype(float)
        may_be_empty = name not in REQUIRED
        empty = table[name].isna() & may_be_empty
        wrong = ~np.isfinite(numbers) & ~empty
        for row in table[wrong][:1].to_dict("records"):
            where = f"{name} of {row['controller']} with seed {row['seed']}"
            raise ValueError(f"{where} is {row[name]}; it must be a finite number")


def one_episode(
    records: pd.DataFrame,
    scenario: str,
    controller: str,
    seed: int,
) -> pd.DataFrame:
    """Return the records of one episode, in the order of its steps.

    Raises:
        ValueError: if there are none.
    """
    chosen = records.query(
        "scenario == @scenario and controller == @controller and seed == @seed"
    )
    if chosen.empty:
        raise ValueError(
            f"there is no episode of {controller!r} in {scenario!r} with seed {seed} in"
            " these records"
        )
    return chosen.sort_values("step")


def common_seeds(
    records: pd.DataFrame,
    scenario: str,
    controllers: Sequence[str],
) -> list[int]:
    """Return the seeds from which all of these controllers have driven, ascending."""
    rows = records.query("scenario == @scenario and controller in @controllers")
    counts = rows.groupby("seed")["controller"].nunique()
    driven_by_all = counts == len(set(controllers))
    return counts.index[driven_by_all].tolist()
