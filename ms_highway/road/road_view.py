"""Turn a driver's view of a highway-env road into the scene of a game.

The road is straightened along the driver's route. Arrays have the same shapes for all
roads and any number of vehicles, so that plans are compiled once.
"""

from dataclasses import dataclass

import numpy as np
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.game.scene import Scene, far_behind, places
from ms_highway.geometry.curve import BEHIND, SPACING, Curve, interpolate
from ms_highway.geometry.road_map import Lane
from ms_highway.perception.scene import SHAPE, RoadScene
from ms_highway.runtime.arrays import State
from ms_highway.vehicle import states_of


@dataclass(frozen=True)
class ViewSettings:
    """Set how a driver sees ends of lanes and bends."""

    merge_begin: float = 80.0
    """Distance before its end from which on a lane merges with its neighbour [m]."""
    merge_end: float = 20.0
    """Distance before its end at which a lane has merged [m]."""
    bends_ahead: float = 60.0
    """Distance within which a driver sees bends [m]."""
    least_curvature: float = 1e-6
    """Curvature of a straight road [1/m]."""
    cornering: float = 6.0
    """Lateral acceleration in bends ahead: less than tyres hold, so that steering is
    possible while braking [m/s^2].
    """
    braking: float = 3.0
    """Deceleration before bends [m/s^2]."""
    lowest_speed: float = 3.0
    """Lowest speed in any bend [m/s]."""


VIEW = ViewSettings()


@dataclass(frozen=True)
class RoadView:
    """Surroundings of a driver in the coordinates of its route.

    These are s along the route and d to its right.

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
    s, d, relative_heading = seen.route.project(x, y, heading)
    own = np.array([s, d, relative_heading, speed])
    others = _others(seen)

    # The lanes beside the driver; where its own one ends, its centre moves to the
    # target lane's.
    lanes = interpolate(seen.lanes, s)
    own_lane = SHAPE.own_lane
    direction = int(np.sign(seen.changes[own_lane]))
    target_lane = own_lane + direction
    merging_length = VIEW.merge_begin - VIEW.merge_end
    merged = np.clip((VIEW.merge_begin - seen.room) / merging_length, 0.0, 1.0)
    lanes[own_lane] += (lanes[target_lane] - lanes[own_lane]) * merged

    # A closed lane repeats the driver's.
    present_knot = int(BEHIND / SPACING)
    is_open = seen.open[:, present_knot]
    lanes = np.where(is_open, lanes, lanes[own_lane])

    width = float(driver.lane.width_at(0.0))
    scene = Scene(
        lanes,
        width,
        car_size=np.array([driver.LENGTH, driver.WIDTH]),
        target_lane=lanes[target_lane],
        bend=float(seen.route.bend(s)),
    )

    # The neighbours; a place that nobody takes is far behind.
    numbers, taken = places(own, others, seen.present, np.array(width))
    neighbours = np.where(taken[:, None], others[numbers], far_behind(own))
    states = np.stack([own, *neighbours])

    limit_of_lane = driver.lane.speed_limit or Lane.default_speed_limit
    limit = min(limit_of_lane, _limit_before_bends(seen.route, float(s)))
    return RoadView(seen, scene, states, limit)


def _others(seen: RoadScene) -> State:
    """Return the states of others in the coordinates of the route [traffic, 4]."""
    along, across, relative, speed = (field[:, None] for field in seen.states.T)
    x, y, path_heading = seen.paths.place(along, across)
    on_route = seen.route.project(x, y, path_heading + relative)
    return np.stack([*on_route, speed], axis=-1)[:, 0]


def _limit_before_bends(route: Curve, place: float) -> float:
    """Return the highest speed at a place from which braking suffices [m/s].

    The driver brakes moderately before all bends ahead.
    """
    ahead = np.arange(0.0, VIEW.bends_ahead)  # every metre
    curvature = np.abs(route.bend(place + ahead))
    bends = np.maximum(curvature, VIEW.least_curvature)

    # A bend of curvature k allows v^2 = cornering / k. At a distance x before it,
    # braking by b allows 2 b x more.
    squared_in_bend = np.maximum(VIEW.cornering / bends, VIEW.lowest_speed**2)
    squared_speed = squared_in_bend + 2 * VIEW.braking * ahead
    return float(np.sqrt(squared_speed).min())
