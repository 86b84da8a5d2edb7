"""Define vehicles that a controller drives in a game: the robot and the humans of this
package's environments.
"""

from collections.abc import Sequence
from typing import Self

import numpy as np
from highway_env.road.road import Road, Route
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.geometry.lane_paths import Point, Row
from ms_highway.geometry.road_map import Lane
from ms_highway.loop.controller import Controller, ControlStep
from ms_highway.perception.observation import observe_road
from ms_highway.runtime.arrays import State
from ms_highway.vehicle.bicycle import BicycleVehicle, OfferedSpeeds, states_of


def at_constant_speed(vehicle: Vehicle, times: Row) -> tuple[list[Point], list[float]]:
    """Predict positions and headings of a vehicle at times from now [s], at constant
    speed along its lanes.
    """
    if "road_memory" not in vars(vehicle):
        observe_road(vehicle)
    network = vehicle.road.network
    lanes = vehicle.road_memory.lanes
    pose = vehicle.position, vehicle.heading

    # The vehicle is on the nearest of the lanes that it follows.
    first = int(
        np.argmin(
            [network.get_lane(index).distance_with_heading(*pose) for index in lanes]
        )
    )
    place, _ = network.get_lane(lanes[first]).local_coordinates(vehicle.position)
    ahead = [
        network.position_heading_along_route(
            lanes[first:], place + vehicle.speed * time, 0, vehicle.lane_index
        )
        for time in times
    ]
    return [position for position, _ in ahead], [heading for _, heading in ahead]


class PlanningVehicle(BicycleVehicle, ControlledVehicle):
    """Car that a controller drives in a game with companions; without a controller, it
    takes actions like other cars.

    It keeps to the grip of tyres if the game's planner has a ``grip``, as in
    `ms_highway.game.scenario.driving_game`.

    highway-env's drivers and rules treat it like their own cars: they see its lane and
    predict it at constant speed along its route.

    Attributes:
        controller: plans whenever the road lets its vehicles act.
        companions: other cars of the controller's game, its partner first.
        last_step: record of the controller's last step, None before the first.
        last_state: states in which the controller planned then, [cars, 4].
        route: roads to follow; None to follow the present road.
        target_lane_index: the present lane.
    """

    def __init__(
        self,
        road: Road | None,
        position: Sequence[float] | np.ndarray,
        heading: float = 0,
        speed: float = 0,
    ) -> None:
        super().__init__(road, position, heading, speed)
        self.route: Route | None = None
        self.target_speed = None
        self.last_step: ControlStep | None = None
        self.last_state: State | None = None
        self.drive_with(None)

    @classmethod
    def create_from(cls, vehicle: Vehicle, **options: float) -> Self:
        """Make a car of this class from another vehicle, with the same route, but
        without its target speed.
        """
        car = cls(
            vehicle.road, vehicle.position, vehicle.heading, vehicle.speed, **options
        )
        car.route = getattr(vehicle, "route", None)
        return car

    @property
    def target_speed(self) -> float:
        """Maximum speed [m/s]; its lane's if it is set to None, as by default; 0 to
        stop.
        """
        if self._target_speed is not None:
            return self._target_speed
        return (self.road and self.lane.speed_limit) or Lane.default_speed_limit

    @target_speed.setter
    def target_speed(self, speed: float | None) -> None:
        self._target_speed = speed

    def drive_with(
        self,
        controller: Controller | None,
        companions: Sequence[Vehicle] = (),
    ) -> None:
        """Let a controller drive, in its game with these other cars, the partner first,
        and within its grip.
        """
        self.controller = controller
        self.companions = list(companions)
        grip = controller.game.planner.grip if controller else None
        self.grip = None if grip is None else float(grip)

    def observe(self) -> State:
        """Return the states of this car and of its companions."""
        return states_of([self, *self.companions])

    def act(self, action: dict[str, float] | str | None = None) -> None:
        """Plan and execute the plan's first control, or else execute the given action
        until vehicles act again.

        Of highway-env's actions by name, only ``"IDLE"`` is allowed, which does
        nothing.

        Raises:
            ValueError: for another action by name.
        """
        if isinstance(action, str):
            if action != "IDLE":
                raise ValueError(
                    f"a car that plans cannot be told to go {action!r}; its only such"
                    " action is 'IDLE'"
                )
        elif action or self.controller is None:
            BicycleVehicle.act(self, action)
        else:
            self.last_state = self.observe()
            self.last_step = self.controller.step(self.last_state)
            self.execute(self.last_step.control)

    predict_trajectory_constant_speed = at_constant_speed

    def on_state_update(self) -> None:
        """Update the present lane."""
        super().on_state_update()
        self.target_lane_index = self.lane_index


class RobotVehicle(OfferedSpeeds, PlanningVehicle):
    """The robot; `drive_with` sets its controller."""

    COLOR = (45, 160, 80)


class HumanVehicle(PlanningVehicle):
    """Human that a controller drives in a game of its own, which `drive_with` sets, as
    in this package's environments.

    It does not drive by itself; the human for other highway-env roads is
    `ms_highway.CommuterVehicle`.
    """

    COLOR = (60, 130, 220)

    def act(self, action: dict[str, float] | str | None = None) -> None:
        """Plan and execute the plan's first control, or else execute the given action
        until vehicles act again.

        Raises:
            ValueError: without a controller and an action.
        """
        if self.controller is None and not action:
            raise ValueError(
                "a HumanVehicle does not drive by itself: set its controller with"
                " drive_with, or use ms_highway.vehicle.CommuterVehicle, which drives"
                " on any highway-env road"
            )
        super().act(action)
