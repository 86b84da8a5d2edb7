"""Let a driver of `ms_highway.add_driver` drive a robot on any road."""

from dataclasses import dataclass, field

import numpy as np
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.game.dynamics import keep_velocity
from ms_highway.game.game import Game
from ms_highway.game.scenario import driving_game
from ms_highway.loop.controller import HUMAN_DRIVERS, FunctionDriver, function_names
from ms_highway.numerics.solvers import PlanningSettings
from ms_highway.perception.scene import SHAPE, RoadScene
from ms_highway.road.driver import RoadStep
from ms_highway.road.road_planning import RoadPlanning
from ms_highway.road.road_view import RoadView, look
from ms_highway.road.road_weights import RoadWeights
from ms_highway.road.traffic_models import TRAFFIC_MODELS
from ms_highway.runtime.names import PACKAGE_NAMES


def added_drivers() -> list[str]:
    """Return the names of the drivers that a user has added and that drive robots."""
    return [
        name for name in function_names() if name not in PACKAGE_NAMES["a human driver"]
    ]


@dataclass
class AddedRoadDriver:
    """Drive a robot on any road by a driver that is made for games.

    It drives one step at a time, by a driver that a user has added. The driver sees the
    road straightened along the robot's way, see `ms_highway.road.road_view.look`: x
    along it, from the robot's rear axle, and y to its right. Its game has the robot's
    lane and one to either side, the wanted lane as the target lane, the reward of
    `ms_highway.game.scenario.COMMON_WEIGHTS`, and steps as long as the robot holds a
    control. Its speed limit is the desired speed or, if that is lower, the lane's,
    which is reduced before bends. Its state has seven cars: the robot, then those ahead
    and behind in its lane, in the lane to the left, and in the lane to the right. Where
    there is no car, a car far behind takes its place. Obstacles count as standing cars.

    Attributes:
        planning: the desired speed and the duration of a step; may be replaced between
            steps.
        name: of the driver.
        key: of the episode, see `ms_highway.add_driver`.
        weights: which are not used.
        robot: that is driven.
    """

    planning: RoadPlanning
    name: str
    key: int = 0
    weights: RoadWeights = field(default_factory=RoadWeights)
    robot: Vehicle | None = None

    def __post_init__(self) -> None:
        self._driver: FunctionDriver | None = None

    def step(self, scene: RoadScene) -> RoadStep:
        """Ask the driver, and return the record of this step."""
        view = look(self.robot, scene)
        game = self._game(view)
        if self._driver is None:
            self._driver = FunctionDriver(
                game, self.name, HUMAN_DRIVERS[self.name], self.key
            )
        self._driver.game = game
        answer = self._driver.step(view.states)

        # The driver knows a straight road with friction; the robot has a bent one
        # without.
        friction = keep_velocity(game.world, view.states[0])[1]
        assert view.scene.bend is not None
        control = np.array(
            [answer.control[0] + view.scene.bend, answer.control[1] - friction]
        )
        return RoadStep(
            control,
            plan=control[None],
            humans=np.zeros((SHAPE.paths, 0, 2)),
            models=("",) * SHAPE.paths,
            planning_seconds=answer.planning_seconds,
            ladder=TRAFFIC_MODELS,
            gains=np.full((SHAPE.paths, len(TRAFFIC_MODELS)), np.nan),
            path=np.zeros((0, 3)),
            owners=np.asarray(scene.owners),
            source="driver",
        )

    def _game(self, view: RoadView) -> Game:
        """Return the game of the driver on its straightened road."""
        limit = min(float(self.planning.desired_speed), view.speed_limit)
        steps = PlanningSettings(time_step=float(self.planning.time_step))
        return driving_game(
            view.scene, limit, planning=steps, grip=float(self.planning.grip)
        )
