"""Keep clear of others on the map: of who is ahead on the own way, and of who will cross it first."""

import numpy as np
from highway_env.road.regulation import RegulatedRoad
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Landmark, RoadObject

from ms_highway.planning.car_following import idm_acceleration
from ms_highway.vehicle.road_view import SIGHT, RoadView, at_constant_speed

HEADWAY, STANDSTILL = 0.5, 2.0  # s and m between bumpers: shorter than what drivers keep on their own
BESIDE = 0.3  # m between sides, below which others are in the way
TIMES = np.array([0.0, 0.5, 1.0, 1.5, 2.0])  # s, at which others are predicted at constant speed along their lanes
FREE = 1e3  # m/s, so high that no desired speed limits the acceleration


def clear_acceleration(driver: Vehicle, view: RoadView) -> float:
    """Return the highest acceleration with which a driver keeps clear of others by the Intelligent Driver Model.

    A vehicle that is in the driver's path, or will be within 2 s and before the driver, counts as the car ahead. On a
    `RegulatedRoad`, which tells drivers when to yield, only vehicles in the path now count. It is infinite without any.

    Args:
        driver: on its way.
        view: of the road, in whose coordinates others are.
    """
    others = [
        item
        for item in (*driver.road.vehicles, *driver.road.objects)
        if item is not driver
        and not isinstance(item, Landmark)
        and np.hypot(*(item.position - driver.position)) < SIGHT
    ]
    if not others:
        return np.inf
    own, aside = view.place, view.states[0, 1]
    times = TIMES[:1] if isinstance(driver.road, RegulatedRoad) else TIMES
    poses = [_predicted(item, times) for item in others]
    x, y, heading = np.moveaxis(np.array(poses), -1, 0)  # [others, times]
    s, d, turned = view.curve.project(x, y, heading)
    speeds = np.array([item.speed for item in others])[:, None]
    length = np.array([(item.LENGTH + driver.LENGTH) / 2 for item in others])[:, None]
    width = np.array([(item.WIDTH + driver.WIDTH) / 2 for item in others])[:, None]
    across = np.abs(np.sin(turned))
    in_way = np.abs(d - np.where(times > 0.0, 0.0, aside)) < width + BESIDE + across * (length - width)
    gap = s - own - length + across * (length - width)
    first = gap > max(driver.speed, 1.0) * times - length
    along = np.maximum(speeds * np.cos(turned), 0.0)
    gap = np.where(in_way & (s > own) & first, gap - along * times, np.inf)
    bound = idm_acceleration(driver.speed, FREE, gap, along, HEADWAY, STANDSTILL)
    return float(np.where(np.isfinite(gap), bound, np.inf).min())


def _predicted(item: RoadObject, times: np.ndarray) -> np.ndarray:
    """Return x, y and heading of a vehicle or an obstacle at times from now [s]."""
    if isinstance(item, Vehicle) and item.speed > 0.1 and not item.crashed:
        positions, headings = at_constant_speed(item, times)
        shift, headings[0] = item.position - positions[0], item.heading  # who comes the wrong way is in the way
        return np.column_stack([positions + shift, headings])
    return np.tile([*item.position, item.heading], (len(times), 1))
