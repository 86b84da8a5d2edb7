"""Simulate episodes of a comparison many at a time rather than in the environments: the same starts, the same records.

`ms_highway.experiments.runner` runs the same `Comparison` in the environments. Nothing is measured here, so that no
plan is late: a budget counts planning at the seconds that are given, and deciding as nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from math import isnan
from typing import Any, TypeAlias

import jax
import msgspec
import numpy as np
import pandas as pd
from gymnasium.utils import seeding
from jax.sharding import Mesh

from ms_highway.choice.rule import Order, Rule, highest_gains
from ms_highway.envs import ENVIRONMENTS
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.configuration import read_own
from ms_highway.envs.controllers import ControllerSettings, OrderSettings
from ms_highway.envs.registry import controller_settings
from ms_highway.envs.settings import Settings
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import (
    CARS,
    MEASURED,
    check_numbers,
    count_column,
    gain_column,
    share_column,
    state_columns,
)
from ms_highway.game.scenario import REACHED
from ms_highway.loop.batch import simulate
from ms_highway.loop.devices import usual_chunk
from ms_highway.loop.fallback import BRAKING, PREVIOUS_PLAN, STATUSES, WAY_OUT
from ms_highway.loop.records import ALWAYS_YIELDS, DECIDES, NEVER_YIELDS, USUAL, Episodes, Loop, Records
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import Naive, cheapest_first, human_model
from ms_highway.runtime.arrays import Array

Key: TypeAlias = tuple[str, int]
"""Which episode of a scenario: its controller's short name, and its seed."""

OVERRIDABLE = {"scenario", "default_config", "configure", "draw_episode", "define_spaces", "render", "viewer_type"}
"""Names that a scenario's environment may override; a simulation calls these and no others."""

SEVERAL = ", of plans in which one human is predicted by it and the others by the first rung"
YIELDING = {None: USUAL, False: NEVER_YIELDS, True: ALWAYS_YIELDS}


@dataclass(frozen=True)
class Batch:
    """One scenario of a comparison, ready to be simulated, with one human or several.

    Attributes:
        comparison: what is compared.
        environment: what is simulated; it draws the episodes.
        controllers: settings by short name.
        costs: T(M) by model [s], as far as it is known.
        loop: what all episodes have in common, with the ladder and an order in place of a rule.
    """

    comparison: Comparison
    environment: InteractionEnv
    controllers: Mapping[str, ControllerSettings]
    costs: Mapping[str, float]
    loop: Loop

    @property
    def scenario(self) -> str:
        """The name of the scenario."""
        return self.environment.scenario.name

    @property
    def models(self) -> list[str]:
        """Names of the models, in the order of their numbers: those of the ladder, then what only orders use."""
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

    def keys(self, first: int = 0, last: int | None = None) -> list[Key]:
        """Episodes from the first to before the last, seed by seed, so that all parts hold controllers alike."""
        names, seed = list(self.controllers), self.comparison.first_seed
        places = range(self.comparison.seeds * len(names))[first:last]
        return [(names[place % len(names)], seed + place // len(names)) for place in places]

    def simulate(
        self, keys: Sequence[Key], mesh: Mesh | None = None, shifts: Array | None = None, errors: Array | None = None
    ) -> Records:
        """Simulate episodes, together those of controllers that choose alike but for their lambda.

        Args:
            keys: which.
            mesh: see `ms_highway.loop.batch.simulate`.
            shifts: what is added to the starts of the first cars, the robot before the humans [episodes, cars, 4].
            errors: of what the robot sees, see `ms_highway.loop.records.Episodes`.

        Raises:
            ValueError: without an episode, or for a negative seed.
        """
        if not keys:
            raise ValueError("there are no episodes to simulate; give one at least")
        kinds = [self._kind(name) for name, _ in keys]
        alike = [[place for place, other in enumerate(kinds) if other == kind] for kind in dict.fromkeys(kinds)]
        parts = []
        for places in alike:
            settings, belief = kinds[places[0]]
            loop = replace(self.loop, rule=self.rule(settings) if settings else self.loop.rule, belief=belief)
            episodes = self.episodes([keys[place] for place in places])
            if shifts is not None:
                episodes.starts[:, : shifts.shape[1]] += shifts[places]
            if errors is not None:
                episodes = replace(episodes, errors=errors[places])
            parts.append(simulate(loop, episodes, mesh))
        order = np.argsort(np.concatenate(alike))
        return jax.tree.map(lambda *part: np.concatenate(part)[order], *parts)

    def settings(self, controller: str) -> ControllerSettings:
        """Return the settings of a controller of the comparison, or of an order of its models by any short name."""
        return self.controllers.get(controller) or controller_settings(controller)

    def _kind(self, controller: str) -> tuple[ControllerSettings | None, bool]:
        """Return what controllers have in common that are simulated together: no rule, or one at any lambda."""
        settings = self.settings(controller)
        anyway = settings if isnan(settings.price) else msgspec.structs.replace(settings, price=0.0)
        return anyway if settings.chooses else None, settings.belief

    def rule(self, settings: ControllerSettings) -> Rule:
        """Return the rule of a controller that chooses models from the ladder.

        Raises:
            ValueError: if its values were learned on another ladder.
        """
        costs = Costs.of([self.costs[name] for name in self.rungs], self.humans)
        return settings.rule(self.environment.settings.start(costs, self.steps, np.random.default_rng()))

    def episodes(self, keys: Sequence[Key]) -> Episodes:
        """Return what the simulation is given for these episodes, drawn as the environment draws it at a reset.

        Raises:
            ValueError: for a negative seed.
        """
        drawn = [self._drawn(self.settings(name), seed) for name, seed in keys]
        starts, prices, schedules, *others = (np.array(part) for part in zip(*drawn, strict=True))
        return Episodes(starts.astype(np.float32), prices.astype(np.float32), schedules.astype(np.int32), *others)

    def _drawn(self, settings: ControllerSettings, seed: int) -> tuple[Any, ...]:
        if seed < 0:
            raise ValueError(f"the seed is {seed}; it must not be negative")
        random, shape = seeding.np_random(seed)[0], (self.steps, self.humans)
        start, weights = self.environment.draw_episode(random)
        yielding = [YIELDING[yields] for yields in self.environment.draw_yielding(random)]
        rungs = np.full(shape, DECIDES)
        if isinstance(settings, OrderSettings):
            table = np.vectorize(self.models.index)(settings.table(*shape, random))
            rungs = np.broadcast_to(table[np.minimum(np.arange(self.steps), len(table) - 1)], shape)
        return start, np.nan_to_num(settings.price), rungs, self.loop.game.robot.weights, weights, yielding

    def _cells(self, records: Records) -> dict[str, Array]:
        """Return columns of steps that episodes are summarised by, arrays [episodes, steps].

        These are ``model``, the name of the most expensive model in use; ``counted_seconds``, NaN where T is not
        known; and those that only records with several humans have.
        """
        costs = Costs.of([self.costs.get(name, np.nan) for name in self.models], self.humans)
        known = cheapest_first(self.models)
        ranks = np.array([known.index(name) for name in self.models])
        cells = {
            "model": np.array(known)[ranks[records.rungs].max(axis=2)],
            "counted_seconds": costs.base + np.asarray(costs.each)[records.rungs].sum(axis=2),
        }
        if not self.environment.scenario.streams:
            return cells
        aside = np.asarray(records.states)[:, :, 0, 1] - float(self.loop.game.scene.target_lane)
        cells |= {
            count_column(name): np.sum(records.rungs == rung, axis=2) for rung, name in enumerate(self.rungs) if rung
        }
        return cells | {"success": (np.abs(aside) < REACHED) & ~np.logical_or.accumulate(records.collision, axis=1)}

    def steps_table(self, keys: Sequence[Key], records: Records) -> pd.DataFrame:
        """Return a row per step, with the comparison's columns except measured times."""
        (names, seeds), shape, cells = zip(*keys, strict=True), records.reward.shape, self._cells(records)
        states = np.asarray(records.states[:, :, : len(CARS)], float).reshape(*shape, -1)
        gains = highest_gains(np.asarray(records.gains))
        cells |= {
            "controller": np.array(names)[:, None],
            "seed": np.array(seeds)[:, None],
            "step": np.arange(self.steps),
            "reward": np.asarray(records.reward, float),
            "collision": records.collision,
            "status": np.array(STATUSES)[records.status],
            **dict(zip(map(gain_column, self.rungs), np.moveaxis(gains, -1, 0), strict=True)),
            **dict(zip(chain(*map(state_columns, CARS)), np.moveaxis(states, -1, 0), strict=True)),
        }
        table = pd.DataFrame({name: np.broadcast_to(part, shape).ravel() for name, part in cells.items()})
        wanted = [name for name in self.comparison.columns() if name not in MEASURED]
        return table.assign(scenario=self.scenario).reindex(columns=wanted)

    def episodes_table(self, keys: Sequence[Key], records: Records) -> pd.DataFrame:
        """Return a row per episode.

        Columns: ``scenario``, ``controller`` and ``seed``; ``price``, that is lambda, empty where nothing is decided;
        ``reward`` and ``counted_seconds``, planning at T(M), as means over the steps; ``share_MODEL`` of the steps;
        ``collisions``, steps in which the robot collided; ``fallbacks``, steps whose plan failed. Where there are
        several humans, MODEL is the most expensive one in use, and there are ``success``, 0 or 1, and means over the
        steps: ``humans_MODEL``, and ``way_out``, of the steps driven to keep one.

        Raises:
            ValueError: for a reward that is not finite.
        """
        cells, (names, seeds) = self._cells(records), zip(*keys, strict=True)
        used, counted = cells.pop("model"), cells.pop("counted_seconds")
        table = {
            "scenario": self.scenario,
            "controller": names,
            "seed": seeds,
            "price": [self.settings(name).price for name in names],
            "reward": np.mean(records.reward, axis=1, dtype=float),
            "counted_seconds": np.mean(counted, axis=1),
            **{share_column(name): np.mean(used == name, axis=1) for name in self.models},
            "collisions": np.sum(records.collision, axis=1),
            "fallbacks": np.sum(np.isin(records.status, (PREVIOUS_PLAN, BRAKING)), axis=1),
        }
        if cells:
            table["success"] = cells.pop("success")[:, -1].astype(int)
            table |= {name: part.mean(axis=1) for name, part in cells.items()}
            table["way_out"] = np.equal(records.status, WAY_OUT).mean(axis=1)
        episodes = pd.DataFrame(table)
        check_numbers(episodes)
        return episodes


def make_batch(comparison: Comparison, scenario: str) -> Batch:
    """Make one scenario ready to be simulated.

    Args:
        comparison: what is compared.
        scenario: its name.

    Raises:
        ValueError: for anything unknown or impossible, and where there are no controllers; for costs that are to be
            measured, as nothing is timed here; and for environments that end early, do something of their own in a
            step, or tell the robot the true rewards.
    """
    names = comparison.controllers.get(scenario, [])
    if not names:
        raise ValueError(f"the comparison has no controllers for {scenario!r}; name one at least")
    configs = [comparison.environment_config(scenario, name) for name in names]
    settings = [read_own(Settings, config) for config in configs]
    environment, costs = _environment(scenario, configs[0]), dict[str, float]()
    for one in settings:
        if one.seconds is None:
            remedy = "say 'shipped', or give seconds by model" + (SEVERAL if one.humans > 1 else "")
            raise ValueError(f"costs are {one.costs!r}, and a simulation cannot measure plans; {remedy}")
        costs |= one.seconds
    controllers = {name: one.controller for name, one in zip(names, settings, strict=True)}
    used = {name for each in controllers.values() for name in each.names()}
    used |= {Naive.name for each in controllers.values() if each.belief and not each.chooses}
    used -= {model.name for model in settings[0].models}
    others = tuple(map(human_model, cheapest_first(used)))
    order = Order(np.zeros((1, 1), np.int32), settings[0].models)
    yielding = settings[0].yielding != "usual"
    loop = Loop(environment.game, order, others, settings[0].way_out, yielding=yielding, chunk=usual_chunk())
    batch = Batch(comparison, environment, controllers, costs, loop)
    for each in controllers.values():
        if each.chooses:
            batch.rule(each)
    return batch


def _environment(scenario: str, config: Mapping[str, Any]) -> InteractionEnv:
    """Return the environment of a scenario, which does nothing in a step that a simulation does not.

    Raises:
        ValueError: for environments that end early, know the true rewards, or do something of their own in a step.
    """
    for key, value in (("terminate_on_collision", True), ("beliefs", "true")):
        if config.get(key) == value:
            raise ValueError(
                f"{scenario} is configured with {key} {value!r}, which a simulation does not do; use `compare`"
            )
    kind = ENVIRONMENTS[scenario]
    classes = kind.__mro__[: kind.__mro__.index(InteractionEnv)]
    own = {name for one in classes for name in vars(one) if hasattr(InteractionEnv, name) and name[:2] != "__"}
    if own - OVERRIDABLE:
        reason = f"{kind.__name__} has its own {', '.join(sorted(own - OVERRIDABLE))}, which a simulation does not call"
        raise ValueError(
            f"{reason}; change its scenario, its game (in `configure`) or `draw_episode`, or use `compare`"
        )
    return kind(dict(config))


def simulated(comparison: Comparison, mesh: Mesh | None = None) -> pd.DataFrame:
    """Simulate a comparison and return all records, a row per step, in the comparison's order.

    Args:
        comparison: what to simulate.
        mesh: see `ms_highway.loop.batch.simulate`.

    Raises:
        ValueError: for anything unknown or impossible, and for costs that are to be measured.
    """
    tables = []
    for batch in [make_batch(comparison, scenario) for scenario in comparison.controllers]:
        names = list(batch.controllers)
        keys = sorted(batch.keys(), key=lambda key: names.index(key[0]))
        tables.append(batch.steps_table(keys, batch.simulate(keys, mesh)))
    return pd.concat(tables, ignore_index=True)
