"""Episodes of a comparison among several humans, computed many at a time: the same starts, humans and draws.

Nothing is measured, so that no plan is late: a budget counts planning at the seconds that are given, and deciding
as nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jax.sharding import Mesh
from jaxtyping import Bool, Float, Int

from ms_highway.control.fallback import WAY_OUT
from ms_highway.envs.crowd.base import CrowdEnv
from ms_highway.envs.crowd.controllers import CrowdSettings, crowd_controller_config, crowd_settings
from ms_highway.experiments.batch import EpisodeBatch, Key, checked_environment, configurations, random_of
from ms_highway.experiments.comparison import Comparison
from ms_highway.experiments.records import CROWD_COLUMNS
from ms_highway.game.crowd_scenario import REACHED
from ms_highway.metareasoning.crowd.rule import CrowdCosts, CrowdRule, highest_gains
from ms_highway.planning.crowd import RUNGS
from ms_highway.simulation.crowd import CrowdEpisodes, CrowdLoop, CrowdRecords, simulate_crowd
from ms_highway.simulation.records import DECIDES

__all__ = ["OUTCOMES", "CrowdBatch", "make_crowd_batch"]

OUTCOMES = ("success", "humans_turn", "humans_tom", "way_out")
"""Columns of episodes: success, how many humans are predicted by the dearer models, steps driven to keep a way out."""


@dataclass(frozen=True)
class CrowdBatch(EpisodeBatch[CrowdRecords]):
    """One scenario with several humans, ready to be simulated.

    Attributes:
        loop: what all episodes have in common, without a rule.
    """

    loop: CrowdLoop
    environment: CrowdEnv

    @property
    def models(self) -> list[str]:
        """See `EpisodeBatch.models`."""
        return list(RUNGS)

    @property
    def rungs(self) -> list[str]:
        """See `EpisodeBatch.rungs`."""
        return list(RUNGS)

    @property
    def plan_costs(self) -> CrowdCosts:
        """T of a plan, additive in the humans."""
        seconds = np.array([self.costs[name] for name in RUNGS])
        return CrowdCosts(float(seconds[0]), seconds - seconds[0])

    def kind(self, controller: str) -> str:
        """Every controller is simulated alone."""
        return controller

    def rule(self, controller: str) -> CrowdRule:
        """Return how a controller chooses models."""
        return _settings(controller).rule(self.plan_costs)

    def simulate(self, keys: Sequence[Key], mesh: Mesh | None = None) -> CrowdRecords:
        """See `EpisodeBatch.simulate`."""
        return simulate_crowd(replace(self.loop, rule=self.rule(keys[0][0])), self.episodes(keys), mesh)

    def episodes(self, keys: Sequence[Key]) -> CrowdEpisodes:
        """Return what the simulation is given for these episodes, drawn as the environment draws it."""
        drawn = [self.environment.draw_episode(random_of(seed)) for _, seed in keys]
        starts, weights, seeds = (np.array(part) for part in zip(*drawn, strict=True))
        schedules = np.full((len(keys), self.steps, self.loop.crowd.humans), DECIDES, np.int32)
        return CrowdEpisodes(starts.astype(np.float32), weights, seeds.astype(np.int32), schedules)

    def price(self, controller: str) -> float:
        """See `EpisodeBatch.price`."""
        return _settings(controller).price

    def used(self, records: CrowdRecords) -> Int[np.ndarray, "episodes steps"]:
        """See `EpisodeBatch.used`."""
        return np.asarray(records.rungs).max(axis=2)

    def counted(self, records: CrowdRecords) -> Float[np.ndarray, "episodes steps"]:
        """Return T of the assignment."""
        base, each = self.plan_costs
        return base + np.asarray(each)[records.rungs].sum(axis=2)

    def gains(self, records: CrowdRecords) -> dict[str, Float[np.ndarray, "episodes steps"]]:
        """Return the highest gain of each rung over all humans."""
        return dict(zip(RUNGS, np.moveaxis(highest_gains(np.asarray(records.gains)), -1, 0), strict=True))

    def details(self, records: CrowdRecords) -> dict[str, Any]:
        """Return `ms_highway.experiments.records.CROWD_COLUMNS`."""
        counts = (np.sum(np.equal(records.rungs, rung), axis=2) for rung in range(1, len(RUNGS)))
        return dict(zip(CROWD_COLUMNS, (*counts, self._success(records)), strict=True))

    def outcomes(self, records: CrowdRecords) -> dict[str, Any]:
        """Return `OUTCOMES`: means over the steps, and ``success``, 0 or 1."""
        *counts, success = self.details(records).values()
        means = [part.mean(axis=1) for part in (*counts, np.equal(records.status, WAY_OUT))]
        return dict(zip(OUTCOMES, (success[:, -1].astype(int), *means), strict=True))

    def _success(self, records: CrowdRecords) -> Bool[np.ndarray, "episodes steps"]:
        """Return whether the robot is in the target lane and has not collided so far."""
        aside = np.asarray(records.states)[:, :, 0, 1] - float(self.loop.crowd.game.scene.target_lane)
        return (np.abs(aside) < REACHED) & ~np.logical_or.accumulate(records.collision, axis=1)


def make_crowd_batch(comparison: Comparison, scenario: str) -> CrowdBatch:
    """Make one scenario with several humans ready to be simulated.

    Args:
        comparison: what is compared.
        scenario: its name.

    Raises:
        ValueError: for anything unknown or impossible; for costs that are to be measured, as nothing is timed here; and
            for environments that end early, do something of their own in a step, or tell the robot the true rewards.
    """
    configs = configurations(comparison, scenario)
    environment = checked_environment(scenario, configs[0], CrowdEnv)
    assert isinstance(environment, CrowdEnv)
    settings = environment.settings
    if settings.costs is None:
        remedy = "give seconds by model, of plans in which one human is predicted by it and the others naively"
        raise ValueError(f"costs are {comparison.costs!r}, and a simulation cannot measure plans; {remedy}")
    if settings.beliefs == "true":
        raise ValueError(
            f"{scenario} is configured with beliefs 'true'; a simulation's robot believes one reward; use `compare`"
        )
    loop = CrowdLoop(settings.crowd(environment.scenario), way_out=bool(configs[0]["way_out"]))
    return CrowdBatch(comparison, environment.scenario, settings.costs, environment, loop)


def _settings(controller: str) -> CrowdSettings:
    """Return the settings that a short name stands for."""
    return crowd_settings(crowd_controller_config(controller))
