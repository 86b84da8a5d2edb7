"""The settings of the environments with several humans: what their configuration says, checked once."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ms_highway.envs.checks import is_whole
from ms_highway.envs.merging import changed
from ms_highway.envs.crowd.controllers import CrowdSettings, crowd_settings
from ms_highway.envs.settings import ACTION_DEFAULTS, read_costs, read_human_weights, read_limit, read_planning
from ms_highway.game.crowd import Crowd
from ms_highway.game.crowd_scenario import CROWD_LIMIT, HUMANS, CrowdScenario, crowd_game
from ms_highway.game.game import Game
from ms_highway.game.planning_settings import PlanningSettings, gradient_steps
from ms_highway.optimization.solvers import Solver
from ms_highway.planning.crowd import RUNGS
from ms_highway.planning.human_models import HumanModel, ladder

__all__ = ["BELIEFS", "CrowdEnvSettings", "merged_crowd"]

BELIEFS = ("learned", "true")
"""What the robot believes the humans' rewards to be: the one that they are drawn around, or their own."""

CHOICES: dict[str, tuple[str | None, ...]] = {
    "semantics": ("paper",),
    "solver": ("damped_newton", "gradient"),
    "beliefs": BELIEFS,
}


@dataclass(frozen=True)
class CrowdEnvSettings:
    """Checked settings of an `ms_highway.envs.crowd.base.CrowdEnv`, with open choices filled in.

    Attributes:
        humans: their number.
        controller: drives the robot, unless the agent does.
        costs: T(M) by model [s], of a plan in which one human is predicted by it; None where it is to be measured.
        beliefs: see `BELIEFS`.
        human_weights: of the reward that the humans' rewards are drawn around, by name.
        control_limit, grip, solver, planning: see `ms_highway.envs.settings.Settings`.
    """

    humans: int
    controller: CrowdSettings
    costs: Mapping[str, float] | None
    beliefs: str
    human_weights: Mapping[str, float]
    control_limit: tuple[float, float] | None
    grip: float
    solver: Solver
    planning: PlanningSettings

    @classmethod
    def read(cls, config: Mapping[str, Any]) -> "CrowdEnvSettings":
        """Read a whole configuration, of which `ms_highway.envs.configuration.changed` has checked the rest.

        Raises:
            ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
        """
        humans, (fewest, most), planning = config["humans"], HUMANS, read_planning(config)
        if not is_whole(humans) or not fewest <= humans <= most:
            raise ValueError(f"config['humans'] is {humans!r}; it must be a whole number from {fewest} to {most}")
        return cls(
            humans=int(humans),
            controller=crowd_settings(config["controller"]),
            costs=read_costs(config["costs"], ladder(RUNGS), (), gradient_steps(planning)[0]),
            beliefs=config["beliefs"],
            human_weights=read_human_weights(config["human_reward"], "learned"),
            control_limit=read_limit(config["control_limit"], CROWD_LIMIT),
            grip=float(config["grip"]),
            solver=config["solver"],
            planning=planning,
        )

    @property
    def models(self) -> tuple[HumanModel, ...]:
        """The models that humans can be predicted by, cheapest first."""
        return ladder(RUNGS)

    def game(self, scenario: CrowdScenario) -> Game:
        """Build the game of a scenario with any one of the humans."""
        return self.crowd(scenario).game

    def crowd(self, scenario: CrowdScenario, weights: Float[np.ndarray, "humans features"] | None = None) -> Crowd:
        """Build the game of a scenario; without weights, all humans have the reward that theirs are drawn around."""
        return crowd_game(
            scenario,
            self.humans,
            weights,
            solver=self.solver,
            control_limit=self.control_limit,
            grip=self.grip,
            planning=self.planning,
            human_driving=self.human_weights,
        )


def merged_crowd(defaults: Mapping[str, Any], changes: Mapping[str, Any] | None) -> dict[str, Any]:
    """Apply changes to the configuration of an `ms_highway.envs.crowd.base.CrowdEnv`, and check all of it.

    Raises:
        ValueError: naming the key, the value and the remedy, for anything unknown or impossible.
    """
    config = changed(defaults, changes, CHOICES)
    if config["action"]["type"] == "HumanModelAction":
        remedy = "say 'Autopilot', and the controller chooses a model for every human"
        raise ValueError(f"config['action'] is of type 'HumanModelAction', which is for one human; {remedy}")
    config["action"] = {**ACTION_DEFAULTS.get(config["action"]["type"], {}), **config["action"]}
    CrowdEnvSettings.read(config)
    return config
