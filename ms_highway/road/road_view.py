"""Turn a driver's view of a highway-env road into the scene of a game, straightened
along the driver's route.

Arrays have the same shapes for all roads and any number of vehicles, so that plans are
compiled once.
"""

from dataclasses import dataclass

import numpy as np
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.game.scene import Scene, far_behind, places
from ms_highway.geometry.curve import BEHIND, SPACING, Curve, interpolate
from ms_highway.geometry.road_map import LIMIT
from ms_highway.perception.scene import RoadScene
from ms_highway.runtime.arrays import State
from ms_highway.vehicle import states_of

TAPER = (80.0, 20.0)  # m before its end, between which a lane merges with its neighbour
BENDS_SEEN = 60.0  # m ahead
STRAIGHT = 1e-6  # 1/m, the curvature of a straight road
# m/s^2, lateral, in bends ahead: less than tyres hold, so that steering is possible
# while braking
CORNERING = 6.0
SLOWING = 3.0  # m/s^2, deceleration before bends
MIN_SPEED = 3.0  # m/s, in any bend


@dataclass(frozen=True)
class RoadView:
    """Surroundings of a driver in the coordinates of its route: s along it, d to its
    right.

    Attributes:
        seen: what a robot would see in the driver's place.
        scene: the lane to the left, the driver's lane and the lane to the right; a
            closed lane repeats the driver's. Where the driver's lane ends, its centre
            moves to the target lane's, so that the driver merges.
        states: of the driver and its neighbours; obstacles count as standing cars.
        speed_limit: of the lane, reduced before bends [m/s].
    """

    seen: RoadScene
    scene: Scene
    states: State
    speed_limit: float


def look(driver: Vehicle, seen: RoadScene) -> RoadView:
    """Return the present view of a driver; all cars get the driver's size.

    Args:
        driver: whose view it is.
        seen: what it observes now.
    """
    # The driver and the others on its straightened route.
    x, y, heading, speed = states_of([driver])[0]
    own = np.array([*seen.route.project(x, y, heading), speed])
    others = _others(seen)

    # The lanes beside the driver; where its own one ends, its centre moves to the
    # wanted lane's.
    lanes = interpolate(seen.lanes, own[0])
    wanted = 1 + int(np.sign(seen.changes[1]))
    first, last = TAPER
    merged = np.clip((first - seen.room) / (first - last), 0.0, 1.0)
    lanes[1] += (lanes[wanted] - lanes[1]) * merged
    lanes = np.where(seen.open[:, int(BEHIND / SPACING)], lanes, lanes[1])

    width = float(driver.lane.width_at(0.0))
    numbers, taken = places(own, others, seen.present, np.array(width))
    scene = Scene(
        lanes,
        width,
        car_size=np.array([driver.LENGTH, driver.WIDTH]),
        target_lane=lanes[wanted],
        bend=float(seen.route.bend(own[0])),
    )
    neighbours = np.where(taken[:, None], others[numbers], far_behind(own))
    limit = min(
        driver.lane.speed_limit or LIMIT, _limit_before_bends(seen.route, own[0])
    )
    return RoadView(seen, scene, np.stack([own, *neighbours]), limit)


def _others(seen: RoadScene) -> State:
    """Return the states of others in the coordinates of the route [traffic, 4]."""
    along, aside, turned, speed = (values[:, None] for values in seen.states.T)
    x, y, heading = seen.paths.place(along, aside)
    straight = seen.route.project(x, y, heading + turned)
    return np.stack([*straight, speed], axis=-1)[:, 0]


def _limit_before_bends(route: Curve, place: float) -> float:
    """Return the highest speed [m/s] from which moderate braking suffices for all bends
    ahead of a place [m].
    """
    ahead = np.arange(0.0, BENDS_SEEN)
    bends = np.maximum(np.abs(route.bend(place + ahead)), STRAIGHT)
    return float(
        np.sqrt(np.maximum(CORNERING / bends, MIN_SPEED**2) + 2 * SLOWING * ahead).min()
    )
