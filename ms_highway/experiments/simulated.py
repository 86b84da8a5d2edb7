"""Episodes of a comparison, computed many at a time rather than in the environments: the same starts, the same records.

`ms_highway.experiments.runner` runs the same `Comparison` in the environments.
"""

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
import pandas as pd
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ms_highway.control.fallback import BRAKING, PREVIOUS_PLAN, STATUSES
from ms_highway.envs import is_crowd, two_player_scenario
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.controllers import ChoosingSettings, ControllerSettings, SwitchingSettings
from ms_highway.envs.settings import Settings
from ms_highway.envs.short_names import named_controller
from ms_highway.experiments.batch import (
    EpisodeBatch,
    Key,
    Recorded,
    checked_environment,
    configurations,
    random_of,
)
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import CARS, MEASURED, STATE, columns, gain_column, share_column, state_columns
from ms_highway.experiments.simulated_crowd import make_crowd_batch
from ms_highway.game.scenario import Semantics
from ms_highway.planning.human_models import human_model, known_models
from ms_highway.simulation.devices import usual_chunk
from ms_highway.simulation.loop import simulate
from ms_highway.simulation.records import DECIDES, Episodes, Loop, Records

__all__ = [
    "Batch",
    "Key",
    "any_batch",
    "columns_simulated",
    "episodes_of",
    "make_batch",
    "run_episodes",
    "simulated",
    "start",
    "summarised",
    "tabulated",
]

NOBODY = SwitchingSettings(0.0)
"""Stands in for a rule where models are scheduled."""


def columns_simulated(rungs: Iterable[str] = (), crowd: bool = False) -> list[str]:
    """Return the columns of a simulated step, `ms_highway.experiments.records.columns` without the measured times."""
    return [name for name in columns(rungs, crowd) if name not in MEASURED]


@dataclass(frozen=True)
class Batch(EpisodeBatch[Records]):
    """One scenario with one human, ready to be simulated.

    Attributes:
        loop: what all episodes have in common.
    """

    loop: Loop

    @property
    def semantics(self) -> Semantics:
        """What drives."""
        return self.environment.settings.semantics

    @property
    def models(self) -> list[str]:
        """See `EpisodeBatch.models`."""
        return [model.name for model in self.loop.models]

    @property
    def rungs(self) -> list[str]:
        """See `EpisodeBatch.rungs`."""
        return [model.name for model in self.loop.rule.ladder]

    def loop_with(self, chooses: ChoosingSettings) -> Loop:
        """Return the loop of episodes whose models a controller chooses."""
        rule = chooses.rule(self.loop.rule.ladder, np.asarray(self.loop.rule.costs), self.semantics)
        return replace(self.loop, rule=rule)

    def kind(self, controller: str) -> ChoosingSettings:
        """Return how controllers choose, whatever their lambda."""
        settings = named_controller(controller)
        return replace(settings, price=0.0) if isinstance(settings, ChoosingSettings) else NOBODY

    def simulate(self, keys: Sequence[Key], mesh: Mesh | None = None) -> Records:
        """See `EpisodeBatch.simulate`."""
        return simulate(self.loop_with(self.kind(keys[0][0])), episodes_of(self, keys), mesh)

    def price(self, controller: str) -> float:
        """See `EpisodeBatch.price`."""
        return named_controller(controller).price

    def used(self, records: Records) -> Int[np.ndarray, "episodes steps"]:
        """See `EpisodeBatch.used`."""
        return np.asarray(records.model)

    def counted(self, records: Records) -> Float[np.ndarray, "episodes steps"]:
        """Return T(M) of the model in use."""
        return np.array([self.costs.get(name, np.nan) for name in self.models])[records.model]

    def gains(self, records: Records) -> dict[str, Float[np.ndarray, "episodes steps"]]:
        """Return the estimated gain of switching to each rung."""
        return dict(zip(self.rungs, np.moveaxis(np.asarray(records.gains), -1, 0), strict=True))


def any_batch(comparison: Comparison, scenario: str) -> EpisodeBatch[Any]:
    """Make a scenario with one human or several ready to be simulated, see `make_batch` and `make_crowd_batch`."""
    return make_crowd_batch(comparison, scenario) if is_crowd(scenario) else make_batch(comparison, scenario)


def make_batch(comparison: Comparison, scenario: str) -> Batch:
    """Make one scenario with one human ready to be simulated.

    Args:
        comparison: what is compared.
        scenario: its name.

    Raises:
        ValueError: for anything unknown or impossible; for costs that are to be measured, as nothing is timed here; and
            for environments that end early, or do something of their own in a step.
    """
    two_player_scenario(scenario)
    configs = configurations(comparison, scenario)
    settings = [Settings.read(config) for config in configs]
    costs = settings[0].costs
    if costs is None:
        remedy = "say 'published', or give seconds by model"
        raise ValueError(f"costs are {comparison.costs!r}, and a simulation cannot measure plans; {remedy}")
    environment = checked_environment(scenario, configs[0], InteractionEnv)
    rungs = environment.models
    used = {name for one in settings for name in one.controller.names()}
    others = [name for name in known_models(used) if name in used - {model.name for model in rungs}]
    seconds = np.array([costs[model.name] for model in rungs], np.float32)
    models = tuple(map(human_model, others))
    for one in settings:
        if isinstance(one.controller, ChoosingSettings):
            one.controller.rule(rungs, seconds, one.semantics)  # refuses values of other ladders or costs
        elif not one.controller.names():
            raise ValueError(f"a simulation does not know how {one.controller.type!r} chooses models; use `compare`")
    rule = NOBODY.rule(rungs, seconds, settings[0].semantics)
    loop = Loop(environment.game, rule, models, settings[0].warm_start, usual_chunk())
    known = {name: each for one in settings for name, each in (one.costs or {}).items()}
    return Batch(comparison, environment.scenario, known, environment, loop)


def start(batch: Batch, seed: int) -> Float[np.ndarray, "cars 4"]:
    """Return the start that the environment draws for a seed, in SI units.

    Raises:
        ValueError: for a negative seed.
    """
    return batch.environment.draw_starts(random_of(seed))


def _controllers(keys: Sequence[Key]) -> dict[str, ControllerSettings]:
    """Parse the short name of each controller once: values of computation are looked up in their file."""
    return {name: named_controller(name) for name in dict.fromkeys(name for name, _ in keys)}


def episodes_of(batch: Batch, keys: Sequence[Key]) -> Episodes:
    """Return what the simulation is given for these episodes, see `run_episodes`."""
    controllers = _controllers(keys)
    drawn = [_drawn(batch, controllers[name], seed) for name, seed in keys]
    weights = (np.asarray(reward.weights) for reward in (batch.loop.game.robot, batch.loop.game.human))
    return Episodes(
        np.array([start for start, _ in drawn], np.float32),
        np.array([np.nan_to_num(controllers[name].price) for name, _ in keys], np.float32),
        np.array([schedule for _, schedule in drawn], np.int32),
        *(np.broadcast_to(row, (len(keys), len(row))) for row in weights),
    )


def _drawn(
    batch: Batch, controller: ControllerSettings, seed: int
) -> tuple[Float[np.ndarray, "cars 4"], Int[np.ndarray, "steps"]]:
    """Draw as the environment at a reset, in its order: the start, and the models of a random controller."""
    random, steps, models = random_of(seed), batch.steps, batch.models
    states = batch.environment.draw_starts(random)
    scheduled = [models.index(name) for name in controller.draw(steps, random)] or [DECIDES]
    return states, np.array(scheduled)[np.minimum(np.arange(steps), len(scheduled) - 1)]


def run_episodes(batch: EpisodeBatch[Recorded], keys: Sequence[Key], mesh: Mesh | None = None) -> Recorded:
    """Simulate episodes; for ``mesh`` see `ms_highway.simulation.loop.simulate`.

    Raises:
        ValueError: without an episode, or for a negative seed.
    """
    if not keys:
        raise ValueError("there are no episodes to simulate; give one at least")
    kinds = {name: batch.kind(name) for name in dict.fromkeys(name for name, _ in keys)}
    places = dict[Hashable, list[int]]()
    for place, (name, _) in enumerate(keys):
        places.setdefault(kinds[name], []).append(place)
    parts = [batch.simulate([keys[place] for place in own], mesh) for own in places.values()]
    order = np.argsort(np.concatenate(list(places.values())))
    return jax.tree.map(lambda *part: np.concatenate(part)[order], *parts)


def simulated(comparison: Comparison, mesh: Mesh | None = None) -> pd.DataFrame:
    """Simulate a comparison and return all records, a row per step, in the comparison's order: `columns_simulated`.

    Args:
        comparison: what to simulate.
        mesh: see `ms_highway.simulation.loop.simulate`.

    Raises:
        ValueError: for anything unknown or impossible, and for costs that are to be measured.
    """
    tables = []
    for batch in [any_batch(comparison, scenario) for scenario in comparison.controllers]:
        names = comparison.controllers[batch.scenario.name]
        keys = sorted(batch.keys(), key=lambda key: names.index(key[0]))
        tables.append(tabulated(batch, keys, run_episodes(batch, keys, mesh)))
    return pd.concat(tables, ignore_index=True)


def tabulated(batch: EpisodeBatch[Recorded], keys: Sequence[Key], records: Recorded) -> pd.DataFrame:
    """Return a row per step: `columns_simulated`."""
    steps = batch.steps
    cells: dict[str, Any] = {
        "scenario": batch.scenario.name,
        "controller": np.repeat([name for name, _ in keys], steps),
        "seed": np.repeat([seed for _, seed in keys], steps),
        "step": np.tile(np.arange(steps), len(keys)),
        "model": np.array(batch.models)[batch.used(records)].ravel(),
        "reward": np.asarray(records.reward, float).ravel(),
        "collision": records.collision.ravel(),
        "counted_seconds": batch.counted(records).ravel(),
        "status": np.array(STATUSES)[records.status].ravel(),
    }
    gains = {name: np.full(records.reward.shape, np.nan) for name in known_models(batch.rungs)} | batch.gains(records)
    cells |= {gain_column(name): gain.ravel() for name, gain in gains.items()}
    for place, car in enumerate(CARS):
        states = np.asarray(records.states[:, :, place], float).reshape(-1, len(STATE))
        cells |= dict(zip(state_columns(car), states.T, strict=True))
    cells |= {name: column.ravel() for name, column in batch.details(records).items()}
    return pd.DataFrame(cells, columns=columns_simulated(batch.rungs, batch.comparison.crowd))


def summarised(batch: EpisodeBatch[Recorded], keys: Sequence[Key], records: Recorded) -> pd.DataFrame:
    """Return a row per episode.

    Columns: ``scenario``, ``controller`` and ``seed``; ``price``, that is lambda, empty where nothing is decided;
    ``reward`` and ``counted_seconds``, planning at T(M), as means over the steps; ``share_MODEL`` of the steps;
    ``collisions``, steps in which the robot collided; ``fallbacks``, steps whose plan failed. With several humans,
    MODEL is the dearest one in use, and `ms_highway.experiments.simulated_crowd.CrowdBatch.outcomes` are added.
    """
    used, prices = batch.used(records), {name: batch.price(name) for name in dict.fromkeys(name for name, _ in keys)}
    shares = {share_column(name): np.mean(used == number, axis=1) for number, name in enumerate(batch.models)}
    return pd.DataFrame(
        {
            "scenario": batch.scenario.name,
            "controller": [name for name, _ in keys],
            "seed": [seed for _, seed in keys],
            "price": [prices[name] for name, _ in keys],
            "reward": np.mean(records.reward, axis=1, dtype=float),
            "counted_seconds": np.mean(batch.counted(records), axis=1),
            **shares,
            "collisions": np.sum(records.collision, axis=1),
            "fallbacks": np.sum(np.isin(records.status, (PREVIOUS_PLAN, BRAKING)), axis=1),
            **batch.outcomes(records),
        }
    )
