"""Move highway-env vehicles like a bicycle with friction: by actions, on a script or
along a route.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import atan, tan

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.game.dynamics import keep_velocity, step, within_grip
from ms_highway.game.scenario import PAPER_DYNAMICS
from ms_highway.runtime.arrays import Car, Control, State


def states_of(cars: Iterable[RoadObject]) -> State:
    """Return ``(x, y, heading, speed)`` of highway-env vehicles [cars, 4]."""
    return np.array(
        [(*car.position, car.heading, car.speed) for car in cars], dtype=float
    )


class OfferedSpeeds:
    """Add target speeds, which highway-env's rewards and observations read from the
    controlled car.

    Attributes:
        target_speeds: speeds that the environment offers as discrete actions [m/s].
    """

    speed: float
    target_speeds = MDPVehicle.DEFAULT_TARGET_SPEEDS
    index_to_speed = MDPVehicle.index_to_speed
    speed_to_index = MDPVehicle.speed_to_index

    @property
    def speed_index(self) -> int:
        """Index of the target speed nearest to the present speed."""
        return int(self.speed_to_index(self.speed))


class BicycleVehicle(Vehicle):
    """Car with the paper's dynamics: ``heading' = v omega``, ``v' = a - alpha v``.

    Actions are highway-env's ``{"steering": delta, "acceleration": a}`` with the
    front-wheel angle delta [rad], so that ``omega = tan(delta) / LENGTH``. Positions,
    headings and speeds are updated by `ms_highway.game.dynamics.step`.

    Attributes:
        dynamics: its friction alpha is 0.2 1/s by default.
        control: that is executed, ``(omega, acceleration)`` in the units of the
            dynamics.
        grip: total acceleration that its tyres hold, within which it moves, without
            reversing [m/s^2]; None for no limit.
    """

    WIDTH = 2.5  # m
    COLOR: tuple[int, int, int] | None = None

    speed: float
    crashed: bool
    impact: Control | None

    def __init__(
        self,
        road: Road | None,
        position: Sequence[float] | np.ndarray,
        heading: float = 0,
        speed: float = 0,
    ) -> None:
        super().__init__(road, position, heading, speed)
        self.dynamics = PAPER_DYNAMICS
        self.control = np.zeros(2)
        self.grip: float | None = None
        if self.COLOR:
            self.color = self.COLOR

    @property
    def state(self) -> Car:
        """``(x, y, heading, speed)`` in metres, radians and metres per second."""
        x, y = self.position
        return np.array([x, y, self.heading, self.speed], dtype=float)

    @property
    def friction(self) -> float:
        """Acceleration that keeps the speed [m/s^2]."""
        return float(keep_velocity(self.dynamics, self.state)[1])

    def act(self, action: dict[str, float] | None = None) -> None:
        """Execute an action until the next one; without an action, keep the last
        control.
        """
        if action:
            omega = tan(float(action["steering"])) / self.LENGTH
            if self.dynamics.steering != "curvature":
                omega *= self.speed
            self.execute(np.array([omega, float(action["acceleration"])]))

    def execute(self, control: Control) -> None:
        """Execute a control ``(omega, acceleration)``, in the units of the dynamics,
        until the next one.
        """
        self.control = np.asarray(control, dtype=float)
        omega, acceleration = self.control.tolist()
        curvature = omega
        if self.dynamics.steering != "curvature":
            curvature = omega / self.speed if self.speed else 0.0
        self.action = {
            "steering": atan(curvature * self.LENGTH),
            "acceleration": acceleration,
        }

    def randomize_behavior(self) -> None:
        """Do nothing: highway-env randomises its drivers here, but this car has no
        random behaviour.
        """

    def step(self, dt: float) -> None:
        """Move for ``dt`` seconds, within the grip; a crashed car brakes to a stop, as
        in highway-env.
        """
        dynamics = replace(self.dynamics, time_step=dt)
        if self.crashed:
            self.execute(np.array([0.0, -self.speed]))
        elif self.grip is not None:
            self.execute(
                within_grip(dynamics, self.grip, np.asarray(self.speed), self.control)
            )
        x, y, heading, speed = step(dynamics, self.state, self.control)
        self.position = np.array([x, y])
        self.heading = float(heading)
        self.speed = float(speed)
        if self.impact is not None:
            self.position += self.impact
            self.crashed = True
            self.impact = None
        self.on_state_update()

    def _is_colliding(
        self,
        other: RoadObject,
        dt: float,
    ) -> tuple[bool, bool, Control | None]:
        """Return whether the bodies overlap, whether they will within ``dt``, and the
        push apart; see `RoadObject`.

        If one of them is not solid, only the present overlap counts, and nothing is
        pushed.
        """
        return super()._is_colliding(other, dt if self.solid and other.solid else 0.0)


class ScriptedVehicle(BicycleVehicle):
    """Car that always keeps its velocity."""

    COLOR: tuple[int, int, int] | None = (150, 150, 160)

    def act(self, action: dict[str, float] | None = None) -> None:
        """Balance friction; ignore actions."""
        self.execute(keep_velocity(self.dynamics, self.state))


class RoutedVehicle(ScriptedVehicle):
    """Car that always follows a given route, and keeps its velocity after the end of
    the route.

    Args:
        road: that the car is on.
        states: ``(x, y, heading, speed)`` now and after every step, [times, 4].
    """

    def __init__(self, road: Road | None, states: State) -> None:
        x, y, heading, speed = states[0].tolist()
        super().__init__(road, [x, y], heading, speed)
        self.states = states
        self.place = 0

    def step(self, dt: float) -> None:
        """Move to the next state of the route; ``dt`` only counts after its end."""
        self.place += 1
        if self.place >= len(self.states):
            super().step(dt)
            return
        x, y, heading, speed = self.states[self.place].tolist()
        self.position = np.array([x, y])
        self.heading = heading
        self.speed = speed
        self.on_state_update()
