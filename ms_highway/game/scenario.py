"""Define scenarios (geometry, rewards, starts, noise) and build their games in any unit of length.

The numbers of a `Scenario` are in the paper's unit of length, 100/3 m: a
car of 0.15 x 0.075 is 5 m x 2.5 m and a speed of 0.6 per second is 20 m/s.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import jax
import numpy as np
from jaxtyping import Float

from ms_highway.game.dynamics import Dynamics
from ms_highway.game.game import Game
from ms_highway.game.planning_settings import PAPER_PLANNING, PlanningSettings, gradient_steps
from ms_highway.game.reward import Reward, features_for, linear_reward
from ms_highway.game.scene import Scene
from ms_highway.optimization.second_derivatives import Influence
from ms_highway.optimization.solvers import Planner, Solver

__all__ = [
    "COMMON_WEIGHTS",
    "GRIP",
    "PAPER_UNIT",
    "PHYSICAL_LIMIT",
    "TIME_STEP",
    "Scenario",
    "Semantics",
    "build_game",
    "draw_starts",
    "driving_game",
    "title",
]

Semantics: TypeAlias = Literal["paper", "released"]

PAPER_UNIT = 100 / 3  # m

CAR_SIZE = (0.15, 0.075)  # paper units
CONE_SIZE = (0.07, 0.0561166667)  # paper units
LANE_WIDTH = 0.1  # paper units
SPEED_LIMIT = 0.6  # paper units per second
TIME_STEP = 0.1  # s
PAPER_FRICTION = 0.2  # 1/s; the paper gives no value of alpha
RELEASED_DRAG = 0.2  # per paper unit, in the world only: the released planners neglect it

PAPER_DYNAMICS = Dynamics("curvature", "linear", PAPER_FRICTION, TIME_STEP)
"""The paper's dynamics with friction, Sec. IV-A; the same in any unit of length."""

PHYSICAL_LIMIT = (0.2, 50.0)  # 1/m and m/s^2
"""Default bounds on plans: the curvature of a front wheel turned by 45 degrees, and five times the grip of tyres.

The paper's scenes are infeasible within the grip of tyres: at 20 m/s a horizon of half a second sees a cone only 10 m
ahead, so that gradient plans in Stay Back need 50 m/s^2, and the human in Merger yields with up to 21 m/s^2.
"""

GRIP = 8.0  # m/s^2
"""Grip of tyres on a dry road, steering and acceleration together.

Outside the paper's scenes, and in them on request, the first control of every plan and all executed controls keep to
it; later controls of a plan may exceed it by a quarter (`ms_highway.game.game.bounded`).
"""

COMMON_WEIGHTS = {"speed": 2, "lane_alignment": 75, "collision_risk": -1, "collision": -100, "off_road": -2500}
"""Weights that every driver of every scenario has."""

POSITION_NOISE = 5e-4  # standard deviation, paper units
MOTION_NOISE = 1e-3  # standard deviation of speed [paper units per second] and heading [rad]
MERGING_NOISE = 0.01  # further standard deviation of the merging car's x, paper units


@dataclass(frozen=True)
class Scenario:
    """One of the paper's situations.

    Attributes:
        name: in commands and records.
        lanes: lateral position of each lane's centre.
        cars: start (x, y) of the robot, the human, and the scripted cars; all start at the speed limit, heading 0.
        steps: length of an episode.
        ladder: names of the human models that the paper compares, cheapest first.
        prices: the paper's two lambdas, aggressive and conservative [reward per second].
        robot_weights, human_weights: reward weights by feature.
        robot_gap, human_gap: distance behind the leader at which the gap feature is highest.
        cones: centres of the cones.
        merging_car: index of the car with additional noise on its start.
        corner: see `Scene`.
    """

    name: str
    lanes: tuple[float, ...]
    cars: tuple[tuple[float, float], ...]
    steps: int
    ladder: tuple[str, ...]
    prices: tuple[float, float]
    robot_weights: Mapping[str, float]
    human_weights: Mapping[str, float]
    robot_gap: float = 0.0
    human_gap: float = 0.0
    cones: tuple[tuple[float, float], ...] = ()
    merging_car: int | None = None
    corner: float = 0.5


def title(name: str) -> str:
    """Return the title of a scenario's name: ``Stay Back`` for ``stay_back``."""
    return name.replace("_", " ").title()


def build_game(
    scenario: Scenario,
    semantics: Semantics = "paper",
    influence: Influence = "damped",
    control_limit: tuple[float, float] | None = None,
    grip: float | None = None,
    unit: float = PAPER_UNIT,
    solver: Solver = "gradient",
    human_driving: Mapping[str, float] | None = None,
    planning: PlanningSettings = PAPER_PLANNING,
) -> Game:
    """Build the game of a scenario.

    Args:
        scenario: to build.
        semantics: ``paper``: the paper's dynamics with friction, in the world and in the planners; ``released``: the
            released code's, where planners ignore the world's drag.
        influence: form of the human's response, see `ms_highway.optimization.second_derivatives.response`.
        control_limit: bounds on the magnitude of omega and acceleration in plans, in the units of the semantics.
        grip: total acceleration that tyres hold, in the game's lengths per s^2, see `Planner`.
        unit: length of one paper unit in the game; 1 keeps the released code's numbers.
        solver: how plans are improved, see `ms_highway.optimization.solvers.optimize_controls`.
        human_driving: weights by name that replace `COMMON_WEIGHTS` in the human's reward; the other weights of the
            scenario stay unless they are named here.
        planning: horizon and gradient steps of both, and the time step of plans and world.
    """
    human_weights = scenario.human_weights
    if human_driving is not None:
        aims = {name: weight for name, weight in human_weights.items() if name not in COMMON_WEIGHTS}
        human_weights = {**aims, **human_driving}
    scene = Scene(
        lanes=np.array(scenario.lanes) * unit,
        lane_width=LANE_WIDTH * unit,
        obstacles=np.array(scenario.cones).reshape(-1, 2) * unit,
        obstacle_size=np.array(CONE_SIZE) * unit,
        car_size=np.array(CAR_SIZE) * unit,
        corner=scenario.corner,
        target_lane=min(scenario.lanes) * unit,
        length_unit=unit,
        leader=2 if len(scenario.cars) > 2 else None,
    )
    names = features_for(scenario.robot_weights, human_weights)
    robot = linear_reward(scenario.robot_weights, SPEED_LIMIT * unit, scenario.robot_gap * unit, names)
    human = linear_reward(human_weights, SPEED_LIMIT * unit, scenario.human_gap * unit, names)
    if semantics == "paper":
        plans = world = PAPER_DYNAMICS
    else:
        plans = Dynamics("yaw_rate", "linear", 0.0, TIME_STEP)
        world = Dynamics("yaw_rate", "quadratic", RELEASED_DRAG / unit, TIME_STEP)
    game = _game(scene, robot, human, plans, world, control_limit, grip, influence, solver, planning)
    return jax.tree.map(lambda number: np.asarray(number, dtype=np.float32), game)


def driving_game(
    scene: Scene,
    speed_limit: float,
    weights: Mapping[str, float] = COMMON_WEIGHTS,
    names: tuple[str, ...] | None = None,
    solver: Solver = "gradient",
    planning: PlanningSettings = PAPER_PLANNING,
    grip: float | None = GRIP,
) -> Game:
    """Build a game on any scene in which both cars have the same reward, with the paper's dynamics.

    Its numbers are not converted to arrays: a driver on a road builds it at every step, and the conversion would take
    longer than the plan.

    Args:
        scene: road, obstacles and bodies.
        speed_limit: speed that is rewarded most [m/s].
        weights: of the reward of both, by name.
        names: of the features to compute, see `ms_highway.game.reward.linear_reward`.
        solver: how plans are improved, see `ms_highway.optimization.solvers.optimize_controls`.
        planning: see `build_game`.
        grip: of tyres [m/s^2], see `ms_highway.optimization.solvers.Planner`; None for plans that are only limited by
            `PHYSICAL_LIMIT`.
    """
    driver = linear_reward(weights, speed_limit, names=names)
    motion, limit = PAPER_DYNAMICS, PHYSICAL_LIMIT
    return _game(scene, driver, driver, motion, motion, limit, grip, "damped", solver, planning)


def _game(
    scene: Scene,
    robot: Reward,
    human: Reward,
    plans: Dynamics,
    world: Dynamics,
    control_limit: tuple[float, float] | None,
    grip: float | None,
    influence: Influence,
    solver: Solver,
    planning: PlanningSettings,
) -> Game:
    """Build a game with the control scale in which a gradient step of 0.03 has the paper's effect.

    The unit of acceleration is one length unit per s^2, that of omega one rad/s of yaw rate. With steering by
    curvature, it is converted at the paper's speed limit, ``omega = yaw_rate / v``: omega's gradient step scales with
    1/v^2.
    """
    plans, world = (replace(motion, time_step=planning.time_step) for motion in (plans, world))
    iterations, step_size = gradient_steps(planning)
    turn_scale = 1 / (SPEED_LIMIT * scene.length_unit) if plans.steering == "curvature" else 1.0
    planner = Planner(
        control_scale=np.array([turn_scale, scene.length_unit]),
        control_limit=np.full(2, np.inf) if control_limit is None else np.array(control_limit),
        grip=grip,
        step_size=step_size,
        horizon=planning.horizon,
        iterations=iterations,
        solver=solver,
    )
    return Game(scene, robot, human, plans, world, planner, influence)


def draw_starts(
    scenario: Scenario, random: np.random.Generator, unit: float = PAPER_UNIT
) -> Float[np.ndarray, "cars 4"]:
    """Draw the start of every car, with the noise of the paper's experiments.

    Normal noise of standard deviation 5e-4 units on x and y and 1e-3 on speed and heading; another 0.01 units on the x
    of the merging car.
    """
    cars = np.array([(x, y, 0.0, SPEED_LIMIT) for x, y in scenario.cars])
    noise = [POSITION_NOISE, POSITION_NOISE, MOTION_NOISE, MOTION_NOISE]
    cars += random.normal(scale=noise, size=cars.shape)
    if scenario.merging_car is not None:
        cars[scenario.merging_car, 0] += random.normal(scale=MERGING_NOISE)
    return cars * [unit, unit, 1.0, unit]
