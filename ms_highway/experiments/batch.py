"""Simulate episodes of a comparison many at a time rather than in the environments: the same starts, the same records.

`ms_highway.experiments.runner` runs the same `Comparison` in the environments. Nothing is measured here, so that no
plan is late: a budget counts planning at the seconds that are given, and deciding as nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isnan
from typing import Any, TypeAlias

import jax
import msgspec
import numpy as np
import pandas as pd
from gymnasium.utils import seeding
from jax import numpy as jnp
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
    COUNTED,
    KEYS,
    MEASURED,
    by_column,
    check_numbers,
    count_column,
    per_episode,
)
from ms_highway.game.game import Game, swap_roles
from ms_highway.game.scenario import REACHED
from ms_highway.loop.batch import simulate
from ms_highway.loop.devices import usual_chunk
from ms_highway.loop.fallback import STATUSES
from ms_highway.loop.human_drivers import HUMAN_DRIVERS, DriverFunction
from ms_highway.loop.records import DECIDES, PLANS, Episodes, Loop, Records
from ms_highway.planning.compiled_plans import Costs
from ms_highway.planning.human_models import Naive, cheapest_first, human_model
from ms_highway.runtime.arrays import Array

Key: TypeAlias = tuple[str, int]
"""Which episode of a scenario: its controller's short name, and its seed."""

STEP = (
    *("_reset", "_drive", "_drive_robot", "step", "_simulate", "_reward", "_rewards", "_is_terminated"),
    *("_is_truncated", "episode_steps", "car_states", "success", "measure", "counted_seconds"),
)
"""Names of the methods and properties of an environment that a simulation replaces by its own code."""

SEVERAL = ", of plans in which one human is predicted by it and the others by the first rung"


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
        return settings.rule(self.environment.settings.start(self.costs, self.steps, np.random.default_rng()))

    def episodes(self, keys: Sequence[Key]) -> Episodes:
        """Return what the simulation is given for these episodes, drawn as the environment draws it at a reset.

        Raises:
            ValueError: for a negative seed.
        """
        columns: list[tuple[Any, ...]] = []
        numbers = {name: PLANS + place for place, name in enumerate((None, *self.environment.settings.drivers))}
        for name, seed in keys:
            if seed < 0:
                raise ValueError(f"the seed is {seed}; it must not be negative")
            settings, random, shape = self.settings(name), seeding.np_random(seed)[0], (self.steps, self.humans)
            start, weights = self.environment.draw_episode(random)
            drivers = [numbers[name] for name in self.environment.draw_drivers(random)]
            rungs = np.full(shape, DECIDES, np.int32)
            if isinstance(settings, OrderSettings):
                table = np.vectorize(self.models.index)(settings.table(*shape, random))
                rungs[:] = table[np.minimum(np.arange(self.steps), len(table) - 1)]
            price, own = np.float32(np.nan_to_num(settings.price)), self.loop.game.robot.weights
            columns.append((np.float32(start), price, rungs, own, weights, drivers))
        return Episodes(*map(np.array, zip(*columns, strict=True)))

    def steps_table(self, keys: Sequence[Key], records: Records) -> pd.DataFrame:
        """Return a row per step, with the comparison's columns except measured times."""
        names, seeds = zip(*keys, strict=True)
        costs = Costs.of([self.costs.get(name, np.nan) for name in self.models], self.humans)
        known = cheapest_first(self.models)
        ranks = np.array([known.index(name) for name in self.models])
        cells = {
            "scenario": self.scenario,
            "controller": np.array(names, object)[:, None],
            "seed": np.array(seeds)[:, None],
            "step": np.arange(self.steps),
            "model": np.array(known)[ranks[records.rungs].max(axis=2)],
            "reward": np.asarray(records.reward, float),
            "collision": records.collision,
            COUNTED: costs.base + np.asarray(costs.each)[records.rungs].sum(axis=2),
            "status": np.array(STATUSES)[records.status],
        }
        states, gains = np.asarray(records.states, float), highest_gains(np.asarray(records.gains))
        cells |= by_column(dict(zip(self.rungs, np.moveaxis(gains, -1, 0), strict=True)), states)
        cells |= {count_column(name): np.sum(records.rungs == rung, axis=2) for rung, name in enumerate(self.rungs)}
        aside = np.abs(states[:, :, 0, 1] - float(self.loop.game.scene.target_lane))
        cells["success"] = (aside < REACHED) & ~np.logical_or.accumulate(records.collision, axis=1)
        shape = records.reward.shape
        table = pd.DataFrame({name: np.broadcast_to(part, shape).ravel() for name, part in cells.items()})
        return table.reindex(columns=[name for name in self.comparison.columns() if name not in MEASURED])

    def episodes_table(self, steps: pd.DataFrame) -> pd.DataFrame:
        """Return a row per episode of a table of steps, see `ms_highway.experiments.records.per_episode`.

        It has ``price`` as well, that is lambda, empty where nothing is decided.

        Raises:
            ValueError: for a reward that is not finite.
        """
        episodes = per_episode(steps, self.models)
        prices = {name: self.settings(name).price for name in episodes["controller"].unique()}
        episodes.insert(len(KEYS), "price", episodes["controller"].map(prices))
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
    for key, value in (("terminate_on_collision", True), ("beliefs", "true")):
        if configs[0].get(key) == value:
            reason = f"{scenario} is configured with {key} {value!r}, which a simulation does not do"
            raise ValueError(f"{reason}; use `compare`")
    kind, costs = ENVIRONMENTS[scenario], dict[str, float]()
    if own := [name for name in STEP if getattr(kind, name) is not getattr(InteractionEnv, name)]:
        reason = f"{kind.__name__} has its own {', '.join(own)}, which a simulation does not call"
        remedy = "change its scenario, its game (in `configure`) or `draw_episode`, or use `compare`"
        raise ValueError(f"{reason}; {remedy}")
    environment = kind(dict(configs[0]))
    for one in settings:
        if one.costs == "measured":
            remedy = "say 'shipped', or give seconds by model" + (SEVERAL if one.humans > 1 else "")
            raise ValueError(f"costs are {one.costs!r}, and a simulation cannot measure plans; {remedy}")
        costs |= one.seconds
    controllers = {name: one.controller for name, one in zip(names, settings, strict=True)}
    used = {name for each in controllers.values() for name in each.names()}
    used |= {Naive.name for each in controllers.values() if each.belief and not each.chooses}
    used -= {model.name for model in settings[0].models}
    others = tuple(map(human_model, cheapest_first(used)))
    order = Order(np.zeros((1, 1), np.int32), settings[0].models)
    drivers = tuple(_traced_driver(name, environment.game) for name in settings[0].drivers)
    loop = Loop(environment.game, order, others, settings[0].way_out, drivers=drivers, chunk=usual_chunk())
    batch = Batch(comparison, environment, controllers, costs, loop)
    for each in controllers.values():
        if each.chooses:
            batch.rule(each)
    return batch


def _traced_driver(name: str, game: Game) -> DriverFunction:
    """Return the function of a human driver, of which JAX can make a part of a simulation.

    Raises:
        ValueError: if it is a class of vehicles, the keyboard, or a function that JAX cannot trace.
    """
    driver, remedy = HUMAN_DRIVERS.get(name), "give add_driver a pure function of jax.numpy, or use `compare`"
    if driver is None or isinstance(driver, type):
        raise ValueError(f"config['human_driver'] is {name!r}, which cannot be simulated; {remedy}")
    own, cars = swap_roles(game), jnp.zeros((2 + game.number, 4))
    try:
        control = jax.eval_shape(driver, own, cars)
    except Exception as error:  # anything that code of the user's raises
        reason = str(error).partition("\n")[0]
        raise ValueError(f"JAX cannot trace the human driver {name!r}: {reason}; {remedy}") from error
    if jax.tree.map(jnp.shape, control) != (2,):
        raise ValueError(f"the human driver {name!r} returns {control}; return a curvature and an acceleration")
    return driver


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
