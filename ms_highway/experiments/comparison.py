"""Define a comparison by its scenarios, controllers, seeds and the common configuration of all environments."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import TypeAlias

from ms_highway.envs import ENVIRONMENTS, scenario_name
from ms_highway.envs.registry import robot_config
from ms_highway.envs.settings import HUMAN_REWARDS
from ms_highway.experiments.records import columns
from ms_highway.planning.ladders import rung_names

EpisodeKey: TypeAlias = tuple[str, str, int]
"""An episode: its scenario, the short name of its controller, and its seed."""

USUAL = ("semantics", "solver", "human_reward", "costs")
"""Keys of the configuration that results always record, unless the scenarios' defaults differ."""


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
            ValueError: for an unknown scenario or controller, an impossible configuration, or a controller that does
                not fit it.
        """
        named = {scenario_name(scenario): controllers for scenario, controllers in self.controllers.items()}
        object.__setattr__(self, "controllers", named)
        for scenario, controllers in named.items():
            for controller in controllers:
                self.environment_config(scenario, controller)

    def episodes(self) -> Iterator[EpisodeKey]:
        """Yield every (scenario, controller, seed)."""
        seeds = range(self.first_seed, self.first_seed + self.seeds)
        for scenario, controllers in self.controllers.items():
            yield from product([scenario], controllers, seeds)

    def environment_config(self, scenario: str, controller: str) -> dict:
        """Return the whole configuration of the environment of a scenario and a controller.

        Raises:
            ValueError: for the same reasons as `Comparison`.
        """
        return ENVIRONMENTS[scenario_name(scenario)].checked_config({**self.config, **robot_config(controller)})

    def common_config(self) -> dict:
        """Return the common configuration, under which results are resumed: `USUAL` and all keys of ``config``."""
        defaults = [{**ENVIRONMENTS[name].default_config(), **self.config} for name in self.controllers]
        for config in defaults:
            config["human_reward"] = config["human_reward"] or HUMAN_REWARDS[config["semantics"]]
        first = defaults[0]
        usual = {key: first[key] for key in USUAL if all(first[key] == each[key] for each in defaults)}
        ladder = {"ladder": rung_names(self.config["ladder"])} if "ladder" in self.config else {}
        return {**usual, **self.config, **ladder}

    def columns(self) -> list[str]:
        """Return the columns of the records, see `ms_highway.experiments.records.columns`."""
        rungs, above = list[str](), None
        for name in self.controllers:
            scenario = ENVIRONMENTS[name].scenario
            own = rung_names(self.config.get("ladder", scenario.ladder))
            rungs += own
            if scenario.streams:
                above = [*(above or []), *own[1:]]
        return columns(rungs, above)


def paper_controllers(scenario: str) -> list[str]:
    """Return the controllers that are compared by default: every rung, then switching at both lambdas.

    Raises:
        ValueError: for an unknown scenario.
    """
    choice = ENVIRONMENTS[scenario_name(scenario)].scenario
    return [*rung_names(choice.ladder), *(f"switching:{price:g}" for price in choice.prices)]
