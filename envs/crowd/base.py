"""The environment of a robot among several humans."""

from collections.abc import Mapping
from math import isnan, nan
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from ms_highway.control.crowd import CrowdDriver, CrowdStep, HumanDriver
from ms_highway.control.yielding import Unmoved
from ms_highway.envs.base import InteractionEnv
from ms_highway.envs.crowd.controllers import crowd_controller_config
from ms_highway.envs.crowd.graphics import CrowdViewer
from ms_highway.envs.crowd.settings import CrowdEnvSettings, merged_crowd
from ms_highway.game.crowd import human_game
from ms_highway.game.crowd_scenario import CROWD_PLANNING, REACHED, CrowdScenario, draw_crowd
from ms_highway.game.scenario import GRIP
from ms_highway.planning.compiled_crowd import CrowdCosts, measure_crowd_costs
from ms_highway.planning.crowd import RUNGS
from ms_highway.vehicle import BicycleVehicle, HumanVehicle, RobotVehicle

__all__ = ["CrowdEnv"]

LEFT_OUT = ("ladder", "influence", "warm_start")  # keys of the configuration that only environments with one human have


class CrowdEnv(InteractionEnv):
    """A robot among several humans, on the stage of a `ms_highway.game.crowd_scenario.CrowdScenario`.

    Every human plans for its own reward among all others, and believes that they keep their velocity, the robot too:
    `ms_highway.planning.crowd.predict_human`. Rewards are drawn for every episode: some humans yield more readily than
    others, and some hardly at all.

    The robot succeeds if it ends in the target lane, and never collides. A collision only costs reward.

    Configuration, beside that of `ms_highway.envs.base.InteractionEnv`, without its ``ladder``, ``influence`` and
    ``warm_start``:

    * ``humans``: their number, from 2 to 12.
    * ``beliefs``: what the robot takes the humans' rewards to be: ``"learned"``, that all have the reward that theirs
      are drawn around, ``"true"``, their own.
    * ``way_out``: whether the robot keeps a way out from humans who do not yield, see `ms_highway.planning.way_out`.
    * ``human_reward``: the reward that theirs are drawn around: ``"learned"``, ``"published"``, or weights by name.
    * ``controller``: chooses a model for every human, see `ms_highway.envs.crowd.controllers`.
    * ``costs``: T(M) of a plan in which one human is predicted by M and the others naively, in the forms of
      `InteractionEnv`; T of a plan is additive in the humans.
    * ``solver``: ``"damped_newton"``, which holds over horizons of seconds, or ``"gradient"``, the paper's.
    * ``semantics`` is ``"paper"``, and the agent cannot choose models: ``action`` is no ``HumanModelAction``.

    ``info`` holds after every step, beside what it holds there: ``rungs``, the name of every human's model;
    ``humans_turn`` and ``humans_tom``, how many are predicted by it;
    ``success``, whether the robot is in the target lane and has not collided so far, which at the end of the episode
    says whether it succeeded; ``distance_to_cones``, from the robot's front to the first cone ahead in its lane,
    infinite without one [m]; and ``human_status``, a status for each human. ``model`` is the dearest one in use.
    """

    scenario: ClassVar[CrowdScenario]
    viewer_class = CrowdViewer

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """The configuration of environments with one human, changed to suit several."""
        config = super().default_config()
        return {key: value for key, value in config.items() if key not in LEFT_OUT} | {
            "controller": {"type": "learned", "lambda": cls.scenario.prices[1]},
            "costs": "measured",
            "human_reward": "learned",
            "humans": cls.scenario.humans,
            "beliefs": "learned",
            "way_out": True,
            "solver": "damped_newton",
            "grip": GRIP,
            "horizon": CROWD_PLANNING.horizon,
            "screen_width": 1280,
            "screen_height": 420,
        }

    @classmethod
    def checked_config(
        cls, changes: Mapping[str, Any] | None, config: Mapping[str, Any] | None = None
    ) -> dict[str, Any]:
        """See `InteractionEnv.checked_config`."""
        return merged_crowd(cls.default_config() if config is None else config, changes)

    @staticmethod
    def controller_config(text: str) -> dict[str, Any]:
        """See `InteractionEnv.controller_config`."""
        return crowd_controller_config(text)

    def _read(self) -> None:
        self.settings = CrowdEnvSettings.read(self.config)
        self.game = self.settings.game(self.scenario)
        self._costs = self.settings.costs

    @property
    def cars(self) -> int:
        """Number of cars."""
        return 1 + self.settings.humans

    def _roles(self) -> list[type[BicycleVehicle]]:
        return [RobotVehicle, *[HumanVehicle] * self.settings.humans]

    def draw_starts(self, random: np.random.Generator) -> Float[np.ndarray, "cars 4"]:
        """Draw a start of every car, robot first, in SI units, and what every human drives for; see `draw_crowd`."""
        starts, self.weights = draw_crowd(self.scenario, self.settings.humans, random, self.game.human)
        return starts

    def draw_episode(
        self, random: np.random.Generator
    ) -> tuple[Float[np.ndarray, "cars 4"], Float[np.ndarray, "humans features"], int]:
        """Draw an episode as a reset does: `draw_starts`, what every human drives for, and the seed of its rule."""
        starts = self.draw_starts(random)
        return starts, self.weights, _draw_seed(random)

    def _reset(self) -> None:
        """Draw what the humans drive for, also where their starts are given, and start the episode."""
        self._initial_states = self._checked_states(self._initial_states)
        if self._initial_states is not None:
            self.draw_starts(self.np_random)
        super()._reset()
        self._collided = False

    def _drive(self, cars: list[Any], states: Float[np.ndarray, "cars 4"]) -> None:
        crowd = self.settings.crowd(self.scenario, self.weights)
        yielding = self._draw_yielding(crowd.humans)
        for number, (human, yields) in enumerate(zip(cars[1:], yielding, strict=True)):
            driver = HumanDriver(crowd, number) if yields is None else Unmoved(human_game(crowd, number), yields)
            human.drive_with(driver, [car for car in cars if car is not human])
        if self.drives_itself:
            cars[0].drive_with(self._controller(states), cars[1:])

    def _controller(self, states: Float[np.ndarray, "cars 4"]) -> CrowdDriver:
        controller, costs = self.settings.controller, CrowdCosts(nan, np.full(len(RUNGS), nan))
        if self._costs is not None or controller.budget is not None or not isnan(controller.price):
            seconds = self.costs(states)  # to be measured now, if at all, and not within a step
            costs = CrowdCosts(float(seconds[0]), seconds - seconds[0])
        crowd = self.settings.crowd(self.scenario, self.weights if self.settings.beliefs == "true" else None)
        rule, seed = controller.rule(costs), _draw_seed(self.np_random)
        return CrowdDriver(crowd, rule, controller.budget, seed, bool(self.config["way_out"]), controller.belief)

    def _measured_costs(self, states: Float[np.ndarray, "cars 4"]) -> list[float]:
        quantile = self.settings.controller.quantile
        costs = measure_crowd_costs(self.settings.crowd(self.scenario), states, quantile=quantile)
        return [float(costs.base + each) for each in np.asarray(costs.each)]

    @property
    def budget(self) -> float | None:
        """What planning and deciding may take in a step [s], None without a budget."""
        return self.settings.controller.budget

    @property
    def success(self) -> bool:
        """Whether the robot is in the target lane and has not collided so far."""
        target = float(self.game.scene.target_lane)
        return abs(self.robot.position[1] - target) < REACHED and not self._collided

    @property
    def distance_to_cones(self) -> float:
        """From the robot's front to the first cone ahead in its lane, infinite without one [m]."""
        x, y = self.robot.position
        within = float(self.game.scene.lane_width) / 2
        gaps = [
            cone.position[0] - x - (cone.LENGTH + self.robot.LENGTH) / 2
            for cone in self.road.objects
            if abs(cone.position[1] - y) < within and cone.position[0] > x
        ]
        return float(min(gaps, default=np.inf))

    def _simulate(self, action: Any = None) -> None:
        super()._simulate(action)
        self._collided |= self.collision

    def _record(self) -> dict[str, Any]:
        step = self.robot.last_step
        return super()._record() | {"rungs": step.rungs if isinstance(step, CrowdStep) else ()}

    def _info(self, obs: Any, action: Any = None) -> dict[str, Any]:
        """Describe the last step, see `CrowdEnv`."""
        info = super()._info(obs, action) | {"distance_to_cones": self.distance_to_cones}
        if self.steps == 0:
            return info
        info["success"] = self.success
        info["human_status"] = tuple(human.last_step and human.last_step.status for human in self.road.vehicles[1:])
        step = self.robot.last_step
        if isinstance(step, CrowdStep):
            info["rungs"] = step.rungs
            info |= {f"humans_{name}": step.rungs.count(name) for name in RUNGS[1:]}
            if self._costs is not None:  # T of the assignment
                base = self._costs[RUNGS[0]]
                info["counted_seconds"] = base + sum(self._costs[name] - base for name in step.rungs)
        return info


def _draw_seed(random: np.random.Generator) -> int:
    """Draw the seed of a rule."""
    return int(random.integers(np.iinfo(np.int32).max))
