"""Measure how the ego moves in every frame of the simulation, not only after every step of the environment."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ms_highway.benchmarks.road.fault import Place, is_at_fault

__all__ = ["Motion", "Watch", "measured"]

LOOK_BACK = 1.0  # s before a collision
GAP = 0.5  # m between lanes where roads meet, at most
REACH = 2.0  # m between cars that have just collided, at most: highway-env pushes them apart


@dataclass(frozen=True)
class Motion:
    """How a car moved, until it crashed.

    Attributes:
        frames: their number.
        distance: the sum of speed times time [m].
        seconds: their duration.
        max_acceleration: the largest acceleration in any frame [m/s^2].
        max_acceleration_of_centre: that of the middle of the car, which also goes sideways when the front wheels are
            turned [m/s^2].
        squared_jerk: the mean of the squared change of acceleration per second [m^2/s^6].
    """

    frames: int
    distance: float
    seconds: float
    max_acceleration: float
    max_acceleration_of_centre: float
    squared_jerk: float


def measured(states: Float[np.ndarray, "frames 4"], time_step: float, crashed: bool = False) -> Motion:
    """Return how a car moved.

    The acceleration of a frame is the larger of two: the change of ``speed * (cos(heading), sin(heading))``, and
    ``hypot(change of speed, speed * change of heading)``, both per second. That of the centre is the change of the
    distance that the position moves in a frame; highway-env adds the slip angle to the heading there.

    Args:
        states: x, y, heading and speed before the first frame and after each.
        time_step: of a frame [s].
        crashed: whether the car crashed in the last frame; it may then have been pushed.
    """
    x, y, heading, speed = np.asarray(states, dtype=float).T
    heading = np.unwrap(heading)
    along = speed * np.stack([np.cos(heading), np.sin(heading)])
    acceleration = np.diff(along) / time_step
    turning = np.hypot(np.diff(speed), speed[:-1] * np.diff(heading)) / time_step
    moved = np.diff(np.stack([x, y])[:, : -1 if crashed else None]) / time_step
    return Motion(
        frames=len(states) - 1,
        distance=float(np.sum(np.abs(speed[1:])) * time_step),
        seconds=(len(states) - 1) * time_step,
        max_acceleration=float(max(np.max(turning, initial=0.0), _largest(acceleration))),
        max_acceleration_of_centre=_largest(np.diff(moved) / time_step),
        squared_jerk=float(np.mean(np.sum((np.diff(acceleration) / time_step) ** 2, axis=0)))
        if len(states) > 2
        else 0.0,
    )


def _largest(vectors: Float[np.ndarray, "2 frames"]) -> float:
    return float(np.max(np.hypot(*vectors), initial=0.0))


class Watch:
    """Watch the ego of a highway-env environment from a reset on, in every frame of the simulation.

    Args:
        env: the environment, unwrapped, just reset.
        then: is called after every frame.

    Attributes:
        crashed: whether the ego has crashed.
        at_fault: whether it has, and is at fault, see `ms_highway.benchmarks.road.fault.is_at_fault`.
        off_road: whether it has left the road in any frame before.
    """

    def __init__(self, env: Any, then: Callable[[], None] | None = None) -> None:
        self.crashed = self.at_fault = self.off_road = False
        self._env, self._time_step = env, 1 / env.config["simulation_frequency"]
        self._states = [self._state()]
        self._places = deque([_place(env.vehicle)], maxlen=max(1, round(LOOK_BACK / self._time_step)))
        step = env.road.step

        def watched(dt: float) -> None:
            step(dt)
            if not self.crashed:
                self._see()
            if then is not None:
                then()

        env.road.step = watched  # of this road only: a reset makes another

    def motion(self) -> Motion:
        """Return how the ego moved until now, or until it crashed."""
        return measured(np.array(self._states), self._time_step, self.crashed)

    def _state(self) -> tuple[float, float, float, float]:
        ego = self._env.vehicle
        return (*ego.position, ego.heading, ego.speed)

    def _see(self) -> None:
        ego, road = self._env.vehicle, self._env.road
        self._states.append(self._state())
        if ego.crashed:
            self.crashed = True
            others = [one for one in (*road.vehicles, *road.objects) if one is not ego and one.crashed]
            distances = [_gap(ego, one) for one in others]
            touched = others[int(np.argmin(distances))] if min(distances, default=np.inf) < REACH else None
            self.at_fault = is_at_fault(ego, touched, tuple(self._places))
            return
        self._places.append(_place(ego))
        self.off_road |= not self._places[-1].on_road


def _place(ego: Any) -> Place:
    _, offset = ego.lane.local_coordinates(ego.position)
    return Place(ego.lane_index, float(offset), float(ego.speed), bool(ego.lane.on_lane(ego.position, margin=GAP)))


def _gap(one: Any, other: Any) -> float:
    """Return the distance of the circles around two cars [m], negative where they overlap."""
    return float(np.linalg.norm(one.position - other.position) - (one.diagonal + other.diagonal) / 2)
