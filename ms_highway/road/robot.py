"""A robot that drives itself on any road, within its grip in every frame.

It has highway-env's kinematics.
"""

from cmath import phase, rect
from collections.abc import Sequence
from math import asin, atan, cos, sin, sqrt, tan
from typing import ClassVar, Self

import numpy as np
from highway_env.road.road import LaneIndex, Road, Route
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.graphics import VehicleGraphics
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.geometry.lane_paths import Point
from ms_highway.perception.observation import observe_road
from ms_highway.perception.scene import RoadScene
from ms_highway.road.added import AddedRoadDriver
from ms_highway.road.driver import RoadDriver, RoadStep
from ms_highway.road.robot_motion import GRIP_USE
from ms_highway.road.timed_goal import RobotGoal, TimedGoal
from ms_highway.vehicle.bicycle import OfferedSpeeds
from ms_highway.vehicle.planning import at_constant_speed

LARGEST_SLIP = 1.1
"""Largest slip angle [rad], just below that whose sine is the largest of
`ms_highway.road.robot_motion.GripUse`.
"""


def steering_of(curvature: float, length: float) -> float:
    """Return highway-env's steering angle for a curvature [rad].

    The yaw rate is ``speed * curvature``. With its slip angle beta, ``yaw rate = 2
    speed sin(beta) / length`` and ``tan(beta) = tan(steering) / 2``.
    """
    return atan(2 * tan(_slip_angle(curvature, length)))


def _slip_angle(curvature: float, length: float) -> float:
    """Return the slip angle of the centre [rad]."""
    largest = GRIP_USE.largest_slip_sine
    return asin(min(max(curvature * length / 2, -largest), largest))


def keep_grip(
    wanted: Point,
    speed: float,
    before: complex,
    length: float,
    dt: float,
    grip: float,
) -> tuple[float, float]:
    """Limit a wanted control to the grip of the tyres in a frame.

    The curvature is limited first: ``|v^2 k| <= grip``, and the velocity of the centre,
    slip included, changes by at most ``grip dt`` since the last frame, ``v^2 + v'^2 - 2
    v v' cos(turn) <= (grip dt)^2``. The acceleration follows: ``a^2 + (v^2 k)^2 <=
    grip^2``, the car never reverses, and the velocity along the heading, which turns by
    ``v k dt``, changes by at most ``grip dt``, so that the next frame can keep the slip
    angle of this one.

    Args:
        wanted: curvature of the rear axle's path [1/m] and acceleration [m/s^2].
        speed: of the vehicle [m/s].
        before: velocity of its centre in the last frame as a complex number: the real
            part along its heading, the imaginary part to the right [m/s].
        length: of the vehicle [m].
        dt: duration of the frame [s].
        grip: largest total acceleration [m/s^2].
    """
    curvature, acceleration = map(float, wanted)
    largest_change = grip * dt  # of the velocity [m/s]

    # The velocity of the centre turns by at most so much that it changes by
    # `largest_change`; a car that hardly moves may turn by any angle. Its angle to the
    # heading is the slip angle.
    turn = 3.2
    product = 2 * speed * abs(before)
    if product >= 1e-9:
        cosine = (speed**2 + abs(before) ** 2 - largest_change**2) / product
        turn = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    slip_left, slip_right = np.clip(
        [phase(before) - turn, phase(before) + turn], -LARGEST_SLIP, LARGEST_SLIP
    )
    leftmost = 2 * sin(slip_left) / length
    rightmost = 2 * sin(slip_right) / length
    curvature = min(max(curvature, leftmost), rightmost)

    # The lateral acceleration is within the grip.
    by_grip = grip / max(speed, 1e-3) ** 2
    sharpest = min(by_grip, 2 * GRIP_USE.largest_slip_sine / length)
    curvature = min(max(curvature, -sharpest), sharpest)

    # The acceleration takes what is left of the grip, and does not reverse the car.
    hardest = sqrt(max(grip**2 - (speed**2 * curvature) ** 2, 0.0))

    # The velocity along the heading changes by at most `largest_change`.
    angle = speed * curvature * dt
    room = sqrt(max(largest_change**2 - (speed * sin(angle)) ** 2, 0.0))
    slowest = speed * cos(angle) - room
    fastest = speed * cos(angle) + room
    lowest = max(-hardest, (max(slowest, 0.0) - speed) / dt, -speed / dt)
    return curvature, min(max(acceleration, lowest), hardest, (fastest - speed) / dt)


class RoadRobot(OfferedSpeeds, Vehicle):
    """Car that drives itself with a `RoadDriver`.

    It acts whenever its road lets vehicles act; it ignores all actions. It plans every
    `period` and holds the control in between, within its grip in every frame. It has
    every attribute that rewards and rules of highway-env's environments read from a
    controlled car.

    Attributes:
        period: time between two plans [s], rounded to frames of the simulation.
        grip_share: share of the grip that the robot uses.
        usual_grip: largest total acceleration by default [m/s^2].
        driver: makes the plans; without one, the car keeps its velocity.
        goal: node of the road network to drive to, a goal in time, or None.
        goal_place: node of the road network or spot on a lane where the goal is, or
            None.
        grip: largest total acceleration [m/s^2].
        intentions: whether the robot knows the routes of others.
        route: roads to follow, None without a route.
        last_step: record of the driver's last step, None before the first.
        applied: curvature and acceleration in the last frame [1/m, m/s^2].
        frame: duration of the last frame [s].
        time: since `drive_with` [s].
        steps: records of the driver's steps since `forget`.
        actions: highway-env's ``acceleration`` [m/s^2] and ``steering`` [rad] in each
            frame since `forget`.
        accelerations: the largest of three total accelerations in each frame since
            `forget`: of the control, and of the change of velocity with and without
            slip [m/s^2].
        jerks: mean jerk over the last `period`, in each frame since `forget` [m/s^3].
    """

    period: ClassVar[float] = 0.2
    grip_share: ClassVar[float] = 0.98
    usual_grip: ClassVar[float] = 5.0

    action: dict[str, float]

    def __init__(
        self,
        road: Road | None,
        position: Sequence[float] | np.ndarray,
        heading: float = 0,
        speed: float = 0,
    ) -> None:
        super().__init__(road, position, heading, speed)
        self.route: Route | None = None
        self.last_step: RoadStep | None = None
        self.applied = (0.0, 0.0)
        self._wanted = np.zeros(2)
        self._elapsed = np.inf
        self.frame = self.period

        # Velocity of the centre in the last frame, slip included.
        self._before: complex | None = None
        # Accelerations within the last period, lateral ones as imaginary parts.
        self._executed: list[complex] = []
        self.drive_with(None)
        self.forget()

    @classmethod
    def create_from(cls, vehicle: Vehicle) -> Self:
        """Return a car without a driver in the place of another vehicle.

        It is on the same route.
        """
        car = super().create_from(vehicle)
        car.route = getattr(vehicle, "route", None)
        return car

    def drive_with(
        self,
        driver: RoadDriver | AddedRoadDriver | None,
        goal: RobotGoal = None,
        grip: float = usual_grip,
        intentions: bool = False,
    ) -> None:
        """Let a driver drive to a goal; see the attributes for the arguments."""
        self.driver = driver
        self.goal = goal
        self.goal_place = goal.spot if isinstance(goal, TimedGoal) else goal
        self.grip = grip
        self.intentions = intentions
        self.time = 0.0
        if isinstance(driver, AddedRoadDriver):
            driver.robot = self  # along whose way it straightens the road

    def forget(self) -> None:
        """Forget the record of steps and frames."""
        self.steps: list[RoadStep] = []
        self.actions: list[dict[str, float]] = []
        self.accelerations: list[float] = []
        self.jerks: list[float] = []

    def look(self) -> RoadScene:
        """Observe the road."""
        return observe_road(self, self.goal_place, self.applied, self.intentions)

    def act(self, action: dict[str, float] | str | None = None) -> None:
        """Plan if a plan is due; ignore actions."""
        is_due = self._elapsed + self.frame / 2 >= self.period
        if action is not None or self.driver is None or not is_due or self.crashed:
            return
        if isinstance(self.goal, TimedGoal):
            self.goal.guide(self.driver, self, self.time)
        self.last_step = self.driver.step(self.look())
        self.steps.append(self.last_step)
        self._wanted = np.asarray(self.last_step.control, dtype=float)
        self._elapsed = 0.0

    def step(self, dt: float) -> None:
        """Move for ``dt`` seconds within the grip.

        After a crash, move like highway-env's vehicles.
        """
        self.time += dt
        if self.crashed:
            self.color = VehicleGraphics.RED
            super().step(dt)
            self.actions.append(dict(self.action))
            return

        # The wanted control within the grip.
        speed = self.speed
        along_heading = self._along_heading()
        before = along_heading if self._before is None else self._before
        relative = before * rect(1.0, -self.heading)
        grip = self.grip_share * self.grip
        curvature, acceleration = keep_grip(
            self._wanted, speed, relative, self.LENGTH, dt, grip
        )

        # Move.
        self.applied = curvature, acceleration
        self.action = {
            "steering": steering_of(curvature, self.LENGTH),
            "acceleration": acceleration,
        }
        super().step(dt)
        self._before = along_heading * rect(1.0, _slip_angle(curvature, self.LENGTH))
        self._elapsed = self._elapsed + dt
        self.frame = dt

        # Record the frame.
        self.actions.append(dict(self.action))
        change_of_centre = abs(self._before - before)
        change_along_heading = abs(self._along_heading() - along_heading)
        changed = max(change_of_centre, change_along_heading)
        executed = complex(acceleration, speed**2 * curvature)
        self.accelerations.append(max(abs(executed), changed / dt))
        frames = round(self.period / dt + 1)
        self._executed = [*self._executed, executed][-frames:]
        span = dt * max(len(self._executed) - 1, 1)
        self.jerks.append(abs(executed - self._executed[0]) / span)

    def _along_heading(self) -> complex:
        """Return the velocity along the heading as a complex number x + iy [m/s]."""
        return rect(self.speed, self.heading)

    @property
    def target_lane_index(self) -> LaneIndex:
        """The lane that the robot is on."""
        return self.lane_index

    plan_route_to = ControlledVehicle.plan_route_to
    predict_trajectory_constant_speed = at_constant_speed
