"""What is compared: scenarios, controllers, seeds and the configuration that all environments have in common."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ms_highway.envs import ENVIRONMENTS, environment_id, is_crowd
from ms_highway.envs.settings import HUMAN_REWARDS
from ms_highway.experiments.records import columns
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
        costs: T(M) in the decisions: ``published``, ``measured``, or seconds by model; None for published, and among
            several humans measured.
        solver: how the robot improves its plans, see `ms_highway.optimization.solvers.optimize_controls`; None for
            ``gradient``, and among several humans ``damped_newton``.
        human_reward: what humans drive for: ``learned``, ``published``, weights by name, or None for what belongs to
            the semantics.
        ladder: names of the human models that switching chooses from, or ``best``; without it, the scenario's own.
        first_seed: of the first episode, from which all others count on.
        planning: what differs from the scenarios' own of the keys `ms_highway.envs.settings.PLANNING` and, among
            several humans, ``humans``, by key.
    """

    controllers: dict[str, list[str]]
    seeds: int = 30
    semantics: str = "paper"
    costs: Any = None
    solver: Solver | None = None
    human_reward: str | dict[str, float] | None = None
    ladder: Sequence[str] | None = None
    first_seed: int = 0
    planning: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Fill in what depends on the scenarios."""
        for name, with_one, with_several in (
            ("costs", "published", "measured"),
            ("solver", "gradient", "damped_newton"),
        ):
            if getattr(self, name) is None:
                object.__setattr__(self, name, with_several if self.crowd else with_one)

    @property
    def crowd(self) -> bool:
        """Whether the scenarios have several humans."""
        return any(map(is_crowd, self.controllers))

    def columns(self) -> list[str]:
        """Return the columns of the records, see `ms_highway.experiments.records.columns`."""
        return columns(self.rungs(), self.crowd)

    def rungs(self) -> list[str]:
        """Return the names of the models on the ladders of all scenarios, in any order."""
        ladders = (
            [ENVIRONMENTS[name].scenario.ladder for name in self.controllers] if self.ladder is None else [self.ladder]
        )
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
            ValueError: for an unknown scenario, controller or solver, impossible costs or weights, or scenarios with
                one human beside others with several.
        """
        if self.crowd and not all(map(is_crowd, self.controllers)):
            names = ", ".join(name for name in self.controllers if is_crowd(name))
            raise ValueError(f"{names} has several humans, the other scenarios one; compare them in a directory each")
        for scenario, controllers in self.controllers.items():
            for controller in controllers:
                self.config(scenario, controller)

    def config(self, scenario: str, controller: str) -> dict[str, Any]:
        """Return the whole configuration of the environment of a scenario and a controller.

        Raises:
            ValueError: as `check`.
        """
        environment_id(scenario)
        environment = ENVIRONMENTS[scenario]
        driver = environment.controller_config(controller)
        return environment.checked_config({**self.common_config(), "costs": self.costs, "controller": driver})

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
    whole = ENVIRONMENTS[scenario].checked_config(config)
    return round(whole["duration"] * whole["policy_frequency"])


def paper_controllers(scenario: str) -> list[str]:
    """Return the controllers that are compared by default: every rung, then switching at both lambdas.

    Raises:
        ValueError: for an unknown scenario.
    """
    environment_id(scenario)
    choice = ENVIRONMENTS[scenario].scenario
    return [*rung_names(choice.ladder), *(f"switching:{price:g}" for price in choice.prices)]
