"""A robot with highway-env's own kinematics that drives itself on any road, within what tyres hold in every frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import acos, asin, atan, cos, hypot, sin, sqrt, tan
from typing import Any, Self

import numpy as np
from highway_env.road.road import LaneIndex, Road, Route
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.graphics import VehicleGraphics
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Float

from ms_highway.control.road import RoadDriver, RoadStep
from ms_highway.game.road import RoadScene
from ms_highway.vehicle.road_scene import observe_road
from ms_highway.vehicle.road_view import at_constant_speed

__all__ = ["GRIP", "MARGIN", "PERIOD", "Motion", "RoadRobot", "held", "steering_of"]

PERIOD = 0.2
"""Time between two plans [s], rounded to frames of the simulation."""

GRIP = 5.0
"""Largest total acceleration, by default [m/s^2]."""

MARGIN = 0.98
"""Share of the grip that is used."""

SHARPEST = 0.9  # sine of the slip angle at most


def steering_of(curvature: float, length: float) -> float:
    """Return highway-env's steering angle [rad] for a yaw rate of ``speed * curvature``.

    With its slip angle beta, ``yaw rate = 2 speed sin(beta) / length`` and ``tan(beta) = tan(steering) / 2``.
    """
    return atan(2 * tan(_slip(curvature, length)))


def _slip(curvature: float, length: float) -> float:
    return asin(min(max(curvature * length / 2, -SHARPEST), SHARPEST))


@dataclass(frozen=True)
class Motion:
    """How a vehicle's centre moves in a frame.

    Attributes:
        speed: [m/s].
        course: direction in which it moves, heading and slip [rad].
    """

    speed: float
    course: float

    def change(self, other: "Motion") -> float:
        """Return the length of the difference of both velocities [m/s]."""
        turn = self.course - other.course
        return sqrt(max(self.speed**2 + other.speed**2 - 2 * self.speed * other.speed * cos(turn), 0.0))


def held(
    wanted: Float[np.ndarray, "2"], now: Motion, before: Motion, length: float, dt: float, grip: float
) -> tuple[float, float]:
    """Return the control that is nearest to a wanted one and within the grip of tyres for a frame.

    First the curvature: ``|v^2 k| <= grip``, and the velocity of the centre, slip included, changes by ``grip dt`` at
    most from the frame before, ``v^2 + v'^2 - 2 v v' cos(turn) <= (grip dt)^2``. Then the acceleration: ``a^2 + (v^2
    k)^2 <= grip^2``, never backwards, and the velocity along the heading, which turns by ``v k dt``, changes by ``grip
    dt`` at most; so the next frame can keep the slip of this one.

    Args:
        wanted: curvature of the rear axle's path [1/m] and acceleration [m/s^2].
        now: speed and heading of the vehicle.
        before: of its centre in the frame before.
        length: of the vehicle [m].
        dt: duration of a frame [s].
        grip: total acceleration at most [m/s^2].
    """
    curvature, acceleration = map(float, wanted)
    speed, most = now.speed, grip * dt
    turn = _largest_turn(speed, before.speed, most)
    straight = before.course - now.course
    left, right = (max(min(straight + side * turn, 1.1), -1.1) for side in (-1, 1))
    sharpest = min(grip / max(speed, 1e-3) ** 2, 2 * SHARPEST / length)
    curvature = min(max(curvature, 2 * sin(left) / length), 2 * sin(right) / length)
    curvature = min(max(curvature, -sharpest), sharpest)
    lateral = speed**2 * curvature
    most_along = sqrt(max(grip**2 - lateral**2, 0.0))
    angle = speed * curvature * dt
    room = sqrt(max(most**2 - (speed * sin(angle)) ** 2, 0.0))
    slowest, fastest = speed * cos(angle) - room, speed * cos(angle) + room
    lowest = max(-most_along, (max(slowest, 0.0) - speed) / dt, -speed / dt)
    highest = min(most_along, (fastest - speed) / dt)
    return curvature, min(max(acceleration, lowest), highest)


def _largest_turn(speed: float, before: float, most: float) -> float:
    """Return the largest angle between velocities of two speeds whose difference is ``most`` at most."""
    product = 2 * speed * before
    if product < 1e-9:
        return 3.2
    cosine = (speed**2 + before**2 - most**2) / product
    return acos(min(max(cosine, -1.0), 1.0))


class RoadRobot(Vehicle):
    """Car that drives itself with a `RoadDriver` whenever its road lets vehicles act; it ignores all actions.

    It plans every `PERIOD` and holds the control in between, within its grip in every frame. Rewards and rules of
    highway-env's environments find in it what they ask of the car that they control.

    Attributes:
        driver: plans; without one, the car keeps its velocity.
        goal: node of the road network that it drives to, None without one.
        grip: total acceleration at most [m/s^2].
        route: roads to follow, None without a route.
        target_speeds: speeds that the environment offers to drivers of discrete actions [m/s].
        last_step: of the driver, None before the first.
        steps: of the driver since `forget`.
        accelerations: largest total acceleration in each frame since `forget` [m/s^2]: of the control, and of the
            velocity between frames, with and without slip.
        jerks: change of the acceleration within the last `PERIOD`, in each frame since `forget` [m/s^3].
    """

    def __init__(self, road: Road | None, position: Sequence[float], heading: float = 0, speed: float = 0) -> None:
        super().__init__(road, position, heading, speed)
        self.driver: RoadDriver | None = None
        self.goal: str | None = None
        self.grip = GRIP
        self.route: Route | None = None
        self.target_speeds = MDPVehicle.DEFAULT_TARGET_SPEEDS
        self.last_step: RoadStep | None = None
        self.applied = np.zeros(2)
        self._wanted = np.zeros(2)
        self._before: Motion | None = None
        self._elapsed, self._frame = np.inf, PERIOD
        self._executed: list[tuple[float, float]] = []
        self.forget()

    @classmethod
    def create_from(cls, vehicle: Vehicle) -> Self:
        """Return a car without a driver in the place of another vehicle, on the same route."""
        car = cls(vehicle.road, vehicle.position, vehicle.heading, vehicle.speed)
        car.route = getattr(vehicle, "route", None)
        if hasattr(vehicle, "color"):
            car.color = vehicle.color
        return car

    def drive_with(self, driver: RoadDriver, goal: str | None = None, grip: float = GRIP) -> None:
        """Let a driver drive, to a node of the road network where there is a goal."""
        self.driver, self.goal, self.grip = driver, goal, grip

    def forget(self) -> None:
        """Forget the record of steps and frames."""
        self.steps: list[RoadStep] = []
        self.accelerations: list[float] = []
        self.jerks: list[float] = []

    def look(self) -> RoadScene:
        """Observe the road."""
        curvature, acceleration = self.applied.tolist()
        return observe_road(self, self.goal, (curvature, acceleration))

    def act(self, action: dict[str, Any] | str | None = None) -> None:
        """Plan if it is time for it; ignore actions."""
        if action is not None or self.driver is None or self.crashed:
            return
        if self._elapsed + self._frame / 2 >= PERIOD:
            self.last_step = self.driver.step(self.look())
            self.steps.append(self.last_step)
            self._wanted = np.asarray(self.last_step.control, dtype=float)
            self._elapsed = 0.0

    def step(self, dt: float) -> None:
        """Move for ``dt`` seconds within the grip; crashed, as highway-env's vehicles do."""
        if self.crashed:
            self.color = VehicleGraphics.RED
            super().step(dt)
            return
        now = Motion(self.speed, self.heading)
        before = self._before or now
        self.applied = np.array(held(self._wanted, now, before, self.LENGTH, dt, MARGIN * self.grip))
        curvature, acceleration = self.applied.tolist()
        self.action = {"steering": steering_of(curvature, self.LENGTH), "acceleration": acceleration}
        self._before = sliding = Motion(now.speed, now.course + _slip(curvature, self.LENGTH))
        super().step(dt)
        self._elapsed, self._frame = self._elapsed + dt, dt
        changed = max(sliding.change(before), Motion(self.speed, self.heading).change(now))
        self._record(acceleration, now.speed**2 * curvature, changed / dt, dt)

    def _record(self, acceleration: float, lateral: float, changed: float, dt: float) -> None:
        """Record a frame: the control's acceleration, along and across, and how fast the velocity has changed."""
        self.accelerations.append(max(hypot(acceleration, lateral), changed))
        self._executed = [*self._executed, (acceleration, lateral)][-round(PERIOD / dt + 1) :]
        (along, across), span = self._executed[0], dt * max(len(self._executed) - 1, 1)
        self.jerks.append(hypot(acceleration - along, lateral - across) / span)

    @property
    def target_lane_index(self) -> LaneIndex:
        """The lane that it is on."""
        return self.lane_index

    def index_to_speed(self, index: int) -> float:
        """Return one of the target speeds."""
        return self.target_speeds[index]

    def speed_to_index(self, speed: float) -> int:
        """Return the index of the target speed that is nearest to a speed."""
        return MDPVehicle.speed_to_index(self, speed)

    @property
    def speed_index(self) -> int:
        """Index of the target speed that is nearest to the present speed."""
        return self.speed_to_index(self.speed)

    def plan_route_to(self, destination: str) -> Self:
        """Set the shortest route to a node of the road network."""
        return ControlledVehicle.plan_route_to(self, destination)

    def predict_trajectory_constant_speed(
        self, times: Float[np.ndarray, "times"]
    ) -> tuple[list[Float[np.ndarray, "2"]], list[float]]:
        """See `ms_highway.vehicle.road_view.at_constant_speed`."""
        return at_constant_speed(self, times)
