"""Follow like the drivers recorded on US-101, and drive so on any highway-env road."""

from dataclasses import replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from highway_env.road.road import LaneIndex, Route
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.data.learned_drivers import RewardTraits
from ms_highway.data.learned_reward import shipped_drivers
from ms_highway.game.car_following import CAR_LIMITS, COMMUTER_IDM
from ms_highway.game.scene import Leader
from ms_highway.geometry.road_map import Lane, road_map
from ms_highway.planning.learned_driving import HELD_CONTROL, held_acceleration
from ms_highway.vehicle.right_of_way import (
    GIVING_WAY,
    highest_acceleration,
    leaves_room,
)
from ms_highway.vehicle.ways import next_lane


class FollowingVehicle(IDMVehicle):
    """Follow like the drivers recorded on US-101, each car with traits of its own.

    The acceleration maximises a reward learned from where those drivers were seconds
    later, see `ms_highway.planning.learned_driving`. Desired speed, headway and
    patience are drawn for every car by the road's random numbers. As dense traffic
    tells little about stopping, cars also brake as hard as they have to, by ``ACC_MAX``
    at most. All else is as in highway-env's `IDMVehicle`.
    """

    # Of braking; the learned reward accelerates by `CAR_LIMITS.acceleration` at most.
    ACC_MAX = CAR_LIMITS.braking

    # Deceleration where a road makes the vehicle yield [m/s^2].
    BRAKING_WHEN_TOLD = 6.0

    route: Route | None
    target_lane_index: LaneIndex

    @cached_property
    def traits(self) -> RewardTraits:
        """Traits of this car, drawn when it first acts.

        The desired speed is a share of the speed limit.
        """
        return shipped_drivers().prior.draw(self.road.np_random, 1.0)

    def act(self, action: dict | str | None = None) -> None:
        """Decide what to do in the next step; never drive backwards."""
        super().act(action)
        slowest = -GIVING_WAY.holding * self.speed
        self.action["acceleration"] = float(max(self.action["acceleration"], slowest))

    def acceleration(
        self,
        ego_vehicle: Vehicle | None,
        front_vehicle: RoadObject | None = None,
        rear_vehicle: RoadObject | None = None,
    ) -> float:
        """Return the acceleration of a vehicle behind another one [m/s^2].

        It is as if the vehicle had the traits of this car.

        Args:
            ego_vehicle: the vehicle; None and obstacles do not accelerate.
            front_vehicle: the vehicle or obstacle ahead of it.
            rear_vehicle: ignored.
        """
        if not isinstance(ego_vehicle, Vehicle):
            return 0.0
        speed = ego_vehicle.speed
        limit = ego_vehicle.lane.speed_limit or Lane.default_speed_limit
        target_speed = min(getattr(ego_vehicle, "target_speed", limit), limit)

        # A road that makes the vehicle yield sets its target speed to 0.
        if target_speed <= 0:
            return -self.BRAKING_WHEN_TOLD

        # The leader, a gap between bumpers away.
        gap = np.inf
        leader_speed = speed
        if front_vehicle:
            lengths = ego_vehicle.LENGTH + front_vehicle.LENGTH
            gap = ego_vehicle.lane_distance_to(front_vehicle) - lengths / 2
            along_lane = float(front_vehicle.velocity @ ego_vehicle.direction)
            leader_speed = max(along_lane, 0.0)
        preferred = self.preferred_acceleration(speed, target_speed, gap, leader_speed)

        # Brake as hard as it takes not to touch the leader, which keeps its speed: the
        # gap shrinks to the one in a queue while the speeds become equal.
        if gap < COMMUTER_IDM.standstill / 2:
            return -self.ACC_MAX
        room = max(gap - COMMUTER_IDM.standstill, 0.1)
        squares = max(speed**2 - leader_speed**2, 0.0)
        needed = squares / (2 * room)
        if needed > COMMUTER_IDM.comfortable_braking:
            return min(preferred, -needed)
        return preferred

    def preferred_acceleration(
        self,
        speed: float,
        target_speed: float,
        gap: float,
        leader_speed: float,
    ) -> float:
        """Return what the learned reward prefers while braking is not urgent [m/s^2].

        Args:
            speed: of the follower [m/s].
            target_speed: of the follower, the speed limit at most [m/s].
            gap: to the leader, between bumpers [m]; infinite without one.
            leader_speed: [m/s].
        """
        desired_speed = self.traits.desired_speed * target_speed
        own = self.traits._replace(desired_speed=desired_speed)
        leader = Leader(min(gap, HELD_CONTROL.free_gap), leader_speed, np.isfinite(gap))
        return float(held_acceleration(shipped_drivers().weights, own, speed, leader))


class CommuterVehicle(FollowingVehicle):
    """Drive on any highway-env road, and follow like the drivers recorded on US-101.

    The traffic there hardly stops, so that at low speeds its reward makes cars crawl:
    commuters start off as the Intelligent Driver Model does, with
    `ms_highway.game.car_following.COMMUTER_IDM`. They steer and change lanes like
    highway-env's drivers (MOBIL). Where ways cross or meet, as in roundabouts, they
    give way as `ms_highway.vehicle.right_of_way` says, and stop where a
    ``RegulatedRoad`` tells them.
    """

    def act(self, action: dict | str | None = None) -> None:
        """Decide what to do in the next step; give way, and never drive backwards."""
        super().act(action)
        if self.crashed:
            return
        acceleration = min(
            self.action["acceleration"],
            highest_acceleration(self),
            self._towards_route(),
        )
        slowest = max(-self.ACC_MAX, -GIVING_WAY.holding * self.speed)
        self.action["acceleration"] = float(max(acceleration, slowest))

    def _towards_route(self) -> float:
        """Return the highest acceleration for a change to the route's lane [m/s^2].

        The car slows down, though not hard, behind the car ahead in the lane beside,
        until a change to it is safe.
        """
        start, end, number = self.target_lane_index
        if not self.route or self.route[0][:2] != (start, end):
            return np.inf
        route_number = self.route[0][2]
        if route_number in (None, number):
            return np.inf
        beside = (start, end, number + int(np.sign(route_number - number)))
        ahead, _ = self.road.neighbour_vehicles(self, beside)
        slowest = -float(COMMUTER_IDM.comfortable_braking)
        return max(self.acceleration(self, ahead), slowest)

    def mobil(self, lane_index: LaneIndex) -> bool:
        """Return whether to change to a lane.

        The car does if MOBIL says so, and nobody who enters it has to brake hard.
        """
        return bool(super().mobil(lane_index)) and leaves_room(self, lane_index)

    def follow_road(self) -> None:
        """Go on to the next lane at the end of a lane.

        If the route begins too far aside, go on and plan another one.
        """
        network = self.road.network
        lane = road_map(network).lanes[self.target_lane_index]
        if self.route and lane.shape.after_end(self.position):
            following = next_lane(lane, tuple(self.route))
            roads = [leg[:2] for leg in self.route]
            if following and following.index[:2] not in roads:
                path = network.shortest_path(following.end, self.route[-1][1])
                legs = [(start, end, None) for start, end in pairwise(path)]
                self.route = [following.index, *legs]
                self.target_lane_index = following.index
                return
        super().follow_road()

    def acceleration(
        self,
        ego_vehicle: Vehicle | None,
        front_vehicle: RoadObject | None = None,
        rear_vehicle: RoadObject | None = None,
    ) -> float:
        """Return the acceleration of a vehicle behind what is ahead of it [m/s^2].

        Args:
            ego_vehicle: the vehicle; None and obstacles do not accelerate.
            front_vehicle: what highway-env has found ahead of it.
            rear_vehicle: ignored.
        """
        known = isinstance(ego_vehicle, Vehicle) and front_vehicle is not None
        if known and not _is_ahead(ego_vehicle, front_vehicle):
            front_vehicle = None
        return super().acceleration(ego_vehicle, front_vehicle)

    def preferred_acceleration(
        self,
        speed: float,
        target_speed: float,
        gap: float,
        leader_speed: float,
    ) -> float:
        """Return what the learned reward prefers, or more where that crawls [m/s^2].

        See `ms_highway.vehicle.commuter.FollowingVehicle.preferred_acceleration`.
        """
        learned = super().preferred_acceleration(speed, target_speed, gap, leader_speed)
        idm = replace(COMMUTER_IDM, headway=float(self.traits.headway))
        starting = float(idm.acceleration(speed, target_speed, gap, leader_speed))
        return max(learned, starting)


def _is_ahead(vehicle: Vehicle, front: RoadObject) -> bool:
    """Return whether what highway-env finds ahead of a vehicle is ahead of it.

    highway-env also searches lanes that are connected with the vehicle's lane. On their
    straight or circular continuation it finds vehicles that are behind, and oncoming
    vehicles in the lane beside.
    """
    lengths = vehicle.LENGTH + front.LENGTH
    if vehicle.lane_distance_to(front) < -lengths / 2:
        return False
    oncoming = float(vehicle.direction @ front.direction) < 0.0
    return not oncoming or bool(vehicle.lane.on_lane(front.position, margin=1.0))
