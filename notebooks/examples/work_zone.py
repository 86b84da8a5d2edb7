"""Drive a robot through a scene of your own: a work zone.

Its collisions are highway-env's own. The robot's controller plays a `ms_highway.Game`,
which says where the lanes are and what both drive for; everything else is highway-env.
Humans are commuters, who keep clear of who comes into their lane. Algorithm 1 mostly
plans naively, and by theory of mind for some steps while the robot merges. Run::

    python notebooks/examples/work_zone.py
"""

import gymnasium as gym
import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.objects import Obstacle

from ms_highway import (
    COMMON_WEIGHTS,
    PUBLISHED_COSTS,
    Autopilot,
    CommuterVehicle,
    Costs,
    Driver,
    RobotVehicle,
    Scene,
    Switching,
    driving_game,
    ladder,
)

SCENE = Scene(  # what planners know of the road; metres, y to the right
    lanes=np.array([0.0, 4.0]),
    lane_width=4.0,
    obstacles=np.array([[160.0, 4.0]]),
    obstacle_size=np.array([2.0, 2.0]),
    target_lane=0.0,
)
GAME = driving_game(
    SCENE, 20.0, {**COMMON_WEIGHTS, "target_lane": 150}
)  # what robot and partner drive for
LADDER = ladder(["naive", "turn", "tom"])
COSTS = Costs.of(PUBLISHED_COSTS, 1)  # T(M) [s], with one human


class WorkZoneEnv(AbstractEnv):
    """The robot's lane, the right one, is closed after 60 m; in the left lane,
    commuters drive.
    """

    @classmethod
    def default_config(cls):
        rates = {
            "simulation_frequency": 10,
            "policy_frequency": 10,
        }  # plans are made of steps of 0.1 s
        return {**super().default_config(), **rates, "duration": 6, "lambda": 0.1}

    def define_spaces(self):
        super().define_spaces()
        self.action_type = Autopilot(self)  # the robot drives itself
        self.action_space = self.action_type.space()

    def _reset(self):
        self.road = Road(
            RoadNetwork.straight_road_network(2, length=1000, speed_limit=20),
            np_random=self.np_random,
        )
        self.road.objects = [
            Obstacle(self.road, position) for position in SCENE.obstacles
        ]
        robot = RobotVehicle(self.road, [100.0, 4.0], speed=20)
        starts = 96.0, 82.0, 112.0
        humans = [
            CommuterVehicle(self.road, [x + self.np_random.normal(), 0.0], speed=20)
            for x in starts
        ]
        for human in humans:
            human.enable_lane_change = False  # into the lane that is closed
        robot.drive_with(
            Driver(GAME, Switching(COSTS, self.config["lambda"], LADDER)), humans
        )  # partner first
        self.road.vehicles = [robot, *humans]
        self.controlled_vehicles = [robot]

    def _reward(self, action):
        return self.vehicle.speed / 20 - self.vehicle.crashed

    def _is_terminated(self):
        return self.vehicle.crashed

    def _is_truncated(self):
        return self.steps >= 10 * self.config["duration"]


gym.register("work-zone-v0", WorkZoneEnv)

if __name__ == "__main__":
    env = gym.make("work-zone-v0", render_mode="rgb_array")
    env.reset(seed=0)
    models = [env.step(0) and env.unwrapped.vehicle.last_step.model for _ in range(60)]
    print(models, env.unwrapped.vehicle.position, env.unwrapped.vehicle.crashed)
