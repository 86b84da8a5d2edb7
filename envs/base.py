"""The environment that all scenarios share: a road, humans, a robot, and who drives it."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, ClassVar

import jax
import numpy as np
from highway_env.road.road import Road
from jaxtyping import Int

from ms_highway.choice.rule import Order
from ms_highway.envs.configuration import Changes, Config, read_own
from ms_highway.envs.controllers import KEYBOARD
from ms_highway.envs.game_env import Cone, GameEnv, Timing, straight_road
from ms_highway.envs.graphics import InteractionViewer
from ms_highway.envs.keyboard import keyboard_control
from ms_highway.envs.registry import controller_config
from ms_highway.envs.settings import Settings
from ms_highway.envs.spaces import Autopilot, HumanModelAction, cone_distances
from ms_highway.game.game import Game, swap_roles
from ms_highway.game.reward import COMPUTATION
from ms_highway.game.scenario import TIME_STEP, Scenario
from ms_highway.game.starts import Random, draw_episode
from ms_highway.loop.controller import ControlStep
from ms_highway.loop.driver import fixed
from ms_highway.loop.human_drivers import HUMAN_DRIVERS, FunctionDriver
from ms_highway.loop.records import PLANS
from ms_highway.planning.compiled_plans import measure_costs
from ms_highway.runtime.arrays import HumansWeights, State
from ms_highway.vehicle import HumanVehicle, RobotVehicle, ScriptedVehicle


class InteractionEnv(GameEnv):
    """A robot among human drivers, on the stage of a `ms_highway.game.scenario.Scenario`.

    Every human plans for its own reward and believes that all others keep their velocity, the robot too. In scenarios
    with streams, their rewards are drawn for every episode: some humans yield more readily than others, and some hardly
    at all; the robot succeeds if it ends in the target lane and never collides.

    Configuration, beside highway-env's own; defaults that are not named here are the scenario's. All changes, by
    ``reset`` or ``configure``, act from the next reset on, and ``config`` is that of the episode until then;
    before the first reset and after an episode's end, ``configure`` changes ``config`` and spaces at once:

    * ``action``: who drives. ``{"type": "Autopilot"}``: the robot's controller; ``{"type": "HumanModelAction",
      "lambda": 0.1}``: the agent chooses the model of every human; ``{"type": "ContinuousAction"}``: the agent drives,
      by accelerations of +-5 m/s^2, front-wheel angles of +-0.1 rad and speeds from 0 to 40 m/s unless
      ``acceleration_range``, ``steering_range`` and ``speed_range`` say otherwise.
    * ``controller``: chooses a model for every human in every step. ``{"type": "learned", "lambda": 1.0}`` (default,
      for naive, turn and tom), a learned value of computation does, with ``"values"``, ``"shipped"`` or a file of
      ``ms-highway values learn``; ``{"type": "switching", "lambda": 0.1, "cooldown": 3, "trust_radius": 1.5}``, the
      paper's Algorithm 1 does (`ms_highway.choice.quadratic.Quadratic`); ``{"type": "budget", "milliseconds": 20}``,
      what gains most in this time; ``{"type": "nearest", "count": 2}``, the top of the ladder for the nearest humans;
      ``{"type": "fixed", "model": "tom"}``; ``{"type": "schedule", "models": ["tom", "tom", "naive"]}``, a model per
      step, the last one kept, and ``"period"``, the same repeated; ``{"type": "random", "shares": {"naive": 0.7, "tom":
      0.3}}``, drawn when the episode starts; or a short name of them, such as ``"tom"`` or ``"learned:1"``, see
      `ms_highway.envs.registry.controller_config`. Any of them with ``"belief": True`` infers from what a human does
      which model predicts it (`ms_highway.planning.hypotheses`), and counts on no response that it does not show.
    * ``ladder``: names of human models, cheapest first, or ``"best"`` (`ms_highway.planning.ladders`).
    * ``costs``: T(M), the time that planning under model M counts [s]: ``"published"``, the paper's (default with one
      human); ``"shipped"``, what plans take on one core (default with several, and in physical scenarios);
      ``"measured"`` on this machine in the first step; or seconds by model (``tom@8`` in proportion). Among several
      humans, one is predicted by M, all others by the first rung: T is additive. With ``"shipped"``, budgets choose by
      measured times: the same seed may be another episode, see ``info["clocked"]``.
    * ``semantics``: ``"paper"``, the paper's dynamics; ``"physical"``, the same within what tyres hold; or
      ``"released"``, the paper's released code; see `ms_highway.game.scenario.build_game`.
    * ``human_reward``: what humans drive for, in the world and in the robot's models of them: ``"learned"`` from
      demonstrations; ``"published"``; weights by name, of `ms_highway.game.reward.weight_names`; None for what
      belongs to the semantics (learned and published). What a human is after in the scenario beyond driving, such as
      its lane, stays unless weights name it. A learned reward has no weight of ``collision``.
    * ``humans``: their number, from 2 to 20 in scenarios with streams.
    * ``beliefs``: which rewards the robot assumes of several humans: ``"learned"``, for all the one that theirs are
      drawn around, or ``"true"``, for each its own. A controller's ``"belief"`` is about models, not rewards.
    * ``yielding``: what humans do beside the robot: ``"usual"``, plan for their reward; ``"never"`` yield, but keep
      their velocity; ``"always"``, make room for it (`ms_highway.loop.human_drivers`); or ``"mixed"``, each of
      them never or always, drawn when the episode starts.
    * ``human_driver``: what drives the humans instead of plans for their reward: a name of `ms_highway.add_driver`, or
      ``"keyboard"``: the arrow keys drive the first human, in a window (``render_mode="human"``).
    * ``way_out``: whether the robot keeps a way out from humans who do not yield, see `ms_highway.planning.way_out`.
    * ``control_limit``: bounds on curvature [1/m] and acceleration [m/s^2] of plans; ``"unlimited"``; or None for the
      scenario's, in released semantics for no bounds.
    * ``grip``: the total acceleration that tyres hold, of steering and speeding up or braking together [m/s^2], such as
      `ms_highway.game.scenario.GRIP`: plans are cut down to it and what is executed keeps to it, without reversing;
      None sets no such limit, as in the paper; in physical semantics it stands for ``GRIP``. It does not apply where
      the agent drives.
    * ``solver``: how plans under models that do not respond are improved: ``"gradient"``, the paper's, ``"newton"``, or
      for horizons of seconds ``"convex_newton"``, up a smooth reward with room to stop (`ms_highway.game.stopping`).
    * ``horizon``: number of planned controls, of robot and humans.
    * ``time_step``: duration of a step of plans and of the environment [s].
    * ``iterations``: number of gradient steps of a plan; None for what suits the horizon.
    * ``step_size``: length of a gradient step per unit of gradient; None for what suits the horizon; longer ones are
      warned of. See `ms_highway.game.planning_settings.PlanningSettings`.
    * ``duration``: length of an episode [s]; ``terminate_on_collision``: whether a collision ends it.

    ``reset`` takes ``options={"initial_states": ...}``, an array [cars, 4] of x, y, heading, speed in SI units, robot
    first, then the humans, then the scripted cars, instead of drawn starts.

    The reward is the robot's r_R after the step. A collision only costs reward, as in the paper: cars neither push each
    other nor stop. ``notebooks/REFERENCE.md`` tells what ``info`` holds. Its ``control``, what the robot did, may go
    beyond the default ranges of actions; divided by the ends of wider ones, such as
    `ms_highway.envs.demonstration.ACTION`, it is the ``ContinuousAction`` that does the same within ``speed_range``.

    Attributes:
        settings: of the configuration.
        game: that the robot believes in; another one is played, by the humans too, from the next reset on.
        weights: of every human's own reward.
        seconds: T(M) by model, by which rules choose; empty until it is measured [s].
        history: the record of every step, None where the robot does not plan, and its reward.
    """

    scenario: ClassVar[Scenario]
    settings_type, viewer_type = Settings, InteractionViewer
    reset_options = ("initial_states", "config")
    settings: Settings
    history: list[tuple[ControlStep | None, float]]

    @classmethod
    def default_config(cls) -> Config:
        """highway-env's configuration with the scenario's own."""
        scenario, several = cls.scenario, bool(cls.scenario.streams)
        return {
            **super().default_config(),
            "observation": {"type": "SceneStates" if scenario.semantics == "physical" else "CarStates"},
            "action": {"type": "Autopilot"},
            "controller": {"type": "learned", "lambda": 1.0},
            "ladder": list(scenario.ladder),
            "costs": "shipped" if several or scenario.semantics == "physical" else "published",
            "semantics": scenario.semantics,
            "human_reward": None,
            "humans": scenario.humans,
            "beliefs": "learned",
            "yielding": "usual",
            "human_driver": None,
            "way_out": scenario.way_out,
            "control_limit": None,
            "grip": scenario.grip,
            "solver": scenario.solver,
            **asdict(scenario.planning),
            "duration": scenario.steps * TIME_STEP,
            "terminate_on_collision": False,
            "screen_width": 1280 if several else 960,
            "screen_height": 380 if several else 352,
            "scaling": 13.0,
            "centering_position": [0.4, 0.29],
        }

    @classmethod
    def checked_config(cls, changes: Changes | None, config: Changes | None = None) -> Config:
        """See `GameEnv.checked_config`; ladder and controller are spelt out, and an autopilot's fit each other."""
        config = super().checked_config(changes, config)
        if isinstance(config["controller"], str):
            config["controller"] = controller_config(config["controller"])
        settings = read_own(Settings, config)
        settings.check(cls.scenario)
        controller, place = settings.controller, f"config['controller'] is {config['controller']}"
        if config["action"]["type"] == "HumanModelAction" and not controller.predicts:
            raise ValueError(f"{place}, with which no model is chosen; leave it out, or the action HumanModelAction")
        if config["action"]["type"] == "Autopilot":
            try:
                controller.check(settings.start(settings.seconds, 1, np.random.default_rng()))
            except ValueError as error:
                raise ValueError(f"{place}: {error}") from error
            settings.warn_of_other_values(cls.scenario)
        return config | {"ladder": [model.name for model in settings.models]}

    def _read(self) -> None:
        super()._read()
        self.game, self._counted = self.settings.game(self.scenario), self.settings.seconds
        self.seconds = {} if self.settings.measures else self._counted

    def _reset(self) -> None:
        """Build the road, place the cars, and say who drives them."""
        states, self.weights = self.draw_episode(self.np_random)
        given = self.options.get("initial_states")
        if given is not None:
            states, shape = np.array(given, dtype=float), (self.cars, 4)
            if states.shape != shape or not np.isfinite(states).all():
                message = f"{self.scenario.name} needs an array {shape} of finite numbers"
                raise ValueError(f"options['initial_states'] is {states.tolist()}; {message}")
        humans, driver = self.settings.humans, HUMAN_DRIVERS.get(self.settings.human_driver or "")
        human = driver if isinstance(driver, type) else HumanVehicle
        kinds = [RobotVehicle, *[human] * humans, *[ScriptedVehicle] * (self.cars - 1 - humans)]
        self.road = Road(straight_road(self.game), np_random=self.np_random)
        self._place([kind(self.road, state[:2], *state[2:]) for kind, state in zip(kinds, states, strict=True)])
        for car in self.road.vehicles[: 1 + humans if human is HumanVehicle else 1]:
            car.dynamics = jax.tree.map(float, self.game.world)
        self.road.objects = [Cone(self.road, place) for place in np.asarray(self.game.scene.obstacles, dtype=float)]
        self.history, self._collided = [], False
        self._drive()

    @property
    def cars(self) -> int:
        """Number of cars: robot, humans and scripted ones."""
        return 1 + self.settings.humans + len(self.scenario.cars[2:])

    def draw_episode(self, random: Random) -> tuple[State, HumansWeights]:
        """Draw the start of every car in SI units, and what every human drives for; see `draw_episode`."""
        return draw_episode(self.scenario, random, self.game.humans)

    def draw_drivers(self, random: Random) -> Int[Any, "humans"]:
        """Return the number of every human's driver: `PLANS`, or one more than its place in ``settings.drivers``."""
        names, humans = self.settings.drivers, self.settings.humans
        if len(names) > 1:
            return PLANS + 1 + (random.uniform(size=humans) < 0.5)
        return np.where((np.arange(humans) > 0) & (names == (KEYBOARD,)), PLANS, PLANS + len(names))

    def _drive(self) -> None:
        """Give the cars their drivers."""
        cars, game = self.road.vehicles, replace(self.game, humans=replace(self.game.humans, weights=self.weights))
        names = (None, *self.settings.drivers)
        for place, (human, number) in enumerate(zip(self.humans, self.draw_drivers(self.np_random), strict=True)):
            own, name = swap_roles(game, place), names[number]
            function = HUMAN_DRIVERS.get(name, keyboard_control) if name else None
            if not isinstance(function, type):  # or else a vehicle of this class drives by itself
                driver = FunctionDriver(own, name, function) if name and function else fixed(own)
                human.drive_with(driver, [car for car in cars if car is not human])
        if isinstance(self.action_type, Autopilot):
            self._drive_robot(game if self.settings.beliefs == "true" else self.game)

    def _drive_robot(self, game: Game) -> None:
        """Give the robot its driver, with unknown costs if they are yet to be measured."""
        settings, order = self.settings, None
        if isinstance(self.action_type, HumanModelAction):
            order = Order(np.zeros((1, 1), int), settings.models)
        start = settings.start(self.seconds, self.episode_steps, self.np_random)
        driver = settings.controller.driver(game, start, settings.way_out, order)
        self.robot.drive_with(driver, self.road.vehicles[1:])

    def measure(self) -> None:
        """Measure planning times on the ladder with the cars where they are; high ones for budgets."""
        settings, models = self.settings, self.settings.models
        quantile = 0.5 if settings.controller.budget is None else 0.99
        costs = measure_costs(self.game, models, self.car_states, quantile=quantile, way_out=settings.way_out)
        seconds = (costs.base + np.asarray(costs.each)).tolist()
        self.seconds = dict(zip((model.name for model in models), seconds, strict=True))
        self._counted = self._counted or self.seconds

    def counted_seconds(self, names: Sequence[str]) -> float | None:
        """Return T of a plan in which humans are predicted by these models [s]; None where it is not known."""
        if not self._counted.keys() >= {*names}:
            return None
        base = self._counted[self.settings.models[0].name] if len(names) > 1 else 0.0
        return float(base + sum(self._counted[name] - base for name in names))

    @property
    def robot(self) -> RobotVehicle:
        """Car 0."""
        return self.road.vehicles[0]

    @property
    def humans(self) -> list[HumanVehicle]:
        """The cars of the humans."""
        return self.road.vehicles[1 : 1 + self.settings.humans]

    @property
    def success(self) -> bool:
        """Whether the robot is in the target lane and has not collided so far."""
        return bool(self.game.scene.is_reached(self.robot.position[1]) and not self._collided)

    @property
    def distance_to_cones(self) -> float:
        """From the robot's front to the first cone ahead in its lane, infinite without one [m]."""
        return float(cone_distances(self.game.scene, self.car_states[:1])[0])

    def _simulate(self, action: Any = None) -> None:
        """Let all cars plan and move, evaluate the robot's new state, and let the agent pay for the model it chose."""
        if not self.seconds and isinstance(self.action_type, Autopilot):
            self.measure()  # in the first step, as JAX must not begin before it
            if self.robot.controller is not None and self.settings.controller.chooses:
                self._drive_robot(self.robot.controller.game)
        super()._simulate(action)
        self._collided |= self.collision
        step = self.robot.last_step
        if isinstance(self.action_type, HumanModelAction) and step:
            self._terms[COMPUTATION] = -float(self.config["action"]["lambda"] * self.counted_seconds(step.thought))
        self.history.append((step, sum(self._terms.values())))

    def _info(self, obs: Any, action: Any = None) -> Config:
        """Describe the last step, see `InteractionEnv`."""
        info, step, streams = super()._info(obs, action), self.robot.last_step, bool(self.scenario.streams)
        if streams:
            info["distance_to_cones"] = self.distance_to_cones
        if self.steps:
            steps = [getattr(human, "last_step", None) for human in self.humans]  # other vehicles have none
            info["human_status"] = tuple(step and step.status for step in steps)
            if streams:
                info["success"] = info["is_success"] = self.success
        if step is None:
            return info
        info |= {name: getattr(step, name) for name in ("model", "models", "status", "choice_failed")}
        info["timing"] = Timing(step.planning_seconds, step.decision_seconds, step.compile_seconds)
        asked, controller = isinstance(self.action_type, HumanModelAction), self.settings.controller
        clocked = self.settings.measures and (asked or controller.chooses)
        info["clocked"] = clocked or (not asked and controller.budget is not None)
        info["gains"] = step.highest_gains()
        known = {"belief": step.belief, "counted_seconds": self.counted_seconds(step.thought)}
        info |= {name: value for name, value in known.items() if value is not None}
        if streams:
            info |= {f"humans_{model.name}": step.models.count(model.name) for model in self.settings.models[1:]}
        return info
