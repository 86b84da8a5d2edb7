"""Define goals in time, and the speed on the way there.

A goal is a spot on a lane with intervals of time and speed.
"""

from dataclasses import dataclass, replace
from itertools import islice
from math import sqrt
from typing import TypeAlias

import numpy as np
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.geometry.lane_paths import Point
from ms_highway.geometry.road_map import Goal, Spot, road_map
from ms_highway.road.added import AddedRoadDriver
from ms_highway.road.cost_to_go import VALUE_GRID
from ms_highway.road.driver import RoadDriver
from ms_highway.road.road_weights import RoadWeights


@dataclass(frozen=True)
class TimedDriving:
    """Set how a vehicle drives to a spot in time."""

    time_margin: float = 2.0
    """Largest margin to the ends of the interval of time [s]."""
    speed_margin: float = 0.5
    """Largest margin to the ends of the interval of speeds [m/s]."""
    look_ahead: float = 1.0
    """Time after which the speed on the way there is taken [s]."""
    largest_gain: float = 3.0
    """Largest excess of the desired speed over the present one [m/s]."""
    lowest_speed: float = 0.1
    """Lowest desired speed [m/s]."""
    shortest_time: float = 0.1
    """Shortest time to be there [s]."""
    goal_weight: float = 20.0
    """Weight of lane changes to the spot, more than that of slow traffic there."""
    follower_headway: float = 1.0
    """Time gap, besides `follower_gap`, below which a follower is close [s]."""
    follower_gap: float = 2.0
    """Gap between standing cars below which a follower is close [m]."""
    braking: float = 1.5
    """Gentle deceleration before the spot [m/s^2]."""
    stop_margin: float = 1.0
    """Distance before the spot at which gentle braking would end [m]."""


TIMED_DRIVING = TimedDriving()


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
        """Return the distance to the spot along a vehicle's lanes [m].

        It is negative if the spot is behind the vehicle.
        """
        roads = road_map(vehicle.road.network)
        own = roads.lanes[vehicle.lane_index]
        passed = 0.0
        for lane in islice(roads.goal(self.spot).lanes_from(own), Goal.max_roads):
            if lane.index[:2] == self.spot.lane[:2]:
                passed += float(lane.shape.local_coordinates(self.position)[0])
                break
            passed += lane.length
        else:  # the spot is behind
            goal_lane = roads.lanes[self.spot.lane].shape
            place, _ = goal_lane.local_coordinates(vehicle.position)
            return self.spot.place - float(place)
        place, _ = own.shape.local_coordinates(vehicle.position)
        return passed - float(place)

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
        distance = self.distance(vehicle)
        speed = float(vehicle.speed)
        lowest = TIMED_DRIVING.lowest_speed
        if distance <= 0 and now > self.times[0]:
            return max(speed, lowest)

        # The constant acceleration that leads there in time, s = v t + a t^2 / 2, and
        # the speed that it gives within a second.
        time = self._time_left(distance, speed, now)
        acceleration = 2 * (distance - speed * time) / time**2
        gain = acceleration * min(TIMED_DRIVING.look_ahead, time)
        in_time = speed + min(gain, TIMED_DRIVING.largest_gain)

        # A follower's speed, if the vehicle can still brake gently before the spot.
        room = max(distance - TIMED_DRIVING.stop_margin, 0.0)
        stopping = sqrt(2 * TIMED_DRIVING.braking * room)
        with_follower = min(_follower_speed(vehicle), stopping)
        return max(in_time, with_follower, lowest)

    def _time_left(self, distance: float, speed: float, now: float) -> float:
        """Return the time until a vehicle should be at the spot [s].

        It is the time at its present speed, within the interval of time and, if there
        is such a time, such that the speed at the spot ``2 s / t - v`` is allowed.

        Args:
            distance: to the spot [m].
            speed: of the vehicle [m/s].
            now: the time [s].
        """
        # The interval of speeds, less a margin; no margin to a standstill.
        slowest, fastest = self.speeds
        margin = min(TIMED_DRIVING.speed_margin, (fastest - slowest) / 2)
        fastest = fastest - margin
        slowest = slowest + (margin if slowest > 0 else 0.0)

        # The times at which the vehicle gets there with these speeds.
        way = 2 * max(distance, 0.0)
        soonest = way / max(speed + fastest, TIMED_DRIVING.lowest_speed)
        latest = way / max(speed + slowest, TIMED_DRIVING.lowest_speed)

        # The interval of time, narrowed to these times where both have times in common.
        earliest, deadline = self.times
        first = max(earliest - now, TIMED_DRIVING.shortest_time)
        last = max(deadline - now, TIMED_DRIVING.shortest_time)
        if max(first, soonest) <= min(last, latest):
            first = max(first, soonest)
            last = min(last, latest)

        margin = min((last - first) / 2, TIMED_DRIVING.time_margin)
        at_this_speed = distance / max(speed, TIMED_DRIVING.lowest_speed)
        return min(max(at_this_speed, first + margin), last - margin)

    def guide(
        self,
        driver: RoadDriver | AddedRoadDriver,
        vehicle: Vehicle,
        now: float,
    ) -> None:
        """Let a vehicle's driver plan to be there in time.

        The speed after that time has no value.

        Args:
            driver: of the vehicle.
            vehicle: drives to the spot.
            now: the time [s].
        """
        planning = driver.planning
        weights = RoadWeights()

        # The share of the seconds after a plan that are before the latest time there.
        plan_end = planning.steps * float(planning.time_step)
        _, deadline = self.times
        share = (deadline - now - plan_end) / VALUE_GRID.seconds
        terminal = float(weights.terminal) * min(max(share, 0.0), 1.0)

        desired_speed = self.desired_speed(vehicle, now)
        driver.planning = replace(planning, desired_speed=desired_speed)
        driver.weights = replace(
            weights, goal=TIMED_DRIVING.goal_weight, terminal=terminal
        )


RobotGoal: TypeAlias = str | TimedGoal | None
"""A node of the road network to drive to, a goal in time, or None."""


def _follower_speed(vehicle: Vehicle) -> float:
    """Return the speed of a close follower in a vehicle's lane [m/s], 0 without one."""
    _, rear = vehicle.road.neighbour_vehicles(vehicle)
    if rear is None:
        return 0.0
    distance = float(np.linalg.norm(rear.position - vehicle.position))
    gap = distance - (rear.LENGTH + vehicle.LENGTH) / 2
    close = TIMED_DRIVING.follower_headway * rear.speed + TIMED_DRIVING.follower_gap
    return float(rear.speed) if gap < close else 0.0
