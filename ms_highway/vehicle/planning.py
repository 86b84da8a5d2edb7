"""Drive vehicles with a controller, in a given game or by themselves on any highway-env road."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
from highway_env.road.road import Road, Route
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.game.dynamics import within_grip
from ms_highway.game.neighbours import headways
from ms_highway.geometry.road_map import LIMIT
from ms_highway.loop.controller import Controller, ControlStep
from ms_highway.loop.driver import Driver
from ms_highway.loop.fallback import braking_control
from ms_highway.runtime.arrays import State
from ms_highway.vehicle.bicycle import BicycleVehicle, OfferedSpeeds
from ms_highway.vehicle.road_view import (
    RoadView,
    at_constant_speed,
    in_the_world,
    look,
    states_of,
    straightened,
)

STEADINESS = 0.5  # s, by which a neighbour's time gap must be shorter than the partner's to replace it


class PlanningVehicle(BicycleVehicle, ControlledVehicle):
    """Car driven by a controller; without one, it takes actions like any other car.

    With a controller and companions, it plays the controller's game with them. With a controller only, it drives by
    itself on any highway-env road: whenever it acts, it views the road in the coordinates of its lane (see
    `ms_highway.vehicle.road_view`) and plays the controller's game in this view, with the speed limit of the road;
    ``last_state`` and ``last_step`` are then in these coordinates.

    Its partner is then the neighbour with the shortest time gap (see `ms_highway.game.neighbours.headways`), until it
    is no longer a neighbour or another's gap is shorter by half a second; then the controller forgets the partner
    (`ms_highway.loop.controller.Controller.reset_partner`).

    The grip of tyres is respected where the game's planner has a ``grip``, as in
    `ms_highway.game.scenario.driving_game`.

    highway-env's own drivers and rules treat it like their own: they see its lane and predict it at constant speed
    along its route. Where a ``RegulatedRoad`` makes it yield, it brakes.

    Attributes:
        controller: plans whenever the road lets its vehicles act.
        companions: other cars of the controller's game, its partner first; none if it drives by itself.
        partner: the other player, None if none is in sight.
        last_step: record of the controller's last step, None before the first.
        last_state: states that the controller planned in then, [cars, 4].
        route: roads to follow, None to follow whichever it is on.
        target_lane_index: the lane that it is on.
    """

    def __init__(self, road: Road | None, position: Sequence[float], heading: float = 0, speed: float = 0) -> None:
        super().__init__(road, position, heading, speed)
        self.route: Route | None = None
        self.target_speed = None
        self.last_step: ControlStep | None = None
        self.last_state: State | None = None
        self._before: State | None = None  # of itself and of its neighbours a step ago, in highway-env's coordinates
        self.drive_with(None)

    @classmethod
    def create_from(cls, vehicle: Vehicle, **options: Any) -> Self:
        """Replace another vehicle by a car of this class, on the same route; its target speed is forgotten."""
        car = cls(vehicle.road, vehicle.position, vehicle.heading, vehicle.speed, **options)
        car.route = getattr(vehicle, "route", None)
        return car

    @property
    def target_speed(self) -> float:
        """Maximum speed [m/s], by default (None) that of its lane; 0 to stop."""
        if self._target_speed is not None:
            return self._target_speed
        return (self.road and self.lane.speed_limit) or LIMIT

    @target_speed.setter
    def target_speed(self, speed: float | None) -> None:
        self._target_speed = speed

    def drive_with(self, controller: Controller | None, companions: Sequence[Vehicle] = ()) -> None:
        """Let a controller drive: in its game with these other cars, the partner first; without any, by itself."""
        self.controller = controller
        self.companions = list(companions)
        self.partner: Vehicle | None = self.companions[0] if companions else None

    def observe(self) -> State:
        """Return the states of this car and of its companions."""
        return states_of([self, *self.companions])

    def act(self, action: dict[str, Any] | str | None = None) -> None:
        """Plan and execute the plan's first control; an action is executed instead, until vehicles act again.

        Of highway-env's actions by name, only ``"IDLE"`` is allowed, which lets the car plan.

        Raises:
            ValueError: for another action by name.
        """
        if isinstance(action, str):
            if action != "IDLE":
                raise ValueError(f"a car that plans cannot be told to go {action!r}; its only such action is 'IDLE'")
        elif action or self.controller is None:
            BicycleVehicle.act(self, action)
        elif self.companions:
            self.last_state = self.observe()
            self.last_step = self.controller.step(self.last_state)
            self.execute(self.last_step.control)
        elif not self.crashed:
            self._drive_on_road(self.controller)

    def _drive_on_road(self, controller: Controller) -> RoadView:
        """Plan as if the lane were straight, and add its bend to the plan's first control; return the view."""
        view = look(self)
        limit = min(view.speed_limit, self.target_speed)
        robot, humans = (replace(who, speed_limit=limit) for who in (controller.game.robot, controller.game.humans))
        controller.game = replace(controller.game, scene=view.scene, robot=robot, humans=humans)
        if self.target_speed <= 0:
            control, self._before = braking_control(controller.game, view.states[0]), None
        else:
            place = self._partners_place(view)
            if view.cars[place] is not self.partner or self._before is None:
                controller.reset_partner()
                self.partner, self._before = view.cars[place], None
            order = [0, 1 + place, *(row for row in range(1, len(view.states)) if row != 1 + place)]
            self.last_state = view.states[order]
            before = None if self._before is None else straightened(view.seen.route, self._before)
            self.last_step = controller.step(self.last_state, before)
            self._before = in_the_world(view.seen.route, self.last_state)
            control = self.last_step.control
        self.execute(control + np.array([view.scene.bend, 0.0]))
        return view

    def _partners_place(self, view: RoadView) -> int:
        """Return the place of the neighbour that is the partner from now on; 0 if there is none."""
        gaps = headways(view.states[0], view.states[1:], self.LENGTH)
        gaps = np.where([car is not None for car in view.cars], gaps, np.inf)
        nearest = int(np.argmin(gaps))
        last = view.cars.index(self.partner) if self.partner in view.cars else nearest
        return nearest if gaps[nearest] < gaps[last] - STEADINESS else last

    def step(self, dt: float) -> None:
        """Move for ``dt`` seconds; with a ``grip``, within it and never backwards.

        Raises:
            ValueError: if it drives by itself and chooses models or infers beliefs by its last step, and ``dt`` is not
                its game's time step.
        """
        if isinstance(self.controller, Driver) and self.controller.looks_back and not self.companions:
            wanted = float(self.controller.game.world.time_step)
            if abs(dt - wanted) > 1e-6:
                message = f"the road moves in steps of {dt:g} s, and the robot's game in steps of {wanted:g} s"
                raise ValueError(f"{message}; configure the environment with 'simulation_frequency': {1 / wanted:g}")
        grip = self.controller.game.planner.grip if self.controller else None
        if grip is not None:
            dynamics = replace(self.dynamics, time_step=dt)
            self.execute(within_grip(dynamics, float(grip), np.asarray(self.speed), self.control))
        super().step(dt)

    predict_trajectory_constant_speed = at_constant_speed

    def on_state_update(self) -> None:
        """Update the lane that it is on."""
        super().on_state_update()
        self.target_lane_index = self.lane_index


class RobotVehicle(OfferedSpeeds, PlanningVehicle):
    """The robot; `drive_with` sets its controller."""

    COLOR = (45, 160, 80)
