"""Drive on any highway-env road like the drivers recorded on US-101, who give way where ways meet."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from highway_env.road.road import LaneIndex
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.game.learned_drivers import RewardTraits
from ms_highway.game.learned_reward import shipped_drivers
from ms_highway.game.scene import Leader
from ms_highway.geometry.road_map import LIMIT, road_map
from ms_highway.planning.learned_driving import FREE_GAP, held_acceleration
from ms_highway.planning.manoeuvres import idm_acceleration
from ms_highway.vehicle.right_of_way import GIVING_WAY, highest_acceleration, leaves_room, next_lane


@dataclass(frozen=True)
class BesideReward:
    """How commuters drive where the learned reward, of dense traffic that hardly stops, tells little.

    Attributes:
        free: acceleration from standstill on a free road [m/s^2]. The learned one is below 0.2 without a car ahead, as
            there nearly always was one.
        calm: necessary deceleration up to which the learned reward decides [m/s^2].
        stopped: gap that is left behind a standing vehicle [m].
        when_told: deceleration where a road makes a car yield [m/s^2].
    """

    free: float = 2.0
    calm: float = 1.5
    stopped: float = 2.0
    when_told: float = 6.0


BESIDE_REWARD = BesideReward()


class CommuterVehicle(IDMVehicle):
    """Drive like the drivers recorded on US-101, each car with traits of its own.

    The acceleration maximises a reward learned from where those drivers were seconds later, see
    `ms_highway.planning.learned_driving`. Desired speed, headway and patience are drawn for every car by the road's
    random numbers. As dense traffic tells little about stopping, commuters also brake as hard as they have to, by
    ``ACC_MAX`` at most.

    Commuters steer and change lanes like highway-env's drivers (MOBIL). Where ways cross or meet, as in roundabouts,
    they give way as `ms_highway.vehicle.right_of_way` says, and stop where a ``RegulatedRoad`` tells them.
    """

    ACC_MAX = 8.0  # m/s^2, of braking; they accelerate by 4 at most

    @cached_property
    def traits(self) -> RewardTraits:
        """Traits of this car, with the desired speed as a share of the speed limit; drawn when it first acts."""
        return shipped_drivers().prior.draw(self.road.np_random, 1.0)

    def act(self, action: Any = None) -> None:
        """Decide what to do in the next step; never drive backwards."""
        super().act(action)
        if self.crashed:
            return
        acceleration = min(self.action["acceleration"], highest_acceleration(self), self._towards_route())
        acceleration = max(acceleration, -self.ACC_MAX, -GIVING_WAY.holding * self.speed)
        self.action["acceleration"] = float(acceleration)

    def _towards_route(self) -> float:
        """Return the highest acceleration with which this car can change to the lane that its route asks for [m/s^2].

        It slows down, though not hard, behind the car ahead in the lane beside, until a change to it is safe.
        """
        start, end, number = self.target_lane_index
        wanted = self.route[0] if self.route else None
        if wanted is None or wanted[:2] != (start, end) or wanted[2] in (None, number):
            return np.inf
        beside = start, end, number + int(np.sign(wanted[2] - number))
        ahead, _ = self.road.neighbour_vehicles(self, beside)
        return max(self.acceleration(self, ahead), -BESIDE_REWARD.calm)

    def mobil(self, lane_index: LaneIndex) -> bool:
        """Return whether to change to a lane: if MOBIL says so, and nobody who enters it has to brake hard."""
        return bool(super().mobil(lane_index)) and leaves_room(self, lane_index)

    def follow_road(self) -> None:
        """Go on to the next lane at the end of a lane; if the route begins too far aside, go on to plan another one."""
        network = self.road.network
        lane = road_map(network).lanes[self.target_lane_index]
        if self.route and lane.shape.after_end(self.position):
            following = next_lane(lane, tuple(self.route))
            if following and all(leg[:2] != following.index[:2] for leg in self.route):
                path = network.shortest_path(following.end, self.route[-1][1])
                self.route = [following.index, *((start, end, None) for start, end in pairwise(path))]
                self.target_lane_index = following.index
                return
        super().follow_road()

    def acceleration(
        self, ego_vehicle: Vehicle | None, front_vehicle: RoadObject | None = None, rear_vehicle: Any = None
    ) -> float:
        """Return the acceleration of a vehicle behind another one, as if it had the traits of this car [m/s^2].

        Args:
            ego_vehicle: the vehicle; None and obstacles do not accelerate.
            front_vehicle: the vehicle or obstacle ahead of it.
            rear_vehicle: ignored.
        """
        if not isinstance(ego_vehicle, Vehicle):
            return 0.0
        speed = ego_vehicle.speed
        limit = ego_vehicle.lane.speed_limit or LIMIT
        wanted = min(getattr(ego_vehicle, "target_speed", limit), limit)
        if wanted <= 0:  # the road makes the vehicle yield
            return -BESIDE_REWARD.when_told

        # The leader, a gap between bumpers away.
        if front_vehicle and not _is_ahead(ego_vehicle, front_vehicle):
            front_vehicle = None
        gap = np.inf
        leader_speed = speed
        if front_vehicle:
            lengths = ego_vehicle.LENGTH + front_vehicle.LENGTH
            gap = ego_vehicle.lane_distance_to(front_vehicle) - lengths / 2
            leader_speed = max(float(front_vehicle.velocity @ ego_vehicle.direction), 0.0)

        # What the learned reward prefers, or more where traffic is slow.
        own = self.traits._replace(
            desired_speed=self.traits.desired_speed * wanted,
        )
        leader = Leader(min(gap, FREE_GAP), leader_speed, front_vehicle is not None)
        learned = float(held_acceleration(shipped_drivers().weights, own, speed, leader))
        starting = idm_acceleration(
            speed,
            wanted,
            gap,
            leader_speed,
            headway=own.headway,
            standstill=BESIDE_REWARD.stopped,
            strongest=BESIDE_REWARD.free,
            braking=BESIDE_REWARD.calm,
        )
        wish = max(learned, float(starting))

        # Brake as hard as it takes not to touch the leader.
        if gap < BESIDE_REWARD.stopped / 2:
            return -self.ACC_MAX
        room = max(gap - BESIDE_REWARD.stopped, 0.1)
        needed = max(speed**2 - leader_speed**2, 0.0) / (2 * room)
        return min(wish, -needed) if needed > BESIDE_REWARD.calm else wish


def _is_ahead(vehicle: Vehicle, front: RoadObject) -> bool:
    """Return whether what highway-env finds ahead of a vehicle is ahead of it.

    highway-env also searches lanes that are connected with the vehicle's lane. On their straight or circular
    continuation it finds vehicles that are behind, and oncoming vehicles in the lane beside.
    """
    if vehicle.lane_distance_to(front) < -(vehicle.LENGTH + front.LENGTH) / 2:
        return False
    oncoming = float(vehicle.direction @ front.direction) < 0.0
    return not oncoming or bool(vehicle.lane.on_lane(front.position, margin=1.0))
