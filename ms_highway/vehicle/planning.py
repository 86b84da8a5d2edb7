"""Drive vehicles with a controller, in a given game or by themselves on any highway-env road."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Bool, Float

from ms_highway.control.controller import Controller, ControlStep
from ms_highway.control.driver import Driver
from ms_highway.control.fallback import braking_control
from ms_highway.game.dynamics import within_grip
from ms_highway.game.game import Game
from ms_highway.game.neighbours import far_behind, headways
from ms_highway.game.scenario import PAPER_UNIT, SPEED_LIMIT
from ms_highway.vehicle.bicycle import BicycleVehicle
from ms_highway.vehicle.road_view import RoadView, Route, at_constant_speed, look, states_of

__all__ = ["PlanningVehicle", "RobotVehicle"]

STEADINESS = 0.5  # s, by which a neighbour's time gap must be shorter than the partner's to replace it


class _Seen(NamedTuple):
    """Previous states of a driver and its neighbours, and which places were taken."""

    taken: Bool[np.ndarray, "cars"]
    states: Float[np.ndarray, "taken 4"]

    def along(self, view: RoadView) -> Float[np.ndarray, "cars 4"]:
        """Return their states in the coordinates of a view; states of empty places are far behind."""
        straight = view.straightened(self.states)
        states = np.tile(far_behind(straight[0]), (len(self.taken), 1))
        states[self.taken] = straight
        return states


def _seen(cars: Sequence[Vehicle | None]) -> _Seen:
    return _Seen(np.array([car is not None for car in cars]), states_of(filter(None, cars)))


def _at(view: RoadView, game: Game, limit: float) -> Game:
    """Return a game in a driver's view of a road, at a speed limit."""
    robot, humans = (replace(reward, speed_limit=limit) for reward in (game.robot, game.humans))
    return replace(game, scene=view.scene, robot=robot, humans=humans)


class PlanningVehicle(BicycleVehicle, ControlledVehicle):
    """Car driven by a controller; without one, it takes actions like any other car.

    With a controller and companions, it plays the controller's game with them. With a controller only, it drives by
    itself on any highway-env road: whenever it acts, it views the road in the coordinates of its lane (see
    `ms_highway.vehicle.road_view`) and plays the controller's game in this view, with the speed limit of the road;
    ``last_state`` and ``last_step`` are then in these coordinates.

    Its partner is then the neighbour with the shortest time gap (see `ms_highway.game.neighbours.headways`), until it
    is no longer a neighbour or another's gap is shorter by half a second; then the controller forgets the partner
    (`ms_highway.control.controller.Controller.reset_partner`).

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
        route: roads to follow, None to follow whichever it is on; those behind it are dropped.
        target_lane_index: the lane that it is on.
    """

    def __init__(self, road: Road | None, position: Sequence[float], heading: float = 0, speed: float = 0) -> None:
        super().__init__(road, position, heading, speed)
        self.route: Route | None = None
        self.target_speed = None
        self.controller: Controller | None = None
        self.companions: list[Vehicle] = []
        self.partner: Vehicle | None = None
        self.last_step: ControlStep | None = None
        self.last_state: Float[np.ndarray, "cars 4"] | None = None
        self._before: _Seen | None = None

    @classmethod
    def create_from(cls, vehicle: Vehicle) -> Self:
        """Replace another vehicle by a car of this class, on the same route; its target speed is forgotten."""
        car = cls(vehicle.road, vehicle.position, vehicle.heading, vehicle.speed)
        route = getattr(vehicle, "route", None)
        car.route = route and list(route)
        return car

    @property
    def target_speed(self) -> float:
        """Maximum speed [m/s], by default (None) that of its lane; 0 to stop."""
        if self._target_speed is not None:
            return self._target_speed
        limit = self.lane.speed_limit if self.road else None
        return limit or SPEED_LIMIT * PAPER_UNIT

    @target_speed.setter
    def target_speed(self, speed: float | None) -> None:
        self._target_speed = speed

    def drive_with(self, controller: Controller, companions: Sequence[Vehicle] = ()) -> None:
        """Let a controller drive: in its game with these other cars, the partner first; without any, by itself."""
        self.controller = controller
        self.companions = list(companions)
        self.partner = self.companions[0] if self.companions else None

    def observe(self) -> Float[np.ndarray, "cars 4"]:
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
            self._take(self.controller.step(self.last_state))
        elif not self.crashed:
            self._drive_on_road(self.controller)

    def _take(self, planned: ControlStep, bend: float = 0.0) -> None:
        """Take the control of a step in the coordinates of a road with a bend [1/m]."""
        self.last_step = planned
        self.execute(planned.control + np.array([bend, 0.0]))

    def _drive_on_road(self, controller: Controller) -> None:
        """Plan as if the lane were straight, and add its bend to the plan's first control."""
        view = look(self, self.route)
        self.route = self.route and view.route
        controller.game = _at(view, controller.game, self.desired_speed(view))
        if self.target_speed <= 0:
            self.execute(braking_control(controller.game, view.states[0]) + np.array([view.bend, 0.0]))
            self._before = None
            return
        place = self._partners_place(view)
        if view.cars[place] is not self.partner or self._before is None:
            controller.reset_partner()
            self.partner, self._before = view.cars[place], None
        order = [place, *(other for other in range(len(view.cars)) if other != place)]
        self.last_state = view.states[[0, *(number + 1 for number in order)]]
        self._take(controller.step(self.last_state, self._before and self._before.along(view)), view.bend)
        self._before = _seen([self, *(view.cars[number] for number in order)])

    def desired_speed(self, view: RoadView) -> float:
        """Return the speed at which its reward of speed is highest [m/s]: the road's limit, at most `target_speed`."""
        return min(view.speed_limit, self.target_speed)

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
            ValueError: if it drives by itself with Algorithm 1 or a belief, and ``dt`` is not its game's time step.
        """
        self._check_rate(dt)
        grip = self.controller.game.planner.grip if self.controller else None
        if grip is not None:
            dynamics = replace(self.dynamics, time_step=dt)
            self.execute(within_grip(dynamics, float(grip), np.asarray(self.speed), self.control))
        super().step(dt)

    def _check_rate(self, dt: float) -> None:
        """Check that a car that drives by itself and learns from its steps acts at the time step of its game."""
        controller = self.controller
        if not isinstance(controller, Driver) or self.companions:
            return
        if controller.looks_back:
            wanted = float(controller.game.world.time_step)
            if abs(dt - wanted) > 1e-6:
                told = f"the road moves in steps of {dt:g} s, and the robot's game in steps of {wanted:g} s"
                raise ValueError(f"{told}; configure the environment with 'simulation_frequency': {1 / wanted:g}")

    def predict_trajectory_constant_speed(
        self, times: Float[np.ndarray, "times"]
    ) -> tuple[list[Float[np.ndarray, "2"]], list[float]]:
        """See `ms_highway.vehicle.road_view.at_constant_speed`."""
        return at_constant_speed(self, times)

    def on_state_update(self) -> None:
        """Update the lane that it is on."""
        super().on_state_update()
        self.target_lane_index = self.lane_index


class RobotVehicle(PlanningVehicle):
    """The robot; `drive_with` sets its controller."""

    COLOR = (45, 160, 80)
