"""What is compared: scenarios, controllers, seeds and the configuration that all environments have in common."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ms_highway.envs import ENVIRONMENTS, SCENARIOS, environment_id
from ms_highway.envs.settings import HUMAN_REWARDS, merged
from ms_highway.envs.short_names import controller_config
from ms_highway.optimization.solvers import Solver
from ms_highway.planning.human_models import rung_names

__all__ = ["Comparison", "episode_steps", "paper_controllers"]


@dataclass(frozen=True)
class Comparison:
    """What is compared.

    Attributes:
        controllers: short names of the controllers of each scenario, by scenario.
        seeds: number of episodes of each controller; episode k is seeded with k more than the first.
        semantics: ``paper`` or ``released``.
        costs: T(M) in the decisions: ``published``, ``measured``, or seconds by model.
        solver: how the robot improves its plans, ``gradient`` or ``newton``, see
            `ms_highway.optimization.solvers.optimize_controls`.
        human_reward: what humans drive for: ``learned``, ``published``, weights by name, or None for what belongs to
            the semantics.
        ladder: names of the human models that switching chooses from, or ``best``; without it, the scenario's own.
        first_seed: of the first episode, from which all others count on.
        planning: what differs from the scenarios' own of the keys `ms_highway.envs.settings.PLANNING`, by key.
    """

    controllers: dict[str, list[str]]
    seeds: int = 30
    semantics: str = "paper"
    costs: Any = "published"
    solver: Solver = "gradient"
    human_reward: str | dict[str, float] | None = None
    ladder: Sequence[str] | None = None
    first_seed: int = 0
    planning: Mapping[str, Any] = field(default_factory=dict)

    def rungs(self) -> list[str]:
        """Return the names of the models on the ladders of all scenarios, in any order."""
        ladders = [SCENARIOS[name].ladder for name in self.controllers] if self.ladder is None else [self.ladder]
        return [name for names in ladders for name in rung_names(names)]

    def episodes(self) -> Iterator[tuple[str, str, int]]:
        """Yield every (scenario, controller, seed)."""
        for scenario, controllers in self.controllers.items():
            for controller in controllers:
                for seed in range(self.first_seed, self.first_seed + self.seeds):
                    yield scenario, controller, seed

    def check(self) -> None:
        """Check everything before anything is run or written.

        Raises:
            ValueError: for an unknown scenario, controller or solver, or impossible costs or weights.
        """
        for scenario, controllers in self.controllers.items():
            for controller in controllers:
                self.config(scenario, controller)

    def config(self, scenario: str, controller: str) -> dict[str, Any]:
        """Return the whole configuration of the environment of a scenario and a controller.

        Raises:
            ValueError: as `check`.
        """
        environment_id(scenario)
        changes = {**self.common_config(), "costs": self.costs, "controller": controller_config(controller)}
        return merged(ENVIRONMENTS[scenario].default_config(), changes)

    def steps(self, scenario: str) -> int:
        """Return the length of a scenario's episodes.

        Raises:
            ValueError: as `check`.
        """
        return episode_steps(scenario, self.common_config())

    def common_config(self) -> dict[str, Any]:
        """Return the configuration that all environments have in common."""
        reward = HUMAN_REWARDS[self.semantics] if self.human_reward is None else self.human_reward
        config = {"semantics": self.semantics, "solver": self.solver, "human_reward": reward}
        return {**config, **self.planning} | ({} if self.ladder is None else {"ladder": rung_names(self.ladder)})


def episode_steps(scenario: str, config: Mapping[str, Any]) -> int:
    """Return the number of steps in an episode of a scenario that nothing ends early.

    Raises:
        ValueError: for an unknown scenario or an impossible configuration.
    """
    environment_id(scenario)
    whole = merged(ENVIRONMENTS[scenario].default_config(), config)
    return round(whole["duration"] * whole["policy_frequency"])


def paper_controllers(scenario: str) -> list[str]:
    """Return the controllers that the paper compares: every rung, then switching, aggressive and conservative.

    Raises:
        ValueError: for an unknown scenario.
    """
    environment_id(scenario)
    choice = SCENARIOS[scenario]
    return [*rung_names(choice.ladder), *(f"switching:{price:g}" for price in choice.prices)]
