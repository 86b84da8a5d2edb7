"""Episodes of a comparison, computed many at a time rather than in the environments: the same starts, the same records.

`ms_highway.experiments.runner` runs the same `Comparison` in the environments.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
import pandas as pd
from gymnasium.utils import seeding
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ms_highway.control.fallback import STATUSES
from ms_highway.envs import ENVIRONMENTS, two_player_scenario
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.controllers import ChoosingSettings, ControllerSettings, SwitchingSettings
from ms_highway.envs.settings import Settings
from ms_highway.envs.short_names import named_controller
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import CARS, MEASURED, STATE, columns, gain_column, share_column, state_columns
from ms_highway.game.scenario import Scenario, Semantics
from ms_highway.planning.human_models import human_model, known_models
from ms_highway.simulation.devices import usual_chunk
from ms_highway.simulation.loop import simulate
from ms_highway.simulation.records import DECIDES, Episodes, Loop, Records

__all__ = [
    "Batch",
    "Key",
    "columns_simulated",
    "episodes_of",
    "make_batch",
    "run_episodes",
    "simulated",
    "start",
    "summarised",
    "tabulated",
]

Key = tuple[str, int]
"""Which episode of a scenario: its controller's short name, and its seed."""

NOBODY = SwitchingSettings(0.0)
"""Stands in for a rule where models are scheduled."""

OVERRIDABLE = {"scenario", "default_config", "configure", "draw_starts", "define_spaces", "render"}
"""Names that a scenario's environment may override; a simulation calls these and no others."""


def columns_simulated(rungs: Iterable[str] = ()) -> list[str]:
    """Return the columns of a simulated step, `ms_highway.experiments.records.columns` without the measured times."""
    return [name for name in columns(rungs) if name not in MEASURED]


@dataclass(frozen=True)
class Batch:
    """One scenario of a comparison, ready to be simulated.

    Attributes:
        comparison: what is compared.
        scenario: where.
        loop: what all episodes have in common.
        costs: T(M) by model [s], as far as it is known.
        environment: what is simulated; it draws the starts.
    """

    comparison: Comparison
    scenario: Scenario
    loop: Loop
    costs: dict[str, float]
    environment: InteractionEnv

    @property
    def semantics(self) -> Semantics:
        """What drives."""
        return self.environment.settings.semantics

    @property
    def models(self) -> list[str]:
        """Names of the models, in the order of their numbers."""
        return [model.name for model in self.loop.models]

    @property
    def size(self) -> int:
        """The number of all episodes."""
        return self.comparison.seeds * len(self.comparison.controllers[self.scenario.name])

    @property
    def steps(self) -> int:
        """The length of an episode."""
        return self.environment.episode_steps

    def loop_with(self, chooses: ChoosingSettings) -> Loop:
        """Return the loop of episodes whose models a controller chooses."""
        rule = chooses.rule(self.loop.rule.ladder, np.asarray(self.loop.rule.costs), self.semantics)
        return replace(self.loop, rule=rule)

    def keys(self, first: int = 0, last: int | None = None) -> list[Key]:
        """Episodes from the first to before the last, seed by seed, so that all parts hold controllers alike."""
        controllers = self.comparison.controllers[self.scenario.name]
        places = range(self.size)[first:last]
        return [
            (controllers[place % len(controllers)], self.comparison.first_seed + place // len(controllers))
            for place in places
        ]


def make_batch(comparison: Comparison, scenario: str) -> Batch:
    """Make one scenario of a comparison ready to be simulated.

    Args:
        comparison: what is compared.
        scenario: its name.

    Raises:
        ValueError: for anything unknown or impossible; for costs that are to be measured, as nothing is timed here; and
            for environments that end early, or do something of their own in a step.
    """
    two_player_scenario(scenario)
    controllers = comparison.controllers.get(scenario, [])
    if not controllers:
        raise ValueError(f"the comparison has no controllers for {scenario!r}; name one at least")
    configs = [comparison.config(scenario, controller) for controller in controllers]
    settings = [Settings.read(config) for config in configs]
    costs = settings[0].costs
    if costs is None:
        remedy = "say 'published', or give seconds by model"
        raise ValueError(f"costs are {comparison.costs!r}, and a simulation cannot measure plans; {remedy}")
    config = configs[0]
    if config["terminate_on_collision"]:
        raise ValueError(f"{scenario} is configured with terminate_on_collision True; a simulation runs all steps")
    kind = ENVIRONMENTS[scenario]
    classes = kind.__mro__[: kind.__mro__.index(InteractionEnv)]
    own = {name for one in classes for name in vars(one) if hasattr(InteractionEnv, name) and name[:2] != "__"}
    if own - OVERRIDABLE:
        reason = f"{kind.__name__} has its own {', '.join(sorted(own - OVERRIDABLE))}, which a simulation does not call"
        raise ValueError(f"{reason}; change its scenario, its game (in `configure`) or `draw_starts`, or use `compare`")
    environment = kind(config)
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
    return Batch(comparison, environment.scenario, loop, known, environment)


def start(batch: Batch, seed: int) -> Float[np.ndarray, "cars 4"]:
    """Return the start that the environment draws for a seed, in SI units.

    Raises:
        ValueError: for a negative seed.
    """
    return batch.environment.draw_starts(_random(seed))


def _random(seed: int) -> np.random.Generator:
    """Return the random numbers that the environment draws an episode from."""
    if seed < 0:
        raise ValueError(f"the seed is {seed}; it must not be negative")
    return seeding.np_random(seed)[0]


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
    random, steps, models = _random(seed), batch.steps, batch.models
    states = batch.environment.draw_starts(random)
    scheduled = [models.index(name) for name in controller.draw(steps, random)] or [DECIDES]
    return states, np.array(scheduled)[np.minimum(np.arange(steps), len(scheduled) - 1)]


def run_episodes(batch: Batch, keys: Sequence[Key], mesh: Mesh | None = None) -> Records:
    """Simulate episodes; for ``mesh`` see `ms_highway.simulation.loop.simulate`.

    Raises:
        ValueError: without an episode, or for a negative seed.
    """
    controllers, places = _controllers(keys), dict[ChoosingSettings, list[int]]()
    for place, (name, _) in enumerate(keys):
        settings = controllers[name]
        chooses = replace(settings, price=0.0) if isinstance(settings, ChoosingSettings) else NOBODY
        places.setdefault(chooses, []).append(place)
    parts = [
        simulate(batch.loop_with(chooses), episodes_of(batch, [keys[place] for place in own]), mesh)
        for chooses, own in (places or {NOBODY: []}).items()
    ]
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
    for batch in [make_batch(comparison, scenario) for scenario in comparison.controllers]:
        names = comparison.controllers[batch.scenario.name]
        keys = sorted(batch.keys(), key=lambda key: names.index(key[0]))
        tables.append(tabulated(batch, keys, run_episodes(batch, keys, mesh)))
    return pd.concat(tables, ignore_index=True)


def tabulated(batch: Batch, keys: Sequence[Key], records: Records) -> pd.DataFrame:
    """Return a row per step: `columns_simulated`."""
    steps = batch.steps
    models, costs = np.array(batch.models), _costs(batch)
    cells: dict[str, Any] = {
        "scenario": batch.scenario.name,
        "controller": np.repeat([name for name, _ in keys], steps),
        "seed": np.repeat([seed for _, seed in keys], steps),
        "step": np.tile(np.arange(steps), len(keys)),
        "model": models[records.model].ravel(),
        "reward": np.asarray(records.reward, float).ravel(),
        "collision": records.collision.ravel(),
        "counted_seconds": costs[records.model].ravel(),
        "status": np.array(STATUSES)[records.status].ravel(),
    }
    cells |= {gain_column(name): gain.ravel() for name, gain in _gains(batch, records).items()}
    for place, car in enumerate(CARS):
        states = np.asarray(records.states[:, :, place], float).reshape(-1, len(STATE))
        cells |= dict(zip(state_columns(car), states.T, strict=True))
    return pd.DataFrame(cells, columns=columns_simulated(model.name for model in batch.loop.rule.ladder))


def _costs(batch: Batch) -> Float[np.ndarray, "models"]:
    """T(M) by number of the model [s], NaN where it is not known."""
    return np.array([batch.costs.get(name, np.nan) for name in batch.models])


def _gains(batch: Batch, records: Records) -> dict[str, Float[np.ndarray, "episodes steps"]]:
    """Estimated gain of switching to each model."""
    rungs = [model.name for model in batch.loop.rule.ladder]
    gains = {name: np.full(records.reward.shape, np.nan) for name in known_models(rungs)}
    return gains | dict(zip(rungs, np.moveaxis(np.asarray(records.gains), -1, 0), strict=True))


def summarised(batch: Batch, keys: Sequence[Key], records: Records) -> pd.DataFrame:
    """Return a row per episode.

    Columns: ``scenario``, ``controller`` and ``seed``; ``price``, that is lambda, empty where nothing is decided;
    ``reward`` and ``counted_seconds``, planning at T(M), as means over the steps; ``share_MODEL`` of the steps;
    ``collisions``, steps in which the robot collided; ``fallbacks``, steps whose plan failed.
    """
    controllers = _controllers(keys)
    shares = {share_column(name): np.mean(records.model == number, axis=1) for number, name in enumerate(batch.models)}
    return pd.DataFrame(
        {
            "scenario": batch.scenario.name,
            "controller": [name for name, _ in keys],
            "seed": [seed for _, seed in keys],
            "price": [controllers[name].price for name, _ in keys],
            "reward": np.mean(records.reward, axis=1, dtype=float),
            "counted_seconds": np.mean(_costs(batch)[records.model], axis=1),
            **shares,
            "collisions": np.sum(records.collision, axis=1),
            "fallbacks": np.sum(np.not_equal(records.status, STATUSES.index("planned")), axis=1),
        }
    )
