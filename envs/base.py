"""The environment that the scenarios share: a road, a human, a robot, and who drives it."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax
import numpy as np
from gymnasium import spaces
from highway_env.envs.common.action import ActionType, action_factory
from highway_env.envs.common.observation import observation_factory
from highway_env.road.road import Road
from jaxtyping import Float

from ms_highway.control.controller import Controller
from ms_highway.control.fixed import FixedModel, ScheduledModels
from ms_highway.control.switching import ModelSwitching
from ms_highway.control.yielding import Unmoved
from ms_highway.envs.actions import Autopilot, HumanModelAction
from ms_highway.envs.controllers import ChoosingSettings, FixedSettings, controller_settings
from ms_highway.envs.graphics import InteractionViewer
from ms_highway.envs.observations import CarStates, finite
from ms_highway.envs.settings import Settings, merged
from ms_highway.envs.short_names import controller_config
from ms_highway.envs.stage import Cone, StageEnv, Timing, straight_road
from ms_highway.game.game import swap_roles
from ms_highway.game.planning_settings import PAPER_PLANNING
from ms_highway.game.reward import COMPUTATION
from ms_highway.game.scenario import TIME_STEP, Scenario, draw_starts
from ms_highway.planning.compiled_plans import measure_costs
from ms_highway.planning.human_models import HumanModel, Naive, human_model
from ms_highway.vehicle import BicycleVehicle, HumanVehicle, PlanningVehicle, RobotVehicle, ScriptedVehicle, states_of

__all__ = ["InteractionEnv"]


class InteractionEnv(StageEnv):
    """A robot among human drivers, on the stage of a `Scenario`.

    Configuration, beside highway-env's own:

    * ``action``: who drives. ``{"type": "Autopilot"}``: the robot's controller; ``{"type": "HumanModelAction",
      "lambda": 0.1}``: the agent chooses the human model; ``{"type": "ContinuousAction"}``: the agent drives, by
      accelerations of +-5 m/s^2 and front-wheel angles of +-0.1 rad unless ``acceleration_range`` and
      ``steering_range`` say otherwise (highway-env's own +-45 degrees spin a car of 20 m/s at the first step).
    * ``controller``: ``{"type": "learned", "lambda": 1.0}``, a learned value of computation chooses the model of each
      step, with ``"values"``, ``"shipped"`` (default) or a file of ``ms-highway values learn``; ``{"type": "switching",
      "lambda": 0.1}``, the paper's Algorithm 1 does; ``{"type": "fixed", "model": "tom"}``; ``{"type": "schedule",
      "models": ["tom", "tom", "naive"]}``, a model per step, the last one kept; ``{"type": "period", "models": ["tom",
      "naive"]}``, the same repeated; or ``{"type": "random", "shares": {"naive": 0.7, "tom": 0.3}}``, a model per step
      that is drawn when the episode starts. Any of them with ``"belief": True`` infers from what the human does which
      model predicts it (`ms_highway.planning.hypotheses`), and counts on no response that the human does not show.
    * ``ladder``: human models to choose from, cheapest first, also ``tom@8+warm`` (`ms_highway.planning.effort`), or
      ``"best"``.
    * ``costs``: T(M): ``"published"``, ``"measured"`` on this machine, or seconds by model (``tom@8`` in proportion).
    * ``semantics``: ``"paper"`` or ``"released"``, see `ms_highway.game.scenario.build_game`.
    * ``human_reward``: what humans drive for, in the world and in the robot's models of them: ``"learned"`` from
      demonstrations; ``"published"``; weights by name, of `ms_highway.game.reward.weight_names`; None for what
      belongs to the semantics (learned and published). What a human is after in the scenario beyond driving, such as
      its lane, stays unless weights name it. A learned reward has no weight of ``collision``, which would change
      nothing: it is an indicator, and humans climb by gradients.
    * ``influence``: ``"damped"``, ``"exact"``, or None for what belongs to the semantics (damped and exact).
    * ``control_limit``: bounds (omega, acceleration) on plans; ``"unlimited"``; or None for what belongs to the
      semantics: `ms_highway.game.scenario.PHYSICAL_LIMIT` in paper semantics, unlimited in released semantics.
    * ``grip``: the total acceleration that tyres hold, of steering and speeding up or braking together [m/s^2], such as
      `ms_highway.game.scenario.GRIP`: plans are cut down to it and what is executed keeps to it, without reversing;
      None (default) sets no such limit, as in the paper. It does not apply where the agent drives.
    * ``solver``: how the robot improves its plans under naive and turn: ``"gradient"``, the paper's, or ``"newton"``.
    * ``warm_start``: whether all robot's plans start from the rest of the last plan rather than from zero controls.
    * ``horizon``, ``time_step``, ``iterations``, ``step_size``: how far ahead, how often and by which gradient steps
      robot and human plan, see `ms_highway.game.planning_settings.PlanningSettings`. Where iterations and step
      size are None, what suits the horizon is chosen; steps that are longer than
      `ms_highway.game.planning_settings.longest_step` are warned of.
    * ``yielding``: what humans do beside the robot: ``"usual"``, plan for their reward; ``"never"`` yield, but keep
      their velocity; ``"always"``, make room for it (`ms_highway.control.yielding.Unmoved`); or ``"mixed"``, each of
      them never or always, drawn when the episode starts.
    * ``duration``: length of an episode [s]; ``terminate_on_collision``: whether a collision ends it.

    The reward is the robot's r_R after the step. A collision only costs reward, as in the paper: cars neither push
    each other nor stop, and ``info["collision_effect"]`` says so. With a controller's ``belief``, ``info["belief"]``
    holds the probability of every model for every human, an array [humans, 4] in the order of
    `ms_highway.planning.road.settings.RUNGS`: naive, idm, turn, tom.
    """

    scenario: ClassVar[Scenario]
    viewer_class: ClassVar[type[InteractionViewer]] = InteractionViewer
    settings: Any  # `Settings`; among several humans others
    action_space: spaces.Space | None
    viewer: InteractionViewer | None

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """highway-env's configuration with the scenario's own."""
        return super().default_config() | {
            "observation": {"type": "CarStates"},
            "action": {"type": "Autopilot"},
            "controller": {"type": "switching", "lambda": cls.scenario.prices[1]},
            "ladder": list(cls.scenario.ladder),
            "costs": "published",
            "semantics": "paper",
            "human_reward": None,
            "influence": None,
            "control_limit": None,
            "grip": None,
            "solver": "gradient",
            "warm_start": False,
            "yielding": "usual",
            "horizon": PAPER_PLANNING.horizon,
            "time_step": PAPER_PLANNING.time_step,
            "iterations": PAPER_PLANNING.iterations,
            "step_size": PAPER_PLANNING.step_size,
            "duration": cls.scenario.steps * TIME_STEP,
            "terminate_on_collision": False,
            "simulation_frequency": 10,
            "policy_frequency": 10,
            "screen_width": 960,
            "screen_height": 352,
            "scaling": 13.0,
            "centering_position": [0.4, 0.29],
        }

    def __init__(self, config: dict[str, Any] | None = None, render_mode: str | None = None) -> None:
        self._initial_states: Float[np.ndarray, "cars 4"] | None = None
        self._costs: Mapping[str, float] | None = None
        self.history: list[dict[str, Any]] = []
        super().__init__(config, render_mode)

    def configure(self, config: dict[str, Any] | None) -> None:
        """Change the configuration, all of it or nothing.

        Raises:
            ValueError: for an unknown key or an impossible value.
        """
        self.config = self.checked_config(config, self.config)
        self._read()
        super().configure(None)

    @classmethod
    def checked_config(
        cls, changes: Mapping[str, Any] | None, config: Mapping[str, Any] | None = None
    ) -> dict[str, Any]:
        """Return the whole configuration, by default the default one, after changes.

        Raises:
            ValueError: for an unknown key or an impossible value.
        """
        return merged(cls.default_config() if config is None else config, changes)

    @staticmethod
    def controller_config(text: str) -> dict[str, Any]:
        """Return the configuration that a controller's short name stands for in this environment.

        Raises:
            ValueError: if it stands for none.
        """
        return controller_config(text)

    def _read(self) -> None:
        """Read the checked configuration."""
        self.settings = Settings.read(self.config)
        self.game = self.settings.game(self.scenario)
        self._costs = self.settings.costs

    def update_metadata(self, video_real_time_ratio: int = 1) -> None:
        """Frames per second of a video that plays at true speed."""
        super().update_metadata(video_real_time_ratio)

    def define_spaces(self) -> None:
        """Set observation and action type; an action space that did not change keeps its random generator."""
        action, observation = dict(self.config["action"]), self.config["observation"]
        before = self.action_space
        self.action_type = self._action_type(action)
        self.action_space = self.action_type.space()
        if before == self.action_space:
            self.action_space = before
        if observation == {"type": "CarStates"}:
            self.observation_type = CarStates(self, cars=self.cars)
        else:
            self.observation_type = observation_factory(self, observation)
        self.observation_space = finite(self.observation_type.space())

    def _action_type(self, config: dict[str, Any]) -> ActionType:
        if config["type"] == "Autopilot":
            return Autopilot(self)
        if config["type"] == "HumanModelAction":
            return HumanModelAction(self, config["lambda"])
        return action_factory(self, config)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seeds the noise of the starts, and after it what a random controller draws.
            options: ``"initial_states"``: array [cars, 4] of x, y, heading, speed in SI units, robot first, then the
                human, then the scripted cars, instead of drawn starts; ``"config"``: changes of the configuration.

        Raises:
            ValueError: for unknown options, or initial states that are not a finite array of that shape.
        """
        options = options or {}
        unknown = sorted(set(options) - {"initial_states", "config"})
        if unknown:
            raise ValueError(f"unknown reset options {unknown}; the options are 'initial_states' and 'config'")
        self._initial_states = options.get("initial_states")
        before = self.config, self.settings, self.game, self._costs
        try:
            return super().reset(seed=seed, options=options)
        except ValueError:
            self.config, self.settings, self.game, self._costs = before
            raise

    def _checked_states(self, states: Any) -> Float[np.ndarray, "cars 4"] | None:
        if states is None:
            return None
        states, shape = np.array(states, dtype=float), (self.cars, 4)
        if states.shape != shape:
            raise ValueError(f"options['initial_states'] has shape {states.shape}; {self.scenario.name} needs {shape}")
        if not np.isfinite(states).all():
            raise ValueError(f"options['initial_states'] is not finite: {states.tolist()}")
        return states

    def _reset(self) -> None:
        """Build the road, place the cars, and say who drives them."""
        self._initial_states = self._checked_states(self._initial_states)  # by now, the configuration is the new one
        states = self.draw_starts(self.np_random) if self._initial_states is None else self._initial_states
        self.road = Road(straight_road(self.game), np_random=self.np_random)
        for x, y in np.asarray(self.game.scene.obstacles, dtype=float):
            self.road.objects.append(Cone(self.road, [x, y]))
        cars = [kind(self.road, state[:2], *state[2:]) for kind, state in zip(self._roles(), states, strict=True)]
        for car in cars:
            car.solid = False  # collisions are seen, without effect
            if isinstance(car, PlanningVehicle):
                car.dynamics = jax.tree.map(float, self.game.world)
        self._drive(cars, states)
        self.road.vehicles = cars
        self.controlled_vehicles = [cars[0]]
        self.history = []
        self.collision = False

    @property
    def cars(self) -> int:
        """Scalar of cars."""
        return len(self.scenario.cars)

    def _roles(self) -> list[type[BicycleVehicle]]:
        """Return the class of every car."""
        return [RobotVehicle, HumanVehicle, *[ScriptedVehicle] * (self.cars - 2)]

    def _drive(self, cars: list[Any], states: Float[np.ndarray, "cars 4"]) -> None:
        """Say who drives the cars, which are in these states."""
        robot, human, *others = cars
        game, yields = swap_roles(self.game), self._draw_yielding(1)[0]
        human.drive_with(FixedModel(game, Naive()) if yields is None else Unmoved(game, yields), [robot, *others])
        if self.drives_itself:
            robot.drive_with(self._controller(states), [human, *others])

    def _draw_yielding(self, humans: int) -> Sequence[bool | None]:
        """Say of every human whether it always yields, or never; None for those who plan for their reward."""
        kind = self.config["yielding"]
        if kind == "mixed":
            return [bool(each) for each in self.np_random.uniform(size=humans) < 0.5]
        return [{"never": False, "always": True}.get(kind)] * humans

    @property
    def drives_itself(self) -> bool:
        """Whether a controller drives the robot, and not the agent."""
        return isinstance(self.action_type, (Autopilot, HumanModelAction))

    def draw_starts(self, random: np.random.Generator) -> Float[np.ndarray, "cars 4"]:
        """Draw a start of every car, robot first, then the human, in SI units; see `draw_starts`."""
        return draw_starts(self.scenario, random)

    @property
    def models(self) -> tuple[HumanModel, ...]:
        """The ladder."""
        return self.settings.models

    def _controller(self, states: Float[np.ndarray, "cars 4"]) -> Controller:
        controller, warm_start = controller_settings(self.config["controller"]), bool(self.config["warm_start"])
        belief = controller.belief
        costs = self.costs(states)  # to be measured now, if at all, and not within a step
        if isinstance(self.action_type, HumanModelAction):
            return FixedModel(self.game, self.models[0], self.models, warm_start)
        if isinstance(controller, ChoosingSettings):
            rule = controller.rule(self.models, costs, self.settings.semantics)
            return ModelSwitching(self.game, rule, warm_start, belief)
        if isinstance(controller, FixedSettings):
            return FixedModel(self.game, human_model(controller.model), (), warm_start, belief)
        names = controller.draw(self.episode_steps, self.np_random)
        return ScheduledModels(self.game, [human_model(name) for name in names], warm_start, belief)

    def costs(self, states: Float[np.ndarray, "cars 4"]) -> Float[np.ndarray, "rungs"]:
        """T(M) of every model on the ladder [s]; where to be measured, once after each change of configuration."""
        names = [model.name for model in self.models]
        if self._costs is None:
            self._costs = dict(zip(names, self._measured_costs(states), strict=True))
        return np.array([self._costs[name] for name in names])

    def _measured_costs(self, states: Float[np.ndarray, "cars 4"]) -> list[float]:
        """Measure T(M) of every model on the ladder [s]."""
        return measure_costs(self.game, self.models, states).tolist()

    @property
    def robot(self) -> RobotVehicle:
        """Car 0."""
        return self.road.vehicles[0]

    @property
    def human(self) -> HumanVehicle:
        """Car 1."""
        return self.road.vehicles[1]

    @property
    def car_states(self) -> Float[np.ndarray, "cars 4"]:
        """``(x, y, heading, speed)`` of robot, human and scripted cars in SI units."""
        return states_of(self.road.vehicles)

    def render(self) -> np.ndarray | None:
        """Draw the road from above and a panel with the model in use, its history, reward and planning time."""
        if self.viewer is None and self.render_mode is not None:
            self.viewer = self.viewer_class(self)
        return super().render()

    def _simulate(self, action: Any = None) -> None:
        """Let all cars plan and move, evaluate the robot's new state, and let the agent pay for the model it chose."""
        super()._simulate(action)
        if isinstance(self.action_type, HumanModelAction):
            seconds = self.costs(self.car_states)[int(action)]
            self._terms[COMPUTATION] = -float(self.action_type.price * seconds)
        self.history.append(self._record())

    def _record(self) -> dict[str, Any]:
        """Return what the panel shows of a step."""
        step = self.robot.last_step
        return {
            "model": step.model if step else None,
            "planning_seconds": step.planning_seconds if step else 0.0,
            "decision_seconds": step.decision_seconds if step else 0.0,
            "gains": step.gains if step else {},
            "choice_failed": bool(step and step.choice_failed),
            "status": step.status if step else None,
            "belief": step.belief if step else None,
            "reward": sum(self._terms.values()),
            "collision": self.collision,
        }

    def _is_terminated(self) -> bool:
        return bool(self.config["terminate_on_collision"] and self.collision)

    def _info(self, obs: Any, action: Any = None) -> dict[str, Any]:
        """Describe the last step; after a reset, only the robot's speed and what collisions do."""
        info: dict[str, Any] = {"speed": self.robot.speed, "collision_effect": "reward only"}
        if self.steps == 0:
            return info
        info |= {"action": action, "rewards": self._rewards(action)}
        info |= {"collision": self.collision, "crashed": self.robot.hit}
        info["human_status"] = self.human.last_step.status if self.human.last_step else None
        step = self.robot.last_step
        if step is not None:
            info |= {
                "model": step.model,
                "status": step.status,
                "gains": dict(step.gains),
                "choice_failed": step.choice_failed,
                "timing": Timing(step.planning_seconds, step.decision_seconds, step.compile_seconds),
            }
            if step.belief is not None:
                info["belief"] = step.belief
            if self._costs and step.model in self._costs:
                info["counted_seconds"] = float(self._costs[step.model])  # T(M)
        return info
