"""Measure the motion of the ego and of others in every frame of the simulation, and the
ego's fault in collisions.
"""

from collections import deque
from collections.abc import Callable, Collection
from itertools import pairwise
from math import cos
from typing import Any, TypeAlias

import numpy as np

from ms_highway.geometry.bodies import separation

LOOK_BACK = 1.0  # s before a collision
GAP = 0.5  # m, largest gap between lanes where roads meet
# m, largest distance of cars that have just collided: highway-env pushes them apart
COLLISION_REACH = 2.0
LANE_OFFSET = 1.0  # m
STANDING_SPEED = 1.0  # m/s
# smallest cosine of the angle between headings of vehicles that go the same way
SAME_WAY = 0.7

Lane: TypeAlias = tuple[str, str, int] | None
"""Index of a lane in a road network, or None."""


def measured(states: np.ndarray, time_step: float, crashed: bool = False) -> dict:
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
    acceleration = (
        np.diff(speed * np.stack([np.cos(heading), np.sin(heading)])) / time_step
    )
    turning = np.hypot(np.diff(speed), speed[:-1] * np.diff(heading)) / time_step
    centre = (
        np.diff(np.diff(np.stack([x, y])[:, : -1 if crashed else None]) / time_step)
        / time_step
    )
    jerk = np.diff(acceleration) / time_step
    numbers = {
        "frames": len(turning),
        "distance": np.sum(np.abs(speed[1:])) * time_step,
        "seconds": len(turning) * time_step,
        "stood": np.sum(np.abs(speed[1:]) < STANDING_SPEED) * time_step,
        "max_acceleration": np.max([turning, np.hypot(*acceleration)], initial=0.0),
        "max_acceleration_of_centre": np.max(np.hypot(*centre), initial=0.0),
        "squared_jerk": np.mean(np.sum(jerk**2, axis=0)) if jerk.size else 0.0,
    }
    return {name: np.asarray(number).item() for name, number in numbers.items()}


class Watch:
    """Watch the ego of a highway-env environment in every frame of the simulation.

    Args:
        env: the environment, unwrapped, just reset.
        *then: functions to call after every frame.

    Attributes:
        others: what the other vehicles have done.
        crashed: whether the ego has crashed.
        at_fault: whether the ego has crashed by its own fault, see `is_at_fault`.
        off_road: whether its centre has been off its lane by more than `GAP`, before a
            crash.
    """

    def __init__(self, env: Any, *then: Callable[[], None]) -> None:
        self.crashed = self.at_fault = self.off_road = False
        self._env = env
        self._time_step = 1 / env.config["simulation_frequency"]
        self._states: list[Any] = []
        self._lanes = deque[Lane](maxlen=max(1, round(LOOK_BACK / self._time_step)))
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

        env.road.step = watched  # only of this road: a reset makes a new one

    def motion(self) -> dict:
        """Return the figures of the ego's motion until now, or until it crashed, see
        `measured`.
        """
        return measured(np.array(self._states), self._time_step, self.crashed)

    def _see(self) -> None:
        ego = self._env.vehicle
        road = self._env.road
        self._states.append((*ego.position, ego.heading, ego.speed))
        if ego.crashed:
            self.crashed = True
            others = [
                one
                for one in (*road.vehicles, *road.objects)
                if one is not ego and one.crashed
            ]
            near = [one for one in others if _gap(ego, one) < COLLISION_REACH]
            self.at_fault = is_at_fault(
                ego,
                min(near, key=lambda one: _gap(ego, one), default=None),
                self._lanes,
            )
            return
        _, offset = ego.lane.local_coordinates(ego.position)
        self._lanes.append(
            ego.lane_index
            if abs(offset) < LANE_OFFSET and ego.speed > STANDING_SPEED
            else None
        )
        self.off_road |= not ego.lane.on_lane(ego.position, margin=GAP)


class OthersWatch:
    """Watch all vehicles but the ego of a highway-env environment in every frame of the
    simulation.

    Vehicles collide if highway-env says so, or if their bodies overlap: in some scenes,
    as in highway-fast-v0, highway-env looks for collisions of the ego only.

    Args:
        env: the environment, unwrapped, just reset.

    Attributes:
        collided: whether any two vehicles, or a vehicle and an obstacle, have collided.
        others_collided: whether two of the others, or one of them and an obstacle, have
            collided before the ego did.
    """

    def __init__(self, env: Any) -> None:
        self.collided = self.others_collided = False
        self._env = env
        self._arrived: set[int] = set()
        self._distance = 0.0
        self._frames = 0
        self._hardest_braking = 0.0
        self._speeds: dict[int, float] = {}
        self._seen: list[
            Any
        ] = []  # vehicles that have been seen: keeps their ids unique
        self.see()

    def figures(self) -> dict:
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
            braking = (
                self._speeds.get(id(vehicle), vehicle.speed) - vehicle.speed
            ) / time_step
            if not vehicle.crashed:
                self._hardest_braking = max(self._hardest_braking, braking)
            if id(vehicle) not in self._speeds:
                self._seen.append(vehicle)
            self._speeds[id(vehicle)] = vehicle.speed
            route = getattr(vehicle, "route", None)
            if route and len(route) == 1 and vehicle.lane_index[:2] == route[0][:2]:
                self._arrived.add(id(vehicle))

    def _touching(self, ego: Any, others: list[Any]) -> tuple[bool, bool]:
        """Return whether the ego collides in this frame, and whether others collide
        without it.
        """
        crashed = [vehicle for vehicle in others if vehicle.crashed]
        if ego.crashed:
            crashed = [
                vehicle for vehicle in crashed if _gap(ego, vehicle) > COLLISION_REACH
            ]
        vehicles = [ego, *others]
        poses = np.array(
            [(*vehicle.position, vehicle.heading) for vehicle in vehicles]
        ).T
        sizes = np.array([(vehicle.LENGTH, vehicle.WIDTH) for vehicle in vehicles])
        first, second = np.triu_indices(len(vehicles), 1)
        overlap = (
            separation(
                tuple(poses[:, first]),
                sizes[first],
                tuple(poses[:, second]),
                sizes[second],
            )
            < 0
        )
        ego_touches = ego.crashed or bool(overlap[first == 0].any())
        return ego_touches, bool(crashed) or bool(overlap[first > 0].any())


def _gap(one: Any, other: Any) -> float:
    """Return the distance between the circumscribed circles of two cars [m], negative
    if they overlap.
    """
    return float(
        np.linalg.norm(one.position - other.position)
        - (one.diagonal + other.diagonal) / 2
    )


def is_at_fault(ego: Any, other: Any | None, lanes: Collection[Lane]) -> bool:
    """Return whether the ego is at fault in a collision: always, unless it was
    rear-ended while it kept its lane.

    The ego was rear-ended if

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
            None where the ego was farther than `LANE_OFFSET` from its centre, or slower
            than `STANDING_SPEED`.
    """
    if other is None or cos(ego.heading - other.heading) < SAME_WAY:
        return True
    across = np.array([-other.direction[1], other.direction[0]])
    away = ego.position - other.position
    half_length = other.LENGTH / 2
    half_width = other.WIDTH / 2
    closest = (
        half_length * other.direction
        + np.clip(away @ across, -half_width, half_width) * across
    )
    rear_ended = (
        away @ other.direction > half_length and (closest - away) @ ego.direction < 0
    )
    followed = [lane for lane in lanes if lane is not None]
    changed = any(
        before[:2] == after[:2] and before != after
        for before, after in pairwise(followed)
    )
    return bool(not rear_ended or changed or len(followed) < len(lanes))
