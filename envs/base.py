"""Define the environment of all scenarios: a road, humans and a robot."""

from dataclasses import asdict, replace
from typing import ClassVar

import jax
import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Int

from ms_highway.choice.belief import equal_probabilities
from ms_highway.choice.rule import in_order
from ms_highway.envs.configuration import Changes, Config, as_dictionary, read_own
from ms_highway.envs.configured import not_simulated
from ms_highway.envs.game_env import Cone, GameEnv, straight_road
from ms_highway.envs.graphics import InteractionViewer
from ms_highway.envs.human_drivers import draw_drivers, human_controller, vehicle_class
from ms_highway.envs.info import InteractionInfo, gains_info, human_status, plan_info
from ms_highway.envs.keyboard import Keyboard
from ms_highway.envs.provenance import warn_of_other_values
from ms_highway.envs.registry import controller_config
from ms_highway.envs.settings import Settings
from ms_highway.envs.spaces import Autopilot, HumanModelAction, cone_distances
from ms_highway.game.dynamics import facing
from ms_highway.game.game import Game, swap_roles
from ms_highway.game.reward import COMPUTATION
from ms_highway.game.scenario import TIME_STEP, Scenario
from ms_highway.game.starts import Random, draw_episode
from ms_highway.loop.controller import ControlStep
from ms_highway.planning.costs import UNKNOWN, measure_costs
from ms_highway.runtime.arrays import Array, HumansWeights, State, read_only
from ms_highway.vehicle import HumanVehicle, RobotVehicle, ScriptedVehicle


class InteractionEnv(GameEnv):
    """A robot among human drivers in a `ms_highway.game.scenario.Scenario`.

    Every human plans for its own reward and believes that all other cars, the robot
    included, keep their velocity. The reward of the environment is the robot's r_R
    after the step.

    ``notebooks/REFERENCE.md`` is the manual: actions, observations, rewards, the keys
    of ``config`` and of ``info``, and the options of ``reset``. The fields of
    `ms_highway.envs.settings.Settings` are the keys that highway-env does not have.

    A subclass with an attribute ``scenario`` is an environment of one's own, see
    `ms_highway.add_scenario`.

    Attributes:
        game: that the robot believes in; robot and humans play a game that is assigned
            from the next reset on.
        weights: of every human's own reward.
        costs: T(M), by which rules choose; of no model until it is measured.
        counted: T(M) that episodes are charged for. It differs from ``costs`` only with
            ``"shipped"`` costs and a budget, which chooses by measured times.
        seconds: T(M) of ``costs`` by model [s].
        history: the record of every step, None where the robot does not plan, and its
            reward.
    """

    scenario: ClassVar[Scenario]
    settings_type = Settings
    viewer_type = InteractionViewer
    reset_options = ("initial_states", "config")
    settings: Settings
    history: list[tuple[ControlStep | None, float]]

    @classmethod
    def default_config(cls) -> Config:
        """Return highway-env's default configuration with the scenario's keys."""
        scenario = cls.scenario
        several = bool(scenario.streams)
        physical = scenario.semantics == "physical"
        return {
            **super().default_config(),
            "observation": {"type": "SceneStates" if physical else "CarStates"},
            "action": {"type": "Autopilot"},
            "controller": {"type": "learned", "lambda": 1.0},
            "ladder": list(scenario.ladder),
            "costs": "shipped" if several or physical else "published",
            "semantics": scenario.semantics,
            "human_reward": None,
            "humans": scenario.humans,
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
    def checked_config(
        cls,
        changes: Changes | None,
        config: Changes | None = None,
    ) -> Config:
        """See `GameEnv.checked_config`; also check ladder and controller.

        Both are spelt out, and have to fit each other.
        """
        if "beliefs" in as_dictionary("the configuration", changes or {}):
            raise ValueError(
                "config['beliefs'] is gone since 3.0.0; leave it out, as the robot"
                " assumes of several humans the reward that theirs are drawn around"
            )
        config = super().checked_config(changes, config)
        if isinstance(config["controller"], str):
            config["controller"] = controller_config(config["controller"])
        settings = read_own(Settings, config)
        settings.check(cls.scenario)
        controller = settings.controller
        place = f"config['controller'] is {config['controller']}"
        if config["action"]["type"] == "HumanModelAction" and not controller.predicts:
            raise ValueError(
                f"{place}, with which no model is chosen; leave it out, or the action"
                " HumanModelAction"
            )
        if config["action"]["type"] == "Autopilot":
            start = settings.start(1, np.random.default_rng())
            try:
                controller.check(start)
            except ValueError as error:
                raise ValueError(f"{place}: {error}") from error
            warn_of_other_values(settings, cls.scenario, start)
        return config | {"ladder": [model.name for model in settings.models]}

    def _read(self) -> None:
        super()._read()
        settings = self.settings
        self.game = settings.game(self.scenario)
        self.counted = settings.counted
        self.costs = UNKNOWN if settings.measures else self.counted
        self._rungs = [model.name for model in settings.models]

    # The start of an episode: road and cars

    @not_simulated
    def _reset(self) -> None:
        """Draw the start, build the road with its cars, and give them drivers."""
        states, weights = self.draw_episode(self.np_random)
        self.weights = read_only(np.asarray(weights))
        if self.options.get("initial_states") is not None:
            states = self._initial_states(self.options["initial_states"])
        self._build_road(states)
        self.history = []
        self._collided = False
        self._drive()

    def _initial_states(self, given: object) -> State:
        """Return the states of all cars that the options of `reset` give.

        Raises:
            ValueError: unless they are finite numbers for every car.
        """
        states = np.array(given, dtype=float)
        shape = (self.cars, 4)
        if states.shape != shape or not np.isfinite(states).all():
            remedy = f"{self.scenario.name} needs an array {shape} of finite numbers"
            raise ValueError(
                f"options['initial_states'] is {states.tolist()}; {remedy}"
            )
        return facing(states)

    def _build_road(self, states: State) -> None:
        """Build the road with its cones, and place cars in these states [cars, 4]."""
        self.road = Road(straight_road(self.game), np_random=self.np_random)

        # Robot, humans and scripted cars, in this order.
        humans = self.settings.humans
        human_class = vehicle_class(self.settings.human_driver)
        classes: list[type[Vehicle]] = [
            RobotVehicle,
            *[human_class] * humans,
            *[ScriptedVehicle] * (self.cars - 1 - humans),
        ]
        cars = [
            kind(self.road, state[:2], *state[2:])
            for kind, state in zip(classes, states, strict=True)
        ]
        self._place(cars)

        # Cars that plan move by the dynamics of the game.
        planning = 1 + humans if human_class is HumanVehicle else 1
        for car in cars[:planning]:
            car.dynamics = jax.tree.map(float, self.game.world)

        cones = np.asarray(self.game.scene.obstacles, dtype=float)
        self.road.objects = [Cone(self.road, place) for place in cones]

    @property
    def keys_drive(self) -> bool:
        """See `ms_highway.envs.configured.ConfiguredEnv.keys_drive`.

        The keys may also drive a human.
        """
        return Keyboard.name in self.settings.drivers or super().keys_drive

    @property
    def cars(self) -> int:
        """Number of cars: robot, humans and scripted ones."""
        return 1 + self.settings.humans + len(self.scenario.cars[2:])

    def draw_episode(self, random: Random) -> tuple[State, HumansWeights]:
        """Draw the start of every car in SI units, and every human's weights."""
        return draw_episode(self.scenario, random, self.game.humans)

    # Drivers

    def draw_drivers(self, random: Random) -> Int[Array, "humans"]:
        """Return the number of every human's driver.

        See `ms_highway.loop.records.HUMAN_PLANS`.
        """
        return draw_drivers(self.settings.drivers, self.settings.humans, random)

    @not_simulated
    def _drive(self) -> None:
        """Give the cars their drivers."""
        cars = self.road.vehicles
        humans = replace(self.game.humans, weights=self.weights)
        truth = replace(self.game, humans=humans)
        names = (None, *self.settings.drivers)
        numbers = self.draw_drivers(self.np_random)
        for place, human in enumerate(self.humans):
            own_game = swap_roles(truth, place)
            name = names[numbers[place]]
            controller = human_controller(own_game, name, self.np_random)
            if controller is not None:
                human.drive_with(controller, [car for car in cars if car is not human])
        if isinstance(self.action_type, Autopilot):
            self._drive_robot(self.game)

    @not_simulated
    def _drive_robot(self, game: Game) -> None:
        """Give the robot its driver, with unknown costs before they are measured."""
        settings = self.settings
        order = None
        if isinstance(self.action_type, HumanModelAction):
            self._terms[COMPUTATION] = 0.0
            order = in_order(np.zeros((1, 1), int), settings.models)
        start = settings.start(self.episode_steps, self.np_random, self.costs)
        driver = settings.controller.driver(game, start, settings.way_out, order)
        self.robot.drive_with(driver, self.road.vehicles[1:])

    # Costs of computation

    @not_simulated
    def measure(self) -> None:
        """Measure T(M) of the ladder with the cars where they are.

        T(M) is the median, or the 99 % quantile for budgets.
        """
        settings = self.settings
        quantile = 0.5 if settings.controller.budget is None else 0.99
        self.costs = measure_costs(
            self.game, settings.models, self.car_states, quantile, settings.way_out
        )
        if settings.costs == "measured":
            self.counted = self.costs

    @property
    def seconds(self) -> dict[str, float]:
        """See the attributes of the class."""
        return self.costs.seconds

    def _clocked(self) -> bool:
        """Return whether measured times have a say in the choice of models."""
        settings = self.settings
        controller = settings.controller
        if isinstance(self.action_type, HumanModelAction):
            return settings.measures
        budgets = controller.budget is not None
        return budgets or (settings.measures and controller.chooses)

    # The present state

    @property
    def robot(self) -> RobotVehicle:
        """Car 0."""
        return self.road.vehicles[0]

    @property
    def humans(self) -> list[HumanVehicle]:
        """The cars of the humans."""
        return self.road.vehicles[1 : 1 + self.settings.humans]

    @property
    @not_simulated
    def success(self) -> bool:
        """Whether the robot is in the target lane and has not collided so far."""
        return bool(
            self.game.scene.is_reached(self.robot.position[1]) and not self._collided
        )

    @property
    def distance_to_cones(self) -> float:
        """Distance from the robot's front to the first cone ahead in its lane [m].

        It is infinite without one.
        """
        return float(cone_distances(self.game.scene, self.car_states[:1])[0])

    # A step

    @not_simulated
    def _simulate(self, action: object = None) -> None:
        """Let all cars plan and move, and evaluate the robot's new state.

        The agent pays for the models that it chose.
        """
        # Not at the reset: JAX must not start before the first step, so that processes
        # can fork.
        if not self.costs.names and isinstance(self.action_type, Autopilot):
            self.measure()
            if self.robot.controller is not None and self.settings.controller.chooses:
                self._drive_robot(self.robot.controller.game)
        super()._simulate(action)
        self._collided |= self.collision
        step = self.robot.last_step
        if isinstance(self.action_type, HumanModelAction) and step:
            counted = self.counted.of_models(step.counted_models)
            self._terms[COMPUTATION] = -float(self.config["action"]["lambda"] * counted)
        self.history.append((step, self._reward(action)))

    def _info(self, obs: object, action: object = None) -> Config:
        """Describe the last step; keys, types and shapes are the same after a reset."""
        info = super()._info(obs, action)
        several = bool(self.scenario.streams)
        own: InteractionInfo = {
            "human_status": tuple(human_status(human) for human in self.humans)
        }
        if several:
            own["distance_to_cones"] = self.distance_to_cones
            own["success"] = own["is_success"] = self.success
        if not isinstance(self.action_type, Autopilot):
            return info | own

        # The robot plans, or a function drives it.
        step = self.robot.last_step
        settings = self.settings
        controller = settings.controller
        plan = plan_info(step, settings.humans)
        if controller.predicts:
            counted = self.counted.of_models(step.counted_models) if step else 0.0
            own["counted_seconds"] = counted
        if controller.belief:
            belief = step.belief if step else None
            if belief is None:
                belief = equal_probabilities(settings.humans)
            own["belief"] = read_only(belief)

        # The agent's choice needs no gains.
        agent_chooses = isinstance(self.action_type, HumanModelAction)
        own["gains"] = {}
        if controller.chooses and not agent_chooses:
            own["gains"] = gains_info(step, self._rungs)
        own["clocked"] = self._clocked()
        if several:
            counts = {name: plan["models"].count(name) for name in self._rungs[1:]}
            info |= {f"humans_{name}": count for name, count in counts.items()}
        return info | plan | own
