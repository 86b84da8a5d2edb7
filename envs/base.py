"""Define the environment of all scenarios: a road, humans, a robot, and what drives
them.
"""

from dataclasses import asdict, replace
from typing import Any, ClassVar

import jax
import numpy as np
from highway_env.road.road import Road
from jaxtyping import Int

from ms_highway.choice.belief import first_belief
from ms_highway.choice.rule import NOT_ESTIMATED, in_order
from ms_highway.envs.configuration import Changes, Config, as_dictionary, read_own
from ms_highway.envs.controllers import KEYBOARD
from ms_highway.envs.game_env import Cone, GameEnv, Timing, straight_road
from ms_highway.envs.graphics import InteractionViewer
from ms_highway.envs.registry import controller_config
from ms_highway.envs.settings import Settings
from ms_highway.envs.spaces import Autopilot, HumanModelAction, cone_distances
from ms_highway.envs.viewer import Keyboard
from ms_highway.game.dynamics import facing
from ms_highway.game.game import Game, swap_roles
from ms_highway.game.reward import COMPUTATION
from ms_highway.game.scenario import TIME_STEP, Scenario
from ms_highway.game.starts import Random, draw_episode
from ms_highway.loop.controller import (
    HUMAN_DRIVERS,
    Controller,
    ControlStep,
    FunctionDriver,
    draw_key,
    is_vehicle,
)
from ms_highway.loop.driver import fixed
from ms_highway.loop.records import HUMAN_PLANS
from ms_highway.planning.costs import UNKNOWN, measure_costs
from ms_highway.runtime.arrays import HumansWeights, State, read_only
from ms_highway.vehicle import HumanVehicle, RobotVehicle, ScriptedVehicle

BELIEFS_GONE = (
    "config['beliefs'] is gone since 3.0.0; leave it out, as the robot assumes of"
    " several humans the reward that theirs are drawn around"
)
UNTIL_FIRST: Config = {
    "model": "",
    "status": "",
    "choice_failed": False,
    "plan_steps": 0,
    "converged": False,
}
"""What ``info`` says of the robot's last step, with the values before the first step.
"""


class InteractionEnv(GameEnv):
    """A robot among human drivers in a `ms_highway.game.scenario.Scenario`.

    Every human plans for its own reward and believes that all other cars, the robot
    included, keep their velocity. In scenarios with streams, the humans' rewards are
    drawn for every episode, so that some humans yield more readily than others. There,
    the robot succeeds if it ends in the target lane and never collides.

    The configuration has highway-env's keys and those below. A default that is not
    named here is the scenario's. Changes act from the next reset on, and ``config``
    describes the current episode until then. Before the first reset and after the end
    of an episode, ``configure`` changes ``config`` and spaces at once:

    * ``action``: who drives. ``{"type": "Autopilot"}``: the robot's controller;
      ``{"type": "HumanModelAction", "lambda": 0.1}``: the agent chooses the model of
      every human; ``{"type": "ContinuousAction"}``: the agent drives, by accelerations
      of +-5 m/s^2, front-wheel angles of +-0.1 rad and speeds from 0 to 40 m/s unless
      ``acceleration_range``, ``steering_range`` and ``speed_range`` say otherwise.
    * ``controller``: chooses a model for every human in every step. ``{"type":
      "learned", "lambda": 1.0}`` (default) chooses by a learned value of computation,
      from naive, turn and tom; its ``"values"`` are ``"shipped"`` or a file of
      ``ms-highway values learn``. ``{"type": "switching", "lambda": 0.1, "cooldown": 3,
      "trust_radius": 1.5}`` chooses by the paper's Algorithm 1
      (`ms_highway.choice.quadratic.Quadratic`); ``{"type": "budget", "milliseconds":
      20}`` chooses what gains most within this time; ``{"type": "nearest", "count":
      2}`` predicts the nearest humans by the top of the ladder. ``{"type": "fixed",
      "model": "tom"}`` always takes the same model; ``{"type": "schedule", "models":
      ["tom", "tom", "naive"]}`` takes a model per step and keeps the last one;
      ``{"type": "random", "shares": {"naive": 0.7, "tom": 0.3}}`` draws them when the
      episode starts. A short name stands for each, such as ``"tom"`` or
      ``"learned:1"``, see `ms_highway.envs.registry.controller_config`. With
      ``"belief": True``, any of them infers from each human's behaviour which model
      predicts that human (`ms_highway.choice.belief`), and counts on no response that
      the human does not show.
    * ``ladder``: names of human models, cheapest first, or ``"best"``
      (`ms_highway.planning.ladders`).
    * ``costs``: T(M), the seconds that count for a plan under model M: ``"published"``,
      the paper's (default with one human); ``"shipped"``, measured on one core (default
      with several humans, and in physical scenarios); ``"measured"``, on this machine
      in the first step; or seconds by model, of which ``tom@8`` takes its share. Among
      several humans, T(M) is of a plan that predicts one human by M and the others by
      the first rung, and T is additive. With ``"shipped"``, budgets choose by measured
      times, so that episodes of one seed may differ.
    * ``semantics``: ``"paper"``, the paper's dynamics; ``"physical"``, the same within
      what tyres hold, where a collision is an overlap of bodies
      (`ms_highway.game.contact`) instead of the paper's indicator; or ``"released"``,
      the paper's released code; see `ms_highway.game.scenario.build_game`.
    * ``human_reward``: what humans drive for, in the world and in the robot's models of
      them: ``"learned"`` from demonstrations; ``"published"``; ``"us101"``, learned
      from drivers on that highway; weights by name, of
      `ms_highway.game.reward.weight_names`; or None for the reward of the semantics:
      published in released semantics, or else learned. Aims of the scenario, such as a
      human's target lane, stay unless weights name them. A learned reward has no weight
      of ``collision``, and that of the highway none of leaving the road.
    * ``humans``: number of humans, from 2 to 20 in scenarios with streams.
    * ``yielding``: what humans do beside the robot: ``"usual"``, plan for their reward;
      ``"never"``, keep their velocity and never yield; ``"always"``, make room for the
      robot (`ms_highway.loop.controller`); or ``"mixed"``, one of the last two, drawn
      for each human when the episode starts.
    * ``human_driver``: what drives the humans instead of plans for their reward: a name
      of `ms_highway.add_driver`, or ``"keyboard"``: the arrow keys drive the first
      human, in a window (``render_mode="human"``).
    * ``way_out``: whether the robot keeps a way out from humans who do not yield, see
      `ms_highway.planning.way_out`.
    * ``control_limit``: bounds on curvature [1/m] and acceleration [m/s^2] of plans;
      ``"unlimited"``; or None for the scenario's bounds, in released semantics for no
      bounds.
    * ``grip``: the total acceleration that tyres hold, across and along [m/s^2], such
      as `ms_highway.game.scenario.GRIP`: it limits plans and executed controls, without
      reversing; None sets no limit, as in the paper, but stands for ``GRIP`` in
      physical semantics. It does not apply where the agent drives.
    * ``solver``: how plans are improved: ``"gradient"``, the paper's steps; or
      ``"convex_newton"``, for horizons of seconds, on a smooth reward with room to stop
      (`ms_highway.game.payoff.stopping_cost`) and, in physical semantics, with room
      between bodies.
    * ``horizon``: number of planned controls, of robot and humans.
    * ``time_step``: duration of a step of plans and of the environment [s].
    * ``iterations``: number of gradient steps of a plan; None for what suits the
      horizon.
    * ``step_size``: length of a gradient step per unit of gradient; None for what suits
      the horizon; a longer one gives a warning. See
      `ms_highway.numerics.solvers.PlanningSettings`.
    * ``duration``: length of an episode [s]; ``terminate_on_collision``: whether a
      collision ends it.

    ``reset`` takes ``options={"initial_states": ...}`` instead of drawn starts: an
    array [cars, 4] of x, y, heading and speed in SI units, of the robot, the humans and
    the scripted cars in this order. Whole turns of a heading count for nothing: they
    are left out.

    The reward is the robot's r_R after the step. A collision only costs reward, as in
    the paper: cars neither push each other nor stop. ``notebooks/REFERENCE.md`` lists
    the keys of ``info``. The executed ``control`` may exceed the default ranges of
    actions: divided by the ends of wider ranges, such as
    `ms_highway.envs.demonstration.ACTION`, it is the ``ContinuousAction`` that does the
    same within ``speed_range``.

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
        several = bool(cls.scenario.streams)
        return {
            **super().default_config(),
            "observation": {
                "type": (
                    "SceneStates" if scenario.semantics == "physical" else "CarStates"
                )
            },
            "action": {"type": "Autopilot"},
            "controller": {"type": "learned", "lambda": 1.0},
            "ladder": list(scenario.ladder),
            "costs": (
                "shipped"
                if several or scenario.semantics == "physical"
                else "published"
            ),
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
        cls, changes: Changes | None, config: Changes | None = None
    ) -> Config:
        """See `GameEnv.checked_config`; also spell out ladder and controller, and check
        that they fit each other.
        """
        if "beliefs" in as_dictionary("the configuration", changes or {}):
            raise ValueError(BELIEFS_GONE)
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
            settings.warn_of_other_values(cls.scenario, start)
        return config | {"ladder": [model.name for model in settings.models]}

    def _read(self) -> None:
        super()._read()
        settings = self.settings
        self.game = settings.game(self.scenario)
        self.counted = settings.counted
        self.costs = UNKNOWN if settings.measures else self.counted
        self._rungs = [model.name for model in settings.models]
        self._measures = settings.measures
        self._budgets = settings.controller.budget is not None

    def _reset(self) -> None:
        """Build the road, place the cars, and give them drivers."""
        states, weights = self.draw_episode(self.np_random)
        self.weights = read_only(np.asarray(weights))
        given = self.options.get("initial_states")
        if given is not None:
            states = np.array(given, dtype=float)
            shape = (self.cars, 4)
            if states.shape != shape or not np.isfinite(states).all():
                remedy = (
                    f"{self.scenario.name} needs an array {shape} of finite numbers"
                )
                raise ValueError(
                    f"options['initial_states'] is {states.tolist()}; {remedy}"
                )
            states = facing(states)
        humans = self.settings.humans
        driver = HUMAN_DRIVERS.get(self.settings.human_driver or "")
        human: Any = driver if is_vehicle(driver) else HumanVehicle
        kinds = [
            RobotVehicle,
            *[human] * humans,
            *[ScriptedVehicle] * (self.cars - 1 - humans),
        ]
        self.road = Road(straight_road(self.game), np_random=self.np_random)
        self._place(
            [
                kind(self.road, state[:2], *state[2:])
                for kind, state in zip(kinds, states, strict=True)
            ]
        )
        for car in self.road.vehicles[: 1 + humans if human is HumanVehicle else 1]:
            car.dynamics = jax.tree.map(float, self.game.world)
        self.road.objects = [
            Cone(self.road, place)
            for place in np.asarray(self.game.scene.obstacles, dtype=float)
        ]
        self.history = []
        self._collided = False
        self._drive()

    @property
    def keys_drive(self) -> bool:
        """See `ms_highway.envs.configured.ConfiguredEnv.keys_drive`; they may also
        drive a human.
        """
        return KEYBOARD in self.settings.drivers or super().keys_drive

    @property
    def cars(self) -> int:
        """Number of cars: robot, humans and scripted ones."""
        return 1 + self.settings.humans + len(self.scenario.cars[2:])

    def draw_episode(self, random: Random) -> tuple[State, HumansWeights]:
        """Draw the start of every car in SI units, and the weights of every human's
        reward.
        """
        return draw_episode(self.scenario, random, self.game.humans)

    def draw_drivers(self, random: Random) -> Int[Any, "humans"]:
        """Return the number of every human's driver, see
        `ms_highway.loop.records.HUMAN_PLANS`.
        """
        humans = self.settings.humans
        names = self.settings.drivers
        first = HUMAN_PLANS + 1  # number of the first name

        # One of two drivers is drawn for each human.
        if len(names) > 1:
            return first + (random.uniform(size=humans) < 0.5)

        # The only name drives all of them, but the keyboard the first one alone;
        # without a name, they plan.
        only = HUMAN_PLANS + len(names)
        plans = (np.arange(humans) > 0) & (names == (KEYBOARD,))
        return np.where(plans, HUMAN_PLANS, only)

    def _drive(self) -> None:
        """Give the cars their drivers."""
        cars = self.road.vehicles
        truth = replace(
            self.game, humans=replace(self.game.humans, weights=self.weights)
        )
        for place, (human, number) in enumerate(
            zip(self.humans, self.draw_drivers(self.np_random), strict=True)
        ):
            own = swap_roles(truth, place)
            name = (None, *self.settings.drivers)[number]
            added = HUMAN_DRIVERS.get(name, Keyboard) if name else None
            if is_vehicle(added):  # which drives by itself
                continue
            driver: Controller = fixed(own)
            if name:
                driver = FunctionDriver(
                    own, name, added, draw_key(added, self.np_random)
                )
            human.drive_with(driver, [car for car in cars if car is not human])
        if isinstance(self.action_type, Autopilot):
            self._drive_robot(self.game)

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

    def measure(self) -> None:
        """Measure T(M) of the ladder with the cars where they are: the median, or the
        99 % quantile for budgets.
        """
        settings = self.settings
        quantile = 0.99 if self._budgets else 0.5
        self.costs = measure_costs(
            self.game, settings.models, self.car_states, quantile, settings.way_out
        )
        if settings.costs == "measured":
            self.counted = self.costs

    @property
    def seconds(self) -> dict[str, float]:
        """See the attributes of the class."""
        return self.costs.seconds

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
        return bool(
            self.game.scene.is_reached(self.robot.position[1]) and not self._collided
        )

    @property
    def distance_to_cones(self) -> float:
        """From the robot's front to the first cone ahead in its lane, infinite without
        one [m].
        """
        return float(cone_distances(self.game.scene, self.car_states[:1])[0])

    def _simulate(self, action: Any = None) -> None:
        """Let all cars plan and move, evaluate the robot's new state, and let the agent
        pay for the model it chose.
        """
        if not self.costs.names and isinstance(self.action_type, Autopilot):
            # not at the reset: JAX must not start before the first step, so that
            # processes can fork
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

    def _info(self, obs: Any, action: Any = None) -> Config:
        """Describe the last step, see ``notebooks/REFERENCE.md``; keys, types and
        shapes are the same after a reset.
        """
        info = super()._info(obs, action)
        settings = self.settings
        streams = bool(self.scenario.streams)
        info["human_status"] = tuple(map(_status, self.humans))
        if streams:
            info["distance_to_cones"] = self.distance_to_cones
            info["success"] = info["is_success"] = self.success
        if not isinstance(self.action_type, Autopilot):
            return info

        # What drives the robot.
        step = self.robot.last_step
        controller = settings.controller
        asked = isinstance(self.action_type, HumanModelAction)
        if step:
            info |= {
                "model": step.model,
                "status": step.status,
                "choice_failed": step.choice_failed,
                "plan_steps": step.plan_steps,
                "converged": step.converged,
            }
            info["models"] = step.models
            times = step.planning_seconds, step.decision_seconds, step.compile_seconds
        else:
            info |= UNTIL_FIRST
            info["models"] = ("",) * settings.humans
            times = 0.0, 0.0, 0.0
        info["timing"] = Timing(*map(float, times))
        if controller.predicts:
            info["counted_seconds"] = (
                self.counted.of_models(step.counted_models) if step else 0.0
            )
        if controller.belief:
            info["belief"] = read_only(
                step.belief if step else first_belief(settings.humans)
            )

        # Estimates of the rule, and whether measured times had a say.
        chooses = controller.chooses and not asked
        info["gains"] = dict.fromkeys(self._rungs, NOT_ESTIMATED) if chooses else {}
        if chooses and step:
            info["gains"] |= step.highest_gains()
        clocked = self._measures and (asked or controller.chooses)
        info["clocked"] = clocked or (not asked and self._budgets)
        if streams:
            info |= {
                f"humans_{name}": info["models"].count(name) for name in self._rungs[1:]
            }
        return info


def _status(human: Any) -> str | None:
    """Return the status of a human's last step: an empty text before the first, None
    for cars that do not plan.
    """
    if not hasattr(human, "last_step"):  # highway-env's vehicles have none
        return None
    return human.last_step.status if human.last_step else ""
