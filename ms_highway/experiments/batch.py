"""Simulate the episodes of a comparison in batches.

Starts and records are the same as in the environments.
`ms_highway.experiments.runner` runs the same `Comparison` in the environments. Nothing
is measured here, so no plan is late. A budget counts the given seconds for planning,
and none for deciding.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TypeAlias

import jax
import numpy as np
import pandas as pd
from gymnasium.utils import seeding

from ms_highway.choice.records import highest_gains
from ms_highway.choice.rule import compilable
from ms_highway.envs import ENVIRONMENTS
from ms_highway.envs.agents import is_agent
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.configuration import read_own
from ms_highway.envs.controllers import ControllerSettings
from ms_highway.envs.registry import controller_settings
from ms_highway.envs.settings import Settings
from ms_highway.envs.simulation import draw_start, shared_loop, stack_episodes
from ms_highway.experiments.comparison import (
    KEYS,
    MEASURED,
    Comparison,
    by_column,
    check_table,
    per_episode,
)
from ms_highway.loop.batch import simulate
from ms_highway.loop.records import Episodes, Loop, Records
from ms_highway.loop.step import STATUSES
from ms_highway.planning.costs import Costs
from ms_highway.planning.ladders import cheapest_first
from ms_highway.runtime.compilation import Devices

Key: TypeAlias = tuple[str, int]
"""An episode of a scenario: the short name of its controller, and its seed."""

Tables: TypeAlias = dict[str, pd.DataFrame]
"""Tables by name."""


@dataclass(frozen=True)
class Batch:
    """One scenario of a comparison, ready to be simulated, with one human or several.

    Attributes:
        comparison: what is compared.
        environment: environment that is simulated; it draws the starts.
        controllers: settings of the controllers by short name.
        costs: of `models`, in their order.
        loop: what all episodes have in common; its rule is an order on the ladder, to
            be replaced.
    """

    comparison: Comparison
    environment: InteractionEnv
    controllers: Mapping[str, ControllerSettings]
    costs: Costs
    loop: Loop

    @property
    def models(self) -> list[str]:
        """Names of the models, in the order of their numbers.

        They are those of the ladder, then those that only orders use.
        """
        return [model.name for model in self.loop.models]

    @property
    def rungs(self) -> list[str]:
        """Names of the models to choose from."""
        return [model.name for model in self.loop.rule.ladder]

    @property
    def humans(self) -> int:
        """The number of humans."""
        return self.loop.game.number

    @property
    def steps(self) -> int:
        """The length of an episode."""
        return self.environment.episode_steps

    def keys(self) -> list[Key]:
        """Return all episodes of the scenario, controller by controller."""
        scenario = self.environment.scenario.name
        controllers = self.comparison.controllers[scenario]
        return list(product(controllers, self.comparison.seed_range))

    def simulate(self, keys: Sequence[Key], devices: Devices | None = None) -> Records:
        """Simulate episodes, together if their controllers differ only in lambda.

        Args:
            keys: the episodes.
            devices: see `ms_highway.loop.batch.simulate`.
        """
        # Group the indices of the episodes by what their controllers have in common.
        # Orders differ only in their schedules, which are inputs of the simulation.
        groups: dict[tuple[ControllerSettings | None, bool], list[int]] = {}
        for index, (controller, _) in enumerate(keys):
            settings = self.settings(controller)
            rule = settings.without_price() if settings.chooses else None
            group = groups.setdefault((rule, settings.belief), [])
            group.append(index)

        parts = []
        for indices in groups.values():
            keys_of_group = [keys[index] for index in indices]
            controller, _ = keys_of_group[0]
            loop = self.loop_of(controller)
            episodes = self.episodes(keys_of_group)
            parts.append(simulate(loop, episodes, devices))

        # Return to the order of the keys.
        indices_of_parts = np.concatenate(list(groups.values()))
        order = np.argsort(indices_of_parts)
        return jax.tree.map(lambda *arrays: np.concatenate(arrays)[order], *parts)

    def settings(self, controller: str) -> ControllerSettings:
        """Return the settings of a controller, by short name.

        It is a controller of the comparison, or any order of its models.
        """
        return self.controllers.get(controller) or controller_settings(controller)

    def loop_of(self, controller: str) -> Loop:
        """Return the loop of the episodes of a controller.

        Its rule is the controller's, if this chooses models from the ladder.

        Raises:
            ValueError: if its values were learned on another ladder, or JAX cannot
                compile for its rule.
        """
        settings = self.settings(controller)
        rule = self.loop.rule
        if settings.chooses:
            random = np.random.default_rng()
            start = self.environment.settings.start(self.steps, random, self.costs)
            rule = compilable(settings.rule(start))
        return replace(self.loop, rule=rule, belief=settings.belief)

    def episodes(self, keys: Sequence[Key]) -> Episodes:
        """Return the inputs of episodes, drawn as at a reset of the environment."""
        drawn = []
        for controller, seed in keys:
            random, _ = seeding.np_random(seed)
            settings = self.settings(controller)
            start = draw_start(self.environment, self.loop, settings, random)
            drawn.append(start)
        return stack_episodes(drawn)

    def steps_table(self, keys: Sequence[Key], records: Records) -> pd.DataFrame:
        """Return a row per step, with all columns except those of measured times."""
        names, seeds = zip(*keys, strict=True)
        states = np.asarray(records.states, float)  # [episodes, steps, cars, 4]

        # The most expensive model in use among the humans of a step.
        by_cost = cheapest_first(self.models)
        ranks = np.array([by_cost.index(name) for name in self.models])
        highest_rank = ranks[records.rungs].max(axis=2)  # [episodes, steps]
        most_expensive = np.array(by_cost)[highest_rank]

        # Gains by model, each [episodes, steps].
        gains = highest_gains(np.asarray(records.gains))
        gains_of_rungs = np.moveaxis(gains, -1, 0)
        gain_by_rung = dict(zip(self.rungs, gains_of_rungs, strict=True))

        # Whether the robot has succeeded so far.
        y = states[:, :, 0, 1]
        is_in_lane = self.loop.game.scene.is_reached(y)
        has_collided = np.logical_or.accumulate(records.collision, axis=1)

        # Cells that are the same in an episode or in a step are broadcast below.
        cells = {
            "scenario": self.environment.scenario.name,
            "controller": np.array(names, object)[:, None],
            "seed": np.array(seeds)[:, None],
            "step": np.arange(self.steps),
            "model": most_expensive,
            "reward": np.asarray(records.reward, float),
            "collision": records.collision,
            "counted_seconds": self.costs.total(records.planned),
            "status": np.array(STATUSES)[records.status],
            "success": is_in_lane & ~has_collided,
            **by_column(gain_by_rung, states),
        }
        for rung, name in enumerate(self.rungs):
            cells[f"humans_{name}"] = np.sum(records.rungs == rung, axis=2)

        shape = records.reward.shape  # (episodes, steps)
        table = {}
        for name in self.comparison.columns():
            if name in MEASURED:
                continue
            column = np.broadcast_to(cells.get(name, np.nan), shape)
            table[name] = column.ravel()
        return pd.DataFrame(table)

    def tables(self, keys: Sequence[Key], devices: Devices | None = None) -> Tables:
        """Simulate episodes; return the tables ``steps`` and ``episodes``.

        They have a row per step and a row per episode. Steps have the columns of
        `Comparison.columns` without measured times. Episodes have those of
        `per_episode`, and ``price``, the lambda of their controller, empty if it has
        none.

        Raises:
            ValueError: for a reward that is not finite.
        """
        records = self.simulate(keys, devices)
        steps = self.steps_table(keys, records)
        episodes = per_episode(steps, self.models)

        controllers = episodes["controller"]
        price_of = {name: self.settings(name).price for name in controllers.unique()}
        episodes.insert(len(KEYS), "price", controllers.map(price_of))
        check_table(episodes)
        return {"steps": steps, "episodes": episodes}


def make_batch(comparison: Comparison, scenario: str) -> Batch:
    """Prepare a scenario of a comparison for simulation.

    Args:
        comparison: what is compared.
        scenario: name of the scenario.

    Raises:
        ValueError: for anything unknown or impossible; without controllers; for costs
            that have to be measured, as nothing is timed here; and for environments
            that end early or have a step of their own.
    """
    names = comparison.controllers.get(scenario, [])
    if not names:
        raise ValueError(
            f"the comparison has no controllers for {scenario!r}; name one at least"
        )
    for name in filter(is_agent, names):
        raise ValueError(f"the agent {name!r} is not simulated; use `compare`")
    configs = [comparison.environment_config(scenario, name) for name in names]
    settings = [read_own(Settings, config) for config in configs]
    if configs[0]["terminate_on_collision"]:
        raise ValueError(
            f"{scenario} is configured with terminate_on_collision True, which a"
            " simulation does not do; use `compare`"
        )
    environment = ENVIRONMENTS[scenario](dict(configs[0]))
    controllers = {
        name: own.controller for name, own in zip(names, settings, strict=True)
    }
    loop = shared_loop(environment, controllers.values())
    costs_by_name = environment.settings.costs_of(loop.models)
    costs = costs_by_name.select(model.name for model in loop.models)
    batch = Batch(comparison, environment, controllers, costs, loop)
    # Refuse now what could not be simulated later.
    for name in names:
        batch.loop_of(name)
    return batch


def simulate_parts(
    comparison: Comparison,
    parts: Mapping[str, range],
    devices: Devices | None = None,
) -> Iterator[tuple[str, Tables]]:
    """Simulate parts of a comparison one by one; yield their names and `Batch.tables`.

    Args:
        comparison: of a single scenario.
        parts: places of the episodes in `Comparison.episodes`, by the name of the part.
        devices: that share each part; by default, the first.
    """
    batch = make_batch(comparison, *comparison.controllers)
    keys = batch.keys()
    for name, part in parts.items():
        yield name, batch.tables(keys[part.start : part.stop], devices)


def simulated(comparison: Comparison) -> pd.DataFrame:
    """Simulate a comparison; return all records, a row per step, in its order.

    Raises:
        ValueError: see `make_batch`.
    """
    # Refuse what cannot be simulated before anything is computed.
    batches = [make_batch(comparison, scenario) for scenario in comparison.controllers]
    tables = []
    for batch in batches:
        keys = batch.keys()
        tables.append(batch.steps_table(keys, batch.simulate(keys)))
    return pd.concat(tables, ignore_index=True)
