"""Turn a driver's view of a highway-env road into the scene of a game, straightened along the driver's route.

Arrays have the same shapes for all roads and any number of vehicles, so that plans are compiled once.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.game.scene import Scene, far_behind, places
from ms_highway.geometry.curve import BEHIND, SPACING, Curve, interpolate
from ms_highway.geometry.lane_paths import Point, Row
from ms_highway.geometry.road_map import LIMIT
from ms_highway.perception.observation import observe_road
from ms_highway.perception.scene import RoadScene
from ms_highway.planning.manoeuvres import idm_acceleration
from ms_highway.runtime.arrays import State

TAPER = (80.0, 20.0)  # m before its end, between which a lane merges with its neighbour
BENDS_SEEN = 60.0  # m ahead
STRAIGHT = 1e-6  # 1/m, the curvature of a straight road
CORNERING = 6.0  # m/s^2, lateral, in bends ahead: less than tyres hold, so that steering is possible while braking
SLOWING = 3.0  # m/s^2, deceleration before bends
MIN_SPEED = 3.0  # m/s, in any bend

HEADWAY, STANDSTILL = 0.5, 2.0  # s and m between bumpers: shorter than drivers choose themselves
LANES_BESIDE = 0.3  # m between sides, below which others are in the way
WATCHED_TIMES = np.array([0.0, 0.5, 1.0, 1.5, 2.0])  # s from now, at which others may be in the way
FREE_GAP = 1e3  # m/s, so high that no desired speed limits the acceleration


@dataclass(frozen=True)
class RoadView:
    """Surroundings of a driver in the coordinates of its route: s along it, d to its right.

    Attributes:
        seen: what a robot would see in the driver's place.
        others: states of others on all their possible ways at `WATCHED_TIMES` from now, at constant speed
            [traffic, times, 4]; crashed vehicles stay where they are.
        scene: the lane to the left, the driver's lane and the lane to the right; a closed lane repeats the driver's.
            Where the driver's lane ends, its centre moves to the target lane's, so that the driver merges.
        states: of the driver and its neighbours; obstacles count as standing cars.
        speed_limit: of the lane, reduced before bends [m/s].
    """

    seen: RoadScene
    others: State
    scene: Scene
    states: State
    speed_limit: float

    def clear_acceleration(self, times: int) -> float:
        """Return the highest acceleration that keeps clear of others by the Intelligent Driver Model, or infinity.

        A vehicle counts as the car ahead if it is in the driver's path, or will be there before the driver at one of
        the first ``times`` of `WATCHED_TIMES`.
        """
        seen, (own, aside, _, speed) = self.seen, self.states[0]
        (s, d, turned, speeds), watched = np.moveaxis(self.others[:, :times], -1, 0), WATCHED_TIMES[:times]
        across = np.abs(np.sin(turned))
        length, width = ((seen.sizes + seen.size) / 2).T[..., None]
        in_way = np.abs(d - np.where(watched > 0.0, 0.0, aside)) < width + LANES_BESIDE + across * (length - width)
        gap = s - own - length + across * (length - width)
        first = gap > max(speed, 1.0) * watched - length
        along = np.maximum(speeds * np.cos(turned), 0.0)
        bound = idm_acceleration(speed, FREE_GAP, gap - along * watched, along, HEADWAY, STANDSTILL)
        return float(bound.min(initial=np.inf, where=in_way & (s > own) & first & seen.present[:, None]))


def states_of(cars: Iterable[RoadObject]) -> State:
    """Return ``(x, y, heading, speed)`` of highway-env vehicles."""
    return np.array([(*car.position, car.heading, car.speed) for car in cars], dtype=float)


def look(driver: Vehicle, seen: RoadScene | None = None) -> RoadView:
    """Return the present view of a driver; all cars get the driver's size.

    Args:
        driver: whose view it is.
        seen: what it observes now; by default, on the way along its ``route``, if it has one.
    """
    seen = seen or observe_road(driver)
    x, y, heading, speed = states_of([driver])[0]
    own, others = np.array([*seen.route.project(x, y, heading), speed]), _others(seen)
    lanes, wanted, (first, last) = interpolate(seen.lanes, own[0]), 1 + int(np.sign(seen.changes[1])), TAPER
    lanes[1] += (lanes[wanted] - lanes[1]) * np.clip((first - seen.room) / (first - last), 0.0, 1.0)
    lanes = np.where(seen.open[:, int(BEHIND / SPACING)], lanes, lanes[1])
    width = float(driver.lane.width_at(0.0))
    numbers, taken = places(own, others[:, 0], seen.present, np.array(width))
    scene = Scene(
        lanes,
        width,
        car_size=np.array([driver.LENGTH, driver.WIDTH]),
        target_lane=lanes[wanted],
        bend=float(seen.route.bend(own[0])),
    )
    return RoadView(
        seen,
        others,
        scene,
        np.stack([own, *np.where(taken[:, None], others[numbers, 0], far_behind(own))]),
        min(driver.lane.speed_limit or LIMIT, _limit_before_bends(seen.route, own[0])),
    )


def _others(seen: RoadScene) -> State:
    """Return the states of others at `WATCHED_TIMES` in the coordinates of the route [traffic, times, 4]."""
    along, aside, turned, speed = (values[:, None] for values in seen.states.T)
    times = np.where(seen.moving[:, None], WATCHED_TIMES, 0.0)
    x, y, heading = seen.paths.place(along + speed * times, aside + 0.0 * times)
    straight = seen.route.project(x, y, heading + np.where(times > 0.0, 0.0, turned))
    return np.stack([*straight, speed + 0.0 * times], axis=-1)


def at_constant_speed(vehicle: Vehicle, times: Row) -> tuple[list[Point], list[float]]:
    """Predict positions and headings of a vehicle at times from now [s], at constant speed along its lanes."""
    if "road_memory" not in vars(vehicle):
        observe_road(vehicle)
    network, lanes, pose = vehicle.road.network, vehicle.road_memory.lanes, (vehicle.position, vehicle.heading)
    first = int(np.argmin([network.get_lane(index).distance_with_heading(*pose) for index in lanes]))
    place, _ = network.get_lane(lanes[first]).local_coordinates(vehicle.position)
    ahead = [
        network.position_heading_along_route(lanes[first:], place + vehicle.speed * time, 0, vehicle.lane_index)
        for time in times
    ]
    return [position for position, _ in ahead], [heading for _, heading in ahead]


def _limit_before_bends(route: Curve, place: float) -> float:
    """Return the highest speed [m/s] from which moderate braking suffices for all bends ahead of a place [m]."""
    ahead = np.arange(0.0, BENDS_SEEN)
    bends = np.maximum(np.abs(route.bend(place + ahead)), STRAIGHT)
    return float(np.sqrt(np.maximum(CORNERING / bends, MIN_SPEED**2) + 2 * SLOWING * ahead).min())
