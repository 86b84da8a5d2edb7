"""highway-env vehicles: a bicycle with friction, cars on a script or a route, and cars that plan."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import atan, cos, sin, tan
from typing import Any, ClassVar

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject
from jaxtyping import Float

from ms_highway.controller import Controller, ControlStep, FixedModel
from ms_highway.dynamics import keep_velocity, step
from ms_highway.human_models import Naive
from ms_highway.learnt import shipped
from ms_highway.planner import Solver
from ms_highway.road_view import Route, look
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


def states_of(cars: Iterable[Vehicle]) -> Float[np.ndarray, "cars 4"]:
    """``(x, y, heading, speed)`` of any of highway-env's vehicles."""
    return np.array([(*car.position, car.heading, car.speed) for car in cars], dtype=float)


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


class PlanningVehicle(BicycleVehicle):
    """A car that a controller drives; without a controller it takes actions like any other car.

    Attributes:
        controller: plans the controls, each time that the road lets its vehicles act.
        companions: the other cars of the controller's game, its partner first.
        last_step: record of the controller's last step, None before the first.
        last_state: what the controller saw then, [cars, 4].
    """

    def __init__(self, road: Road | None, position: Sequence[float], heading: float = 0, speed: float = 0) -> None:
        super().__init__(road, position, heading, speed)
        self.controller: Controller | None = None
        self.companions: list[Vehicle] = []
        self.last_step: ControlStep | None = None
        self.last_state: Float[np.ndarray, "cars 4"] | None = None

    def drive_with(self, controller: Controller, companions: Sequence[Vehicle]) -> None:
        """Let a controller drive, in a game with these other cars, the partner first."""
        self.controller = controller
        self.companions = list(companions)

    def observe(self) -> Float[np.ndarray, "cars 4"]:
        """States of this car and of its companions."""
        return states_of([self, *self.companions])

    def act(self, action: dict[str, Any] | None = None) -> None:
        """Plan and take the plan's first control; an action that is given holds until the road lets vehicles act."""
        if action or self.controller is None:
            super().act(action)
            return
        self.last_state = self.observe()
        self.last_step = self.controller.step(self.last_state)
        self.execute(self.last_step.control)


class RobotVehicle(PlanningVehicle):
    """The robot: `drive_with` says which controller is its behaviour."""

    COLOR = (45, 160, 80)


class HumanVehicle(PlanningVehicle):
    """A human driver: plans for its own reward and believes that all others keep their velocity.

    In the scenarios of this package it is told its game by `drive_with`. On any other highway-env road it drives by
    itself, for ``weights`` among its neighbours, so that it can be the ``other_vehicles_type`` of a stock environment.
    It looks at the road anew whenever it acts, in the coordinates of its lane (see `ms_highway.road_view`); then
    ``last_state`` and ``last_step`` are in these coordinates too. It knows no right of way: where roads cross, it sees
    others only once they are in its lane or beside it.

    Attributes:
        weights: of the reward that it drives for by itself, by name: those learnt from demonstrations.
        solver: how it plans for them, see `ms_highway.planner.climb`; weights over a temperature need ``newton``.
        route: the roads that it follows by itself, None to follow whichever it is on.
        target_speed: a lower limit [m/s] than the lane's, None or 0 without one.
        enable_lane_change: what stock environments tell their drivers; to a human, only its reward says where to go.
    """

    COLOR = (60, 130, 220)
    weights: ClassVar[Mapping[str, float]] = shipped("demonstrations").weights
    solver: ClassVar[Solver] = "gradient"

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
        self.route: Route | None = None
        self.target_speed: float | None = None
        self._alone: FixedModel | None = None

    plan_route_to = ControlledVehicle.plan_route_to

    def act(self, action: dict[str, Any] | None = None) -> None:
        """Plan for the own reward: in the game that `drive_with` told, or else on the road as it looks now."""
        if action or self.controller is not None or self.road is None:
            super().act(action)
        elif not self.crashed:
            self._drive_on_road()

    def _drive_on_road(self) -> None:
        """Plan as if the lane were straight, and add its bend to the plan's first control."""
        view = look(self, self.route)
        limit = view.speed_limit or SPEED_LIMIT * PAPER_UNIT
        game = driving_game(view.scene, min(limit, self.target_speed or limit), self.weights, solver=self.solver)
        if self._alone is None:
            self._alone = FixedModel(game, Naive())
        self._alone.game = game
        self.last_state = view.states
        self.last_step = self._alone.step(view.states)
        self.execute(self.last_step.control + np.array([view.curvature, 0.0]))


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
