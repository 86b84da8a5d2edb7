"""Measure the motion of vehicles in every frame, and the ego's fault in collisions."""

from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import pairwise
from math import cos
from typing import TypeAlias

import numpy as np
from highway_env.envs.common.abstract import AbstractEnv
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject
from jaxtyping import Float

from ms_highway.geometry.bodies import separation


@dataclass(frozen=True)
class WatchSettings:
    """Set what counts as following a lane, standing, colliding and leaving the road."""

    look_back: float = 1.0
    """Time before a collision in which the ego has to keep its lane [s]."""
    lane_gap: float = 0.5
    """Largest gap between lanes where roads meet [m]."""
    collision_reach: float = 2.0
    """Largest distance of cars that have just collided: highway-env pushes them apart
    [m].
    """
    lane_offset: float = 1.0
    """Largest distance from the centre of a lane that the ego follows [m]."""
    standing_speed: float = 1.0
    """Largest speed of a car that stands [m/s]."""
    same_way: float = 0.7
    """Least cosine of the angle between headings of vehicles that go the same way."""


WATCH = WatchSettings()

Lane: TypeAlias = tuple[str, str, int] | None
"""Index of a lane in a road network, or None."""


def motion_figures(
    states: Float[np.ndarray, "frames 4"],
    time_step: float,
    crashed: bool = False,
) -> dict[str, float]:
    """Return figures of a car's motion by name.

    The acceleration of a frame is the larger of two: the change of ``speed *
    (cos(heading), sin(heading))``, and ``hypot(change of speed, speed * change of
    heading)``, both per second. The acceleration of the centre is the second difference
    of its positions; it includes the slip angle of highway-env.

    Args:
        states: x, y, heading and speed before the first frame and after each frame.
        time_step: duration of a frame [s].
        crashed: whether the car crashed in the last frame, which may have moved it.
    """
    x, y, heading, speed = np.asarray(states, dtype=float).T
    heading = np.unwrap(heading)

    # Acceleration [2, frames]: change of the velocity vector.
    direction = np.stack([np.cos(heading), np.sin(heading)])
    acceleration = np.diff(speed * direction) / time_step
    jerk = np.diff(acceleration) / time_step

    # Its size [frames] if the velocity turns while it grows.
    speed_change = np.diff(speed)
    change_across = speed[:-1] * np.diff(heading)
    turning = np.hypot(speed_change, change_across) / time_step

    # Acceleration of the centre, without the last frame if a crash moved the car.
    positions = np.stack([x, y])
    if crashed:
        positions = positions[:, :-1]
    centre_velocity = np.diff(positions) / time_step
    of_centre = np.diff(centre_velocity) / time_step

    frames = len(turning)
    speeds = np.abs(speed[1:])
    stands = speeds < WATCH.standing_speed
    both = [turning, np.hypot(*acceleration)]
    squared_jerk = np.sum(jerk**2, axis=0)
    figures = {
        "frames": frames,
        "distance": np.sum(speeds) * time_step,
        "seconds": frames * time_step,
        "stood": np.sum(stands) * time_step,
        "max_acceleration": np.max(both, initial=0.0),
        "max_acceleration_of_centre": np.max(np.hypot(*of_centre), initial=0.0),
        "squared_jerk": np.mean(squared_jerk) if jerk.size else 0.0,
    }
    return {name: np.asarray(figure).item() for name, figure in figures.items()}


class Watch:
    """Watch the ego of a highway-env environment in every frame of the simulation.

    Args:
        env: the environment, unwrapped, just reset.
        *then: functions to call after every frame.

    Attributes:
        others: what the other vehicles have done.
        crashed: whether the ego has crashed.
        at_fault: whether the ego has crashed by its own fault, see `is_at_fault`.
        off_road: whether its centre has been off its lane by more than
            `WatchSettings.lane_gap`, before a crash.
    """

    def __init__(self, env: AbstractEnv, *then: Callable[[], None]) -> None:
        self.crashed = False
        self.at_fault = False
        self.off_road = False
        self._env = env
        self._time_step = 1 / env.config["simulation_frequency"]
        self._states: list[tuple[float, ...]] = []
        frames = max(1, round(WATCH.look_back / self._time_step))
        self._lanes = deque[Lane](maxlen=frames)
        self.others = OthersWatch(env)
        self._see()
        self.off_road = False
        step = env.road.step

        def watched(dt: float) -> None:
            step(dt)
            self.others.see()
            if not self.crashed:
                self._see()
            for each in then:
                each()

        # Only of this road: a reset makes a new one.
        env.road.step = watched

    def motion(self) -> dict[str, float]:
        """Return the ego's `motion_figures` until now, or until it crashed."""
        return motion_figures(np.array(self._states), self._time_step, self.crashed)

    def _see(self) -> None:
        """Look at the ego in this frame."""
        ego = self._env.vehicle
        self._states.append((*ego.position, ego.heading, ego.speed))
        if ego.crashed:
            self.crashed = True
            self.at_fault = is_at_fault(ego, self._touched(), self._lanes)
            return
        _, offset = ego.lane.local_coordinates(ego.position)
        in_lane = abs(offset) < WATCH.lane_offset
        follows = in_lane and ego.speed > WATCH.standing_speed
        self._lanes.append(ego.lane_index if follows else None)
        self.off_road |= not ego.lane.on_lane(ego.position, margin=WATCH.lane_gap)

    def _touched(self) -> RoadObject | None:
        """Return what the ego has collided with, None if it is unknown."""
        ego = self._env.vehicle
        road = self._env.road
        gaps = {}
        for other in (*road.vehicles, *road.objects):
            if other is ego or not other.crashed:
                continue
            gap = _gap(ego, other)
            if gap < WATCH.collision_reach:
                gaps[other] = gap
        return min(gaps, key=gaps.__getitem__, default=None)


class OthersWatch:
    """Watch all vehicles but the ego of a highway-env environment in every frame.

    Vehicles collide if highway-env says so, or if their bodies overlap: in some scenes,
    as in highway-fast-v0, highway-env looks for collisions of the ego only.

    Args:
        env: the environment, unwrapped, just reset.

    Attributes:
        collided: whether any two vehicles, or a vehicle and an obstacle, have collided.
        others_collided: whether two of the others, or one of them and an obstacle, have
            collided before the ego did.
    """

    def __init__(self, env: AbstractEnv) -> None:
        self.collided = False
        self.others_collided = False
        self._env = env
        self._arrived: set[int] = set()
        self._distance = 0.0
        self._frames = 0
        self._hardest_braking = 0.0
        self._speeds: dict[int, float] = {}
        # Vehicles that have been seen; their ids stay unique while they are kept.
        self._seen: list[Vehicle] = []
        self.see()

    def figures(self) -> dict[str, float]:
        """Return the figures of the others until now.

        * ``collided``, ``others_collided``: as above;
        * ``others_speed``: mean over all of the others and all frames [m/s];
        * ``others_braking``: hardest deceleration of any of the others that has not
          collided [m/s^2];
        * ``others_arrived``: number of the others that have reached the last road of
          their routes.
        """
        return {
            "collided": self.collided,
            "others_collided": self.others_collided,
            "others_speed": self._distance / max(self._frames, 1),
            "others_braking": self._hardest_braking,
            "others_arrived": len(self._arrived),
        }

    def see(self) -> None:
        """Look at all vehicles in this frame."""
        ego = self._env.vehicle
        road = self._env.road
        others = [vehicle for vehicle in road.vehicles if vehicle is not ego]
        if not self.collided:
            ego_touches, others_touch = self._touching(ego, others)
            self.others_collided = others_touch
            self.collided = ego_touches or others_touch

        # How fast the others drive, how hard they brake, and who has arrived.
        time_step = 1 / self._env.config["simulation_frequency"]
        for vehicle in others:
            self._distance += abs(vehicle.speed)
            self._frames += 1
            before = self._speeds.get(id(vehicle), vehicle.speed)
            braking = (before - vehicle.speed) / time_step
            if not vehicle.crashed:
                self._hardest_braking = max(self._hardest_braking, braking)
            if id(vehicle) not in self._speeds:
                self._seen.append(vehicle)
            self._speeds[id(vehicle)] = vehicle.speed
            route = getattr(vehicle, "route", None)
            if route and len(route) == 1 and vehicle.lane_index[:2] == route[0][:2]:
                self._arrived.add(id(vehicle))

    def _touching(self, ego: Vehicle, others: list[Vehicle]) -> tuple[bool, bool]:
        """Return whether the ego collides now, and whether others do without it."""
        # What highway-env says, without whom the ego has collided with.
        crashed = [vehicle for vehicle in others if vehicle.crashed]
        if ego.crashed:
            reach = WATCH.collision_reach
            crashed = [vehicle for vehicle in crashed if _gap(ego, vehicle) > reach]

        # Which bodies overlap, of all pairs; the ego is the first vehicle.
        vehicles = [ego, *others]
        rows = [(*vehicle.position, vehicle.heading) for vehicle in vehicles]
        poses = np.array(rows).T  # x, y and heading, [3, vehicles]
        sizes = np.array([(vehicle.LENGTH, vehicle.WIDTH) for vehicle in vehicles])
        first, second = np.triu_indices(len(vehicles), 1)
        distances = separation(
            tuple(poses[:, first]),
            sizes[first],
            tuple(poses[:, second]),
            sizes[second],
        )
        overlap = distances < 0
        ego_overlaps = bool(overlap[first == 0].any())
        others_overlap = bool(overlap[first > 0].any())
        return ego.crashed or ego_overlaps, bool(crashed) or others_overlap


def _gap(one: RoadObject, other: RoadObject) -> float:
    """Return the distance between the circumscribed circles of two cars [m].

    It is negative if they overlap.
    """
    distance = np.linalg.norm(one.position - other.position)
    return float(distance - (one.diagonal + other.diagonal) / 2)


def is_at_fault(
    ego: Vehicle,
    other: RoadObject | None,
    lanes: Collection[Lane],
) -> bool:
    """Return whether the ego is at fault in a collision.

    It is, unless it was rear-ended while it kept its lane. The ego was rear-ended if

    * the other goes the same way, within about 45 degrees,
    * the ego's centre is ahead of the other's front, along the other's heading, and
    * the point of the other that is closest to the ego's centre is behind this centre,
      along the ego's heading.

    The ego kept its lane if it followed a lane all the time, and the lane's number did
    not change on the same road. Therefore a car that stands on the road when it is hit
    is at fault, and so is a car that was pushed out of its lane from the side.

    Args:
        ego: a vehicle of highway-env.
        other: the vehicle or object that the ego touches, None if it is unknown.
        lanes: lane of the ego in each frame of the last second before the collision;
            None where the ego was farther than `WatchSettings.lane_offset` from its
            centre, or slower than `WatchSettings.standing_speed`.
    """
    if other is None or cos(ego.heading - other.heading) < WATCH.same_way:
        return True

    # Seen from the other car: where the ego's centre is, and the point of the front
    # that is closest to it.
    forward = other.direction
    across = np.array([-forward[1], forward[0]])
    ego_centre = ego.position - other.position
    half_length = other.LENGTH / 2
    half_width = other.WIDTH / 2
    lateral = np.clip(ego_centre @ across, -half_width, half_width)
    closest = half_length * forward + lateral * across
    is_ahead = ego_centre @ forward > half_length
    is_behind = (closest - ego_centre) @ ego.direction < 0
    rear_ended = is_ahead and is_behind

    # Lanes of the same road that follow each other must have the same number.
    followed = [lane for lane in lanes if lane is not None]
    changed_lane = any(
        before[:2] == after[:2] and before != after
        for before, after in pairwise(followed)
    )
    kept_lane = len(followed) == len(lanes) and not changed_lane
    return bool(not (rear_ended and kept_lane))
