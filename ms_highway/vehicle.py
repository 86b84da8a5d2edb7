"""highway-env vehicles: a bicycle with friction, cars on a script or a route, and cars that plan."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import atan, cos, sin, tan
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject
from jaxtyping import Bool, Float

from ms_highway.ascent import PAPER_ASCENT, Ascent
from ms_highway.controller import Controller, ControlStep, FixedModel, ModelSwitching, braking_control
from ms_highway.dynamics import keep_velocity, step, within_grip
from ms_highway.game import Game
from ms_highway.human_models import Naive
from ms_highway.learnt import shipped
from ms_highway.neighbours import far_behind, headways
from ms_highway.planner import Solver
from ms_highway.road_view import RoadView, Route, follow, left_of, look, states_of
from ms_highway.scenario import COMMON_WEIGHTS, PAPER_DYNAMICS, PAPER_UNIT, SPEED_LIMIT, driving_game

__all__ = [
    "BicycleVehicle",
    "CommuterVehicle",
    "HumanVehicle",
    "PlanningVehicle",
    "RobotVehicle",
    "RoutedVehicle",
    "ScriptedVehicle",
    "states_of",
]


STEADINESS = 0.5  # s, by which another neighbour's time gap has to be shorter than the partner's


def _apart(one: RoadObject, other: RoadObject) -> bool:
    """Whether a line along or across the first body keeps the two apart."""
    x, y = (other.position - one.position).tolist()
    forward, right = cos(one.heading), sin(one.heading)
    turn = other.heading - one.heading
    cosine, sine = abs(cos(turn)), abs(sin(turn))
    return (
        abs(x * forward + y * right) > (one.LENGTH + other.LENGTH * cosine + other.WIDTH * sine) / 2
        or abs(y * forward - x * right) > (one.WIDTH + other.LENGTH * sine + other.WIDTH * cosine) / 2
    )


class BicycleVehicle(Vehicle):
    """A car with the paper's dynamics: ``heading' = v omega``, ``v' = a - alpha v``.

    Actions are highway-env's ``{"steering": delta, "acceleration": a}`` with the front-wheel angle delta [rad], so
    that ``omega = tan(delta) / LENGTH``. Positions, headings and speeds are updated by `ms_highway.dynamics.step`.

    Attributes:
        dynamics: the law of motion; friction alpha is 0.2 1/s unless replaced.
        control: what is executed, ``(omega, acceleration)`` in the units of the law.
    """

    WIDTH = 2.5  # m
    COLOR: tuple[int, int, int] | None = None

    speed: float
    crashed: bool
    impact: Float[np.ndarray, "2"] | None

    def __init__(self, road: Road | None, position: Sequence[float], heading: float = 0, speed: float = 0) -> None:
        super().__init__(road, position, heading, speed)
        self.dynamics = PAPER_DYNAMICS
        self.control = np.zeros(2)
        if self.COLOR:
            self.color = self.COLOR

    @property
    def state(self) -> Float[np.ndarray, "4"]:
        """``(x, y, heading, speed)`` in metres, radians and metres per second."""
        return states_of([self])[0]

    def act(self, action: dict[str, Any] | None = None) -> None:
        """Take an action, to be executed until the next one; without one, go on with the last."""
        if action:
            curvature = tan(float(action["steering"])) / self.LENGTH
            omega = curvature if self.dynamics.steering == "curvature" else curvature * self.speed
            self.execute(np.array([omega, float(action["acceleration"])]))

    def execute(self, control: Float[np.ndarray, "2"]) -> None:
        """Take a control ``(omega, acceleration)`` in the units of the law of motion, until the next one."""
        self.control = np.asarray(control, dtype=float)
        omega, acceleration = self.control
        curvature = omega if self.dynamics.steering == "curvature" else omega / self.speed if self.speed else 0.0
        self.action = {"steering": atan(curvature * self.LENGTH), "acceleration": float(acceleration)}

    def randomize_behavior(self) -> None:
        """Nothing to do: highway-env varies its own drivers like this, and nothing about this car is random."""

    def step(self, dt: float) -> None:
        """Move for ``dt`` seconds; a crashed car brakes to a stop, as highway-env has it."""
        if self.crashed:
            self.execute(np.array([0.0, -self.speed]))
        dynamics = replace(self.dynamics, time_step=dt)
        x, y, heading, speed = step(dynamics, self.state, self.control)
        self.position = np.array([x, y])
        self.heading, self.speed = float(heading), float(speed)
        if self.impact is not None:
            self.position += self.impact
            self.crashed = True
            self.impact = None
        self.on_state_update()

    def _is_colliding(self, other: RoadObject, dt: float) -> tuple[bool, bool, Float[np.ndarray, "2"] | None]:
        """Whether the bodies overlap, will within ``dt``, and how to push them apart; see `RoadObject`.

        Where one of them is not solid, nothing will be pushed: then it only counts whether they overlap now, that is
        whether no line along or across either body keeps them apart.
        """
        if self.solid and other.solid:
            return super()._is_colliding(other, dt)
        return not (_apart(self, other) or _apart(other, self)), False, None


class ScriptedVehicle(BicycleVehicle):
    """A car that keeps its velocity, whatever happens."""

    COLOR = (150, 150, 160)

    def act(self, action: dict[str, Any] | None = None) -> None:
        """Make up for friction; actions are ignored."""
        self.execute(keep_velocity(self.dynamics, self.state))


class RoutedVehicle(BicycleVehicle):
    """A car on a route that was worked out beforehand, whatever happens; past its end, the car keeps its velocity.

    Args:
        road: where.
        route: ``(x, y, heading, speed)`` now and after every step, [times, 4].
    """

    COLOR = (150, 150, 160)

    def __init__(self, road: Road | None, route: Float[np.ndarray, "times 4"]) -> None:
        x, y, heading, speed = route[0].tolist()
        super().__init__(road, [x, y], heading, speed)
        self.route = route
        self.place = 0

    def act(self, action: dict[str, Any] | None = None) -> None:
        """Make up for friction, for after the route; actions are ignored."""
        self.execute(keep_velocity(self.dynamics, self.state))

    def step(self, dt: float) -> None:
        """Go to the next state of the route, however long ``dt`` is."""
        self.place += 1
        if self.place >= len(self.route):
            super().step(dt)
            return
        x, y, heading, speed = self.route[self.place].tolist()
        self.position = np.array([x, y])
        self.heading, self.speed = heading, speed
        self.on_state_update()


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
    lane (see `ms_highway.road_view`), and plays the controller's game in what it sees, with the speed limit that the
    road has there; then ``last_state`` and ``last_step`` are in these coordinates too.

    Its partner is then the neighbour with the shortest time gap (see `ms_highway.neighbours.headways`), and stays so
    until it is no neighbour any more, or another's gap is shorter by half a second. Then the controller is told that it
    meets another (`ms_highway.controller.Controller.meet`).

    What tyres hold is looked at where the game's planner has a ``grip``, as those of
    `ms_highway.scenario.driving_game` have.

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
            controller.meet()
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
        return follow(network, left_of(self.route or [index], index), index, place + self.speed * np.asarray(times))

    def on_state_update(self) -> None:
        """See in which lane it is now."""
        super().on_state_update()
        self.target_lane_index = self.lane_index


class RobotVehicle(PlanningVehicle):
    """The robot: `drive_with` says which controller is its behaviour."""

    COLOR = (45, 160, 80)


class HumanVehicle(PlanningVehicle):
    """A human driver: plans for its own reward and believes that all others keep their velocity.

    In the scenarios of this package it is told its game by `drive_with`. On any other highway-env road it drives by
    itself, for ``weights`` among its neighbours, so that it can be the ``other_vehicles_type`` of a stock environment.

    It knows no right of way where a road does not enforce it, and sees cars from other roads only once they are in its
    lane or beside it: it is not meant for roundabouts among cars that brake for nobody. In 20 episodes of
    roundabout-v0, humans collide with the idle ego in all (highway-env's IDM cars in 5), and with each other in 2; with
    a car of their own kind in the ego's place, there are collisions in 9 (among IDM cars in 12).

    It looks half a second ahead and keeps no distance for its own sake: within what tyres hold, it runs into a car
    ahead that is slower by 8 m/s or more. With an `ms_highway.ascent.Ascent` of 10 steps it does not at 8 m/s, for
    three to four times the computing, but still does at 12; `CommuterVehicle`, which keeps its distance, stops behind
    a standing car.

    It does not change lanes in dense traffic: in 20 s of highway-v0 among 150 cars, IDM cars change lanes 39 times,
    humans never. Looking further does not help: behind a car of 12 m/s beside an empty lane, it stays there with
    horizons of up to 3 s and the Newton solver, since a plan climbs from where the car is, and between lanes it would
    earn less first. That takes plans that start in another lane.

    Attributes:
        weights: of the reward that it drives for by itself, by name: those learnt from demonstrations.
        solver: how it plans for them, see `ms_highway.planner.climb`; weights over a temperature need ``newton``.
        ascent: how far ahead it plans.
        enable_lane_change: what stock environments tell their drivers; to a human, only its reward says where to go.
    """

    COLOR = (60, 130, 220)
    weights: ClassVar[Mapping[str, float]] = shipped("demonstrations").weights
    solver: ClassVar[Solver] = "gradient"
    ascent: ClassVar[Ascent] = PAPER_ASCENT

    def __init__(
        self,
        road: Road | None,
        position: Sequence[float],
        heading: float = 0,
        speed: float = 0,
        enable_lane_change: bool = True,
    ) -> None:
        super().__init__(road, position, heading, speed)
        self.enable_lane_change = enable_lane_change

    def act(self, action: dict[str, Any] | str | None = None) -> None:
        """Plan for the own reward: in the game that `drive_with` told, or else on the road as it looks now."""
        if not action and self.controller is None and self.road is not None:
            view = look(self, self.route)
            game = driving_game(view.scene, view.speed_limit, self.weights, solver=self.solver, ascent=self.ascent)
            self.drive_with(FixedModel(game, Naive()))
        super().act(action)


def _commuting() -> dict[str, float]:
    """Weights of `CommuterVehicle`."""
    learnt = shipped("us101")
    kept = {name: float(COMMON_WEIGHTS[name]) for name in ("lane_alignment", "collision_risk", "off_road")}
    return {name: weight / learnt.temperature for name, weight in (learnt.weights | kept).items()}


class CommuterVehicle(HumanVehicle):
    """A human driver that goes with the traffic, like those who were recorded on US-101.

    Speed, distances to others and comfort weigh what was learnt from them. What dense traffic on a straight highway
    tells little about, how to leave a lane that ends and not to hit anything, weighs what it does in the paper: with
    the learnt weights alone, humans run into standing cars, and into what stands at the end of a ramp. It is hardly
    drawn to the speed limit: on an empty road it takes minutes to get there.
    """

    COLOR = (150, 90, 200)
    weights = _commuting()
    solver = "newton"
