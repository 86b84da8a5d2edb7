"""Cars that a controller drives, in a game that they are told or by themselves on any highway-env road."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle
from jaxtyping import Bool, Float

from ms_highway.control.controller import Controller, ControlStep
from ms_highway.control.fallback import braking_control
from ms_highway.control.switching import ModelSwitching
from ms_highway.game.dynamics import within_grip
from ms_highway.game.game import Game
from ms_highway.game.neighbours import far_behind, headways
from ms_highway.game.scenario import PAPER_UNIT, SPEED_LIMIT
from ms_highway.vehicle.bicycle import BicycleVehicle
from ms_highway.vehicle.road_view import RoadView, Route, along_route, look, remaining_route, states_of

__all__ = ["PlanningVehicle", "RobotVehicle"]

STEADINESS = 0.5  # s, by which another neighbour's time gap has to be shorter than the partner's


class _Seen(NamedTuple):
    """Where a driver and its neighbours were: which places were taken, and the states of who took them."""

    taken: Bool[np.ndarray, "cars"]
    states: Float[np.ndarray, "taken 4"]

    def along(self, view: RoadView) -> Float[np.ndarray, "cars 4"]:
        """Their states in the coordinates of a view, those of who was not there far behind."""
        straight = view.straightened(self.states)
        states = np.tile(far_behind(straight[0]), (len(self.taken), 1))
        states[self.taken] = straight
        return states


def _seen(cars: Sequence[Vehicle | None]) -> _Seen:
    return _Seen(np.array([car is not None for car in cars]), states_of(filter(None, cars)))


def _at(view: RoadView, game: Game, speed_limit: float) -> Game:
    """A game in what a driver sees of a road."""
    limit = min(view.speed_limit, speed_limit)
    robot, human = (replace(reward, speed_limit=limit) for reward in (game.robot, game.human))
    return replace(game, scene=view.scene, robot=robot, human=human)


class PlanningVehicle(BicycleVehicle, ControlledVehicle):
    """A car that a controller drives; without a controller it takes actions like any other car.

    Told a controller and its companions, it plays the controller's game with them, as it is. Told a controller only,
    it drives by itself on any highway-env road: whenever it acts, it looks at the road anew, in the coordinates of its
    lane (see `ms_highway.vehicle.road_view`), and plays the controller's game in what it sees, with the speed limit
    that the road has there; then ``last_state`` and ``last_step`` are in these coordinates too.

    Its partner is then the neighbour with the shortest time gap (see `ms_highway.game.neighbours.headways`), and stays
    so until it is no neighbour any more, or another's gap is shorter by half a second. Then the controller is told that
    it meets another (`ms_highway.control.controller.Controller.reset_partner`).

    What tyres hold is looked at where the game's planner has a ``grip``, as those of
    `ms_highway.game.scenario.driving_game` have.

    To highway-env's own drivers and rules, it is one of their kind: they see where it is heading, and predict it at
    constant speed along its route. Where a ``RegulatedRoad`` lets it give way, it brakes.

    Attributes:
        controller: plans the controls, each time that the road lets its vehicles act.
        companions: the other cars of the controller's game, its partner first; none if it drives by itself.
        partner: the other player, None if there is none in sight.
        last_step: record of the controller's last step, None before the first.
        last_state: what the controller saw then, [cars, 4].
        route: the roads that it follows by itself, None to follow whichever it is on; those behind it are dropped.
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
        """A car of this kind in place of another, on the same route; what speed the other was told is forgotten."""
        car = cls(vehicle.road, vehicle.position, vehicle.heading, vehicle.speed)
        route = getattr(vehicle, "route", None)
        car.route = route and list(route)
        return car

    @property
    def target_speed(self) -> float:
        """The speed that it would go at most [m/s]: what it was told or, told None, its lane's limit; 0 to stop."""
        if self._target_speed is not None:
            return self._target_speed
        limit = self.lane.speed_limit if self.road else None
        return limit or SPEED_LIMIT * PAPER_UNIT

    @target_speed.setter
    def target_speed(self, speed: float | None) -> None:
        self._target_speed = speed

    def drive_with(self, controller: Controller, companions: Sequence[Vehicle] = ()) -> None:
        """Let a controller drive: in its game with these other cars, the partner first, or by itself without any."""
        self.controller = controller
        self.companions = list(companions)
        self.partner = self.companions[0] if self.companions else None

    def observe(self) -> Float[np.ndarray, "cars 4"]:
        """States of this car and of its companions."""
        return states_of([self, *self.companions])

    def act(self, action: dict[str, Any] | str | None = None) -> None:
        """Plan and take the plan's first control; an action that is given holds until the road lets vehicles act.

        Of highway-env's actions by name, a car that drives by itself takes ``"IDLE"`` only, which lets it.

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
        controller.game = _at(view, controller.game, self.target_speed)
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

    def _partners_place(self, view: RoadView) -> int:
        """The place of the neighbour that is the partner from now on; 0 if there is none."""
        gaps = headways(view.states[0], view.states[1:], self.LENGTH)
        gaps = np.where([car is not None for car in view.cars], gaps, np.inf)
        nearest = int(np.argmin(gaps))
        last = view.cars.index(self.partner) if self.partner in view.cars else nearest
        return nearest if gaps[nearest] < gaps[last] - STEADINESS else last

    def step(self, dt: float) -> None:
        """Move for ``dt`` seconds; where tyres are looked at, by no more than they hold, and never backwards.

        Raises:
            ValueError: if it drives by itself with Algorithm 1, and not at the rate of its game.
        """
        self._check_rate(dt)
        grip = self.controller.game.planner.grip if self.controller else None
        if grip is not None:
            dynamics = replace(self.dynamics, time_step=dt)
            self.execute(within_grip(dynamics, float(grip), np.asarray(self.speed), self.control))
        super().step(dt)

    def _check_rate(self, dt: float) -> None:
        """Algorithm 1 looks at one step of its game: by itself, the car has to act as often as that says."""
        controller = self.controller
        if isinstance(controller, ModelSwitching) and not self.companions:
            wanted = float(controller.game.world.time_step)
            if abs(dt - wanted) > 1e-6:
                told = f"the road moves in steps of {dt:g} s, and the game of Algorithm 1 in steps of {wanted:g} s"
                raise ValueError(f"{told}; configure the environment with 'simulation_frequency': {1 / wanted:g}")

    def predict_trajectory_constant_speed(
        self, times: Float[np.ndarray, "times"]
    ) -> tuple[list[Float[np.ndarray, "2"]], list[float]]:
        """Positions and headings at times from now [s], at this speed in the middle of its lane and along its route."""
        index, network = self.lane_index, self.road.network
        place, _ = network.get_lane(index).local_coordinates(self.position)
        return along_route(
            network, remaining_route(self.route or [index], index), index, place + self.speed * np.asarray(times)
        )

    def on_state_update(self) -> None:
        """See in which lane it is now."""
        super().on_state_update()
        self.target_lane_index = self.lane_index


class RobotVehicle(PlanningVehicle):
    """The robot: `drive_with` says which controller is its behaviour."""

    COLOR = (45, 160, 80)
