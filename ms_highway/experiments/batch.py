"""Define what simulated scenarios with one human and with several have in common: their episodes, and what tables say.

`ms_highway.experiments.simulated` simulates and tabulates them.
"""

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np
from gymnasium.utils import seeding
from jax.sharding import Mesh
from jaxtyping import Float, Int

from ms_highway.envs import ENVIRONMENTS
from ms_highway.envs.base import InteractionEnv
from ms_highway.experiments.comparison import Comparison
from ms_highway.game.scenario import Scenario
from ms_highway.simulation.crowd import CrowdRecords
from ms_highway.simulation.records import Records

__all__ = ["EpisodeBatch", "Key", "Recorded", "checked_environment", "configurations", "random_of"]

Key: TypeAlias = tuple[str, int]
"""Which episode of a scenario: its controller's short name, and its seed."""

Recorded = TypeVar("Recorded", Records, CrowdRecords)

OVERRIDABLE = {"scenario", "default_config", "configure", "draw_starts", "define_spaces", "render", "viewer_class"}
"""Names that a scenario's environment may override; a simulation calls these and no others."""


@dataclass(frozen=True)
class EpisodeBatch(ABC, Generic[Recorded]):
    """One scenario of a comparison, ready to be simulated.

    Attributes:
        comparison: what is compared.
        scenario: where.
        costs: T(M) by model [s], as far as it is known.
        environment: what is simulated; it draws the starts.
    """

    comparison: Comparison
    scenario: Scenario
    costs: Mapping[str, float]
    environment: InteractionEnv

    @property
    @abstractmethod
    def models(self) -> list[str]:
        """Names of the models, in the order of their numbers."""

    @property
    @abstractmethod
    def rungs(self) -> list[str]:
        """Names of the models to choose from."""

    @property
    def size(self) -> int:
        """The number of all episodes."""
        return self.comparison.seeds * len(self.comparison.controllers[self.scenario.name])

    @property
    def steps(self) -> int:
        """The length of an episode."""
        return self.environment.episode_steps

    def keys(self, first: int = 0, last: int | None = None) -> list[Key]:
        """Episodes from the first to before the last, seed by seed, so that all parts hold controllers alike."""
        controllers = self.comparison.controllers[self.scenario.name]
        places = range(self.size)[first:last]
        return [
            (controllers[place % len(controllers)], self.comparison.first_seed + place // len(controllers))
            for place in places
        ]

    @abstractmethod
    def kind(self, controller: str) -> Hashable:
        """Return what controllers have in common whose episodes are simulated together."""

    @abstractmethod
    def simulate(self, keys: Sequence[Key], mesh: Mesh | None = None) -> Recorded:
        """Simulate episodes of controllers of one kind."""

    @abstractmethod
    def price(self, controller: str) -> float:
        """Return a controller's lambda, NaN where nothing is decided at one."""

    @abstractmethod
    def used(self, records: Recorded) -> Int[np.ndarray, "episodes steps"]:
        """Return the number of the model in use, the dearest one where there are several."""

    @abstractmethod
    def counted(self, records: Recorded) -> Float[np.ndarray, "episodes steps"]:
        """Return what planning counts [s], NaN where it is not known."""

    @abstractmethod
    def gains(self, records: Recorded) -> dict[str, Float[np.ndarray, "episodes steps"]]:
        """Return the estimated gain of each model, NaN where none was estimated."""

    def details(self, records: Recorded) -> dict[str, Any]:
        """Return further columns of steps, arrays [episodes, steps] by name."""
        return {}

    def outcomes(self, records: Recorded) -> dict[str, Any]:
        """Return further columns of episodes, arrays [episodes] by name."""
        return {}


def configurations(comparison: Comparison, scenario: str) -> list[dict[str, Any]]:
    """Return the whole configuration of a scenario's environment with each of its controllers.

    Raises:
        ValueError: for anything unknown or impossible, for what is not simulated, and where there are no controllers.
    """
    controllers = comparison.controllers.get(scenario, [])
    if not controllers:
        raise ValueError(f"the comparison has no controllers for {scenario!r}; name one at least")
    configs = [comparison.config(scenario, controller) for controller in controllers]
    for name, config in zip(controllers, configs, strict=True):
        if config["yielding"] != "usual" or config["controller"].get("belief"):
            told = f"{scenario} has yielding {config['yielding']!r} and the controller {name!r}"
            raise ValueError(f"{told}; a simulation has the usual humans and no beliefs; use `compare`")
    return configs


def checked_environment(scenario: str, config: Mapping[str, Any], base: type[InteractionEnv]) -> InteractionEnv:
    """Return the environment of a scenario, which does nothing in a step that a simulation does not.

    Args:
        scenario: its name.
        config: its whole configuration.
        base: class that does what a simulation does.

    Raises:
        ValueError: for environments that end early, or do something of their own in a step.
    """
    if config["terminate_on_collision"]:
        raise ValueError(f"{scenario} is configured with terminate_on_collision True; a simulation runs all steps")
    kind = ENVIRONMENTS[scenario]
    classes = kind.__mro__[: kind.__mro__.index(base)]
    own = {name for one in classes for name in vars(one) if hasattr(base, name) and name[:2] != "__"}
    if own - OVERRIDABLE:
        reason = f"{kind.__name__} has its own {', '.join(sorted(own - OVERRIDABLE))}, which a simulation does not call"
        raise ValueError(f"{reason}; change its scenario, its game (in `configure`) or `draw_starts`, or use `compare`")
    return kind(dict(config))


def random_of(seed: int) -> np.random.Generator:
    """Return the random numbers that the environment draws an episode from.

    Raises:
        ValueError: for a negative seed.
    """
    if seed < 0:
        raise ValueError(f"the seed is {seed}; it must not be negative")
    return seeding.np_random(seed)[0]
