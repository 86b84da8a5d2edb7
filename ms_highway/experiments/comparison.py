"""Define comparisons and the columns of their records of steps; check records, and
summarise them by episode.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, product
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from ms_highway.envs import ENVIRONMENTS, scenario_name
from ms_highway.envs.registry import controller_settings, robot_config
from ms_highway.envs.settings import HUMAN_REWARDS
from ms_highway.planning.ladders import known_models, rung_names
from ms_highway.runtime.definitions import definition_sources
from ms_highway.runtime.sources import Sources, digest, imported_sources

EpisodeKey: TypeAlias = tuple[str, str, int]
"""An episode: its scenario, the short name of its controller, and its seed."""

USUAL = ("semantics", "solver", "human_reward", "costs")
"""Keys of the configuration that results always record, unless the scenarios' defaults
differ.
"""


@dataclass(frozen=True)
class Comparison:
    """What is compared, in scenarios with one human or several.

    Attributes:
        controllers: short names of the controllers of each scenario, by its name or id.
        seeds: number of episodes of each controller.
        first_seed: seed of the first episode; the others have the following seeds.
        config: values that differ from the environments' default configuration, by key.
    """

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
        """Return the whole configuration of the environment of a scenario and a
        controller.

        Raises:
            ValueError: for the same reasons as `Comparison`.
        """
        return ENVIRONMENTS[scenario_name(scenario)].checked_config(
            {**self.config, **robot_config(controller)}
        )

    def common_config(self) -> dict:
        """Return the common configuration, under which results are resumed: `USUAL` and
        all keys of ``config``.
        """
        defaults = [
            {**ENVIRONMENTS[name].default_config(), **self.config}
            for name in self.controllers
        ]
        for config in defaults:
            config["human_reward"] = (
                config["human_reward"] or HUMAN_REWARDS[config["semantics"]]
            )
        first = defaults[0]
        usual = {
            key: first[key]
            for key in USUAL
            if all(first[key] == each[key] for each in defaults)
        }
        ladder = (
            {"ladder": rung_names(self.config["ladder"])}
            if "ladder" in self.config
            else {}
        )
        return {**usual, **self.config, **ladder}

    def sources(self) -> dict[str, dict[str, Sources]]:
        """Return the digests of what the user has imported and named, by scenario and
        controller.

        Each controller depends on all imported modules, as scenarios, drivers and
        features may come from them; on what was added by names that its configuration
        or the scenario has; and on its own files.
        """
        found: dict[str, dict[str, Sources]] = {}
        for name, controllers in self.controllers.items():
            scenario = ENVIRONMENTS[name].scenario
            weights = [*scenario.robot_weights, *scenario.human_weights]
            for controller in controllers:
                named = [
                    name,
                    controller,
                    *scenario.ladder,
                    *weights,
                    json.dumps(self.config, default=str),
                ]
                files = {
                    file: digest(Path(file))
                    for file in controller_settings(controller).files()
                }
                own = imported_sources() | definition_sources(" ".join(named)) | files
                found.setdefault(name, {})[controller] = own
        return found

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
        scenarios = [ENVIRONMENTS[name].scenario for name in self.controllers]
        ladders = [
            rung_names(self.config.get("ladder", scenario.ladder))
            for scenario in scenarios
        ]
        planning, decision, compiling = MEASURED
        steps = [
            "step",
            "model",
            "reward",
            "collision",
            planning,
            COUNTED,
            decision,
            compiling,
            "status",
        ]
        gains = [f"gain_{name}" for name in known_models(chain(*ladders))]
        above = [
            ladder[1:]
            for scenario, ladder in zip(scenarios, ladders, strict=True)
            if scenario.streams
        ]
        several = (
            [*dict.fromkeys(f"humans_{name}" for name in chain(*above)), "success"]
            if above
            else []
        )
        return [*KEYS, *steps, *gains, *STATES, *several]


def paper_controllers(scenario: str) -> list[str]:
    """Return the controllers that are compared by default: every rung, then switching
    at both lambdas.

    Raises:
        ValueError: for an unknown scenario.
    """
    choice = ENVIRONMENTS[scenario_name(scenario)].scenario
    return [
        *rung_names(choice.ladder),
        *(f"switching:{price:g}" for price in choice.prices),
    ]


KEYS = ["scenario", "controller", "seed"]
"""Columns that identify the episode of a step."""

MEASURED = ("planning_seconds", "decision_seconds", "compile_seconds")
"""Columns of measured times, which simulations do not have."""

COUNTED = "counted_seconds"
NEEDED = [*KEYS, "step", "model", "status", "reward", "collision", *MEASURED[:2]]
"""Columns that records of live steps must have, without empty cells."""

TEXTS = ("scenario", "controller", "model", "status")
FAILED = "previous plan", "braking"
STATES = [
    f"{car}_{name}"
    for car in ("robot", "human")
    for name in ("x", "y", "heading", "speed")
]
"""Columns of the states of the first two cars."""


def by_column(gains: Mapping, states: Any) -> dict:
    """Return the columns of records for gains by model and for the first two cars of
    states [..., cars, 4].
    """
    first = np.moveaxis(states[..., :2, :], (-2, -1), (0, 1)).reshape(
        len(STATES), *np.shape(states)[:-2]
    )
    return {f"gain_{name}": gain for name, gain in gains.items()} | dict(
        zip(STATES, first, strict=True)
    )


def models_of(table: pd.DataFrame, what: str) -> list[str]:
    """Return the known models that have a column ``WHAT_MODEL``, such as ``gain_tom``,
    in a table, cheapest first.
    """
    names = {
        str(name).removeprefix(f"{what}_")
        for name in table
        if str(name).startswith(f"{what}_")
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
    shares = {f"share_{name}": steps["model"] == name for name in models}
    shares["way_out"] = steps["status"] == "way out"
    measured = [name for name in MEASURED[:2] if name in steps]
    if measured:
        shares["late"] = steps["status"] == "late"
    sums = {"collisions": steps["collision"], "fallbacks": steps["status"].isin(FAILED)}
    counts = [f"humans_{name}" for name in models_of(steps, "humans")]
    episodes = steps.assign(**shares, **sums).groupby((steps["step"] == 0).cumsum())
    means = episodes[["reward", COUNTED, *measured, *counts, *shares]]
    known = means.count().eq(episodes.size(), axis=0)
    table = (
        episodes[KEYS]
        .first()
        .join(means.mean().where(known))
        .join(episodes[list(sums)].sum())
    )
    if "success" in steps:
        ended = episodes["success"].last()  # empty where there is one human
        table["success"] = ended if ended.isna().any() else ended.astype(int)
    return table.reset_index(drop=True)


def check_table(table: pd.DataFrame, needed: Sequence[str] = ()) -> None:
    """Check that a table of steps or episodes holds the needed columns, and finite
    numbers except in `TEXTS`.

    Args:
        table: the table.
        needed: columns that must be there in addition to those of every table. Those of
            `NEEDED` have no empty cell.

    Raises:
        ValueError: naming what is wrong, and where.
    """
    absent = sorted({*KEYS, "reward", COUNTED, *needed} - {*table})
    if absent:
        raise ValueError(f"it has no column {', '.join(absent)}")
    for name in table.columns.intersection(TEXTS):
        if table[name].isna().any() and name in NEEDED:
            raise ValueError(
                f"it has no {name} in row {1 + int(table[name].isna().argmax())}"
            )
    for name in table.columns.difference(TEXTS):
        numbers = pd.to_numeric(table[name], errors="coerce").astype(float)
        wrong = ~np.isfinite(numbers) & (table[name].notna() | (name in NEEDED))
        for row in table[wrong][:1].to_dict("records"):
            where = f"{name} of {row['controller']} with seed {row['seed']}"
            raise ValueError(f"{where} is {row[name]}; it must be a finite number")


def one_episode(
    records: pd.DataFrame, scenario: str, controller: str, seed: int
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
    records: pd.DataFrame, scenario: str, controllers: Sequence[str]
) -> list[int]:
    """Return the seeds of the episodes that every one of these controllers has driven,
    ascending.
    """
    rows = records.query("scenario == @scenario and controller in @controllers")
    driven = rows.groupby("seed")["controller"].nunique()
    return driven.index[driven == len(set(controllers))].tolist()
