"""Define goals in time: a spot on a lane with intervals of time and speed, and the
speed on the way there.
"""

from dataclasses import dataclass, replace
from itertools import islice
from math import sqrt
from typing import TypeAlias

import numpy as np
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.geometry.lane_paths import Point
from ms_highway.geometry.road_map import MAX_ROADS, Spot, road_map
from ms_highway.road.added import AddedRoadDriver
from ms_highway.road.driver import RoadDriver
from ms_highway.road.lost_speed import VALUE_GRID
from ms_highway.road.road_weights import RoadWeights

TIME_MARGIN = 2.0  # s, largest margin to the ends of the interval of time
LOOK_AHEAD = 1.0  # s, after which the speed on the way there is taken
MAX_SPEED_GAIN = 3.0  # m/s, largest excess of the desired speed over the present one
SPEED_MARGIN = 0.5  # m/s, largest margin to the ends of the interval of speeds
# weight of lane changes to the spot, more than that of slow traffic in its lane
GOAL_WEIGHT = 20.0
MIN_SPEED = 0.1  # m/s, lowest desired speed
SOON = 0.1  # s, shortest time to be there
CLOSE_TIME, CLOSE_GAP = 1.0, 2.0  # s and m, gap below which a follower counts as close
GENTLE_BRAKING, STOP_MARGIN = 1.5, 1.0  # m/s^2 and m, of braking before the spot


@dataclass(frozen=True)
class TimedGoal:
    """A spot on a lane where the robot has to be within intervals of time and speed.

    Attributes:
        spot: on a lane.
        position: of the spot [m].
        times: interval of the time there [s].
        speeds: interval of the speed there [m/s].
    """

    spot: Spot
    position: Point
    times: tuple[float, float]
    speeds: tuple[float, float]

    def distance(self, vehicle: Vehicle) -> float:
        """Return the distance to the spot along a vehicle's lanes [m], negative if the
        spot is behind it.
        """
        roads = road_map(vehicle.road.network)
        own = roads.lanes[vehicle.lane_index]
        passed = 0.0
        for lane in islice(roads.goal(self.spot).onward(own), MAX_ROADS):
            if lane.index[:2] == self.spot.lane[:2]:
                passed += float(lane.shape.local_coordinates(self.position)[0])
                break
            passed += lane.length
        else:  # the spot is behind
            return self.spot.place - float(
                roads.lanes[self.spot.lane].shape.local_coordinates(vehicle.position)[0]
            )
        return passed - float(own.shape.local_coordinates(vehicle.position)[0])

    def desired_speed(self, vehicle: Vehicle, now: float) -> float:
        """Return the desired speed of a vehicle on its way to the spot [m/s].

        Of the constant accelerations that lead there in time, ``s = v t + a t^2 / 2``,
        and to an allowed speed there, ``v + a t = 2 s / t - v``, take the smallest;
        return the speed after a second. The vehicle is no slower than a close follower
        as long as it can still slow down before the spot.

        Args:
            vehicle: drives to the spot.
            now: the time [s].
        """
        left = self.distance(vehicle)
        speed = float(vehicle.speed)
        if left <= 0 and now > self.times[0]:
            return max(speed, MIN_SPEED)
        within = min(SPEED_MARGIN, (self.speeds[1] - self.speeds[0]) / 2)
        ends = (
            self.speeds[1] - within,
            self.speeds[0] + (within if self.speeds[0] > 0 else 0.0),
        )
        soonest, latest = (
            2 * max(left, 0.0) / max(speed + end, MIN_SPEED) for end in ends
        )
        first, last = (max(time - now, SOON) for time in self.times)
        if max(first, soonest) <= min(
            last, latest
        ):  # there is a time with an allowed speed
            first = max(first, soonest)
            last = min(last, latest)
        spare = min((last - first) / 2, TIME_MARGIN)
        time = min(max(left / max(speed, MIN_SPEED), first + spare), last - spare)
        acceleration = 2 * (left - speed * time) / time**2
        wanted = speed + min(acceleration * min(LOOK_AHEAD, time), MAX_SPEED_GAIN)
        return max(
            wanted,
            min(
                _follower_speed(vehicle),
                sqrt(2 * GENTLE_BRAKING * max(left - STOP_MARGIN, 0.0)),
            ),
            MIN_SPEED,
        )

    def guide(
        self, driver: RoadDriver | AddedRoadDriver, vehicle: Vehicle, now: float
    ) -> None:
        """Let a vehicle's driver plan to be there in time; the speed after that time
        has no value.

        Args:
            driver: of the vehicle.
            vehicle: drives to the spot.
            now: the time [s].
        """
        planning = driver.planning
        weights = RoadWeights()
        rest = (
            self.times[1] - now - planning.steps * float(planning.time_step)
        ) / VALUE_GRID.seconds
        terminal = float(weights.terminal) * min(max(rest, 0.0), 1.0)
        driver.planning = replace(
            planning, desired_speed=self.desired_speed(vehicle, now)
        )
        driver.weights = replace(weights, goal=GOAL_WEIGHT, terminal=terminal)


RobotGoal: TypeAlias = str | TimedGoal | None
"""A node of the road network to drive to, a goal in time, or None."""


def _follower_speed(vehicle: Vehicle) -> float:
    """Return the speed of a close follower in a vehicle's lane [m/s], 0 without one."""
    _, rear = vehicle.road.neighbour_vehicles(vehicle)
    if rear is None:
        return 0.0
    gap = (
        float(np.linalg.norm(rear.position - vehicle.position))
        - (rear.LENGTH + vehicle.LENGTH) / 2
    )
    return float(rear.speed) if gap < CLOSE_TIME * rear.speed + CLOSE_GAP else 0.0
