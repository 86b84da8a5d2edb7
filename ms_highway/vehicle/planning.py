"""Define vehicles that a controller drives in a game, and vehicles that drive like humans, for a learned reward."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, Route
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import RoadObject

from ms_highway.game.learned_drivers import RewardTraits
from ms_highway.game.learned_reward import shipped, shipped_drivers
from ms_highway.game.scenario import driving_game
from ms_highway.game.scene import Leader
from ms_highway.geometry.road_map import LIMIT
from ms_highway.loop.controller import Controller, ControlStep
from ms_highway.loop.driver import fixed
from ms_highway.loop.step import braking_control
from ms_highway.numerics.solvers import PAPER_PLANNING, PlanningSettings, SolverName
from ms_highway.planning.learned_driving import FREE_GAP, held_acceleration
from ms_highway.runtime.arrays import State
from ms_highway.vehicle.bicycle import BicycleVehicle, OfferedSpeeds
from ms_highway.vehicle.road_view import WATCHED_TIMES, RoadView, at_constant_speed, look, states_of


class PlanningVehicle(BicycleVehicle, ControlledVehicle):
    """Car that a controller drives in a game with companions; without a controller, it takes actions like other cars.

    It keeps to the grip of tyres if the game's planner has a ``grip``, as in `ms_highway.game.scenario.driving_game`.

    highway-env's drivers and rules treat it like their own cars: they see its lane and predict it at constant speed
    along its route. It brakes where a ``RegulatedRoad`` makes it yield.

    Attributes:
        controller: plans whenever the road lets its vehicles act.
        companions: other cars of the controller's game, its partner first.
        last_step: record of the controller's last step, None before the first.
        last_state: states in which the controller planned then, [cars, 4].
        route: roads to follow; None to follow the present road.
        target_lane_index: the present lane.
    """

    def __init__(self, road: Road | None, position: Sequence[float], heading: float = 0, speed: float = 0) -> None:
        super().__init__(road, position, heading, speed)
        self.route: Route | None = None
        self.target_speed = None
        self.last_step: ControlStep | None = None
        self.last_state: State | None = None
        self.drive_with(None)

    @classmethod
    def create_from(cls, vehicle: Vehicle, **options: Any) -> Self:
        """Make a car of this class from another vehicle, with the same route, but without its target speed."""
        car = cls(vehicle.road, vehicle.position, vehicle.heading, vehicle.speed, **options)
        car.route = getattr(vehicle, "route", None)
        return car

    @property
    def target_speed(self) -> float:
        """Maximum speed [m/s]; its lane's if it is set to None, as by default; 0 to stop."""
        if self._target_speed is not None:
            return self._target_speed
        return (self.road and self.lane.speed_limit) or LIMIT

    @target_speed.setter
    def target_speed(self, speed: float | None) -> None:
        self._target_speed = speed

    def drive_with(self, controller: Controller | None, companions: Sequence[Vehicle] = ()) -> None:
        """Let a controller drive, in its game with these other cars, the partner first, and within its grip."""
        self.controller = controller
        self.companions = list(companions)
        grip = controller.game.planner.grip if controller else None
        self.grip = None if grip is None else float(grip)

    def observe(self) -> State:
        """Return the states of this car and of its companions."""
        return states_of([self, *self.companions])

    def act(self, action: dict[str, Any] | str | None = None) -> None:
        """Plan and execute the plan's first control, or else execute the given action until vehicles act again.

        Of highway-env's actions by name, only ``"IDLE"`` is allowed, which does nothing.

        Raises:
            ValueError: for another action by name.
        """
        if isinstance(action, str):
            if action != "IDLE":
                raise ValueError(f"a car that plans cannot be told to go {action!r}; its only such action is 'IDLE'")
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


CALM = 1.5  # m/s^2, necessary braking up to which the learned reward decides
STOPPED = 2.0  # m, gap behind a standing vehicle
STOPPING = 5.0  # 1/s, most braking per speed, so that no step ends backwards
YIELDING = 5.0  # m/s^2, of braking where a road makes a car yield


class HumanVehicle(PlanningVehicle):
    """Plan for a reward of its own, predicting that all others keep their velocity.

    In this package's scenarios, `drive_with` gives it its game. On any other highway-env road it drives alone, for
    ``weights`` among its neighbours, and can be the ``other_vehicles_type`` of a stock environment.

    Alone, it sees the road as the robot of stock environments does (`ms_highway.perception`). It keeps clear of others:
    the Intelligent Driver Model bounds its acceleration behind every vehicle that is ahead on its way, or that will
    cross its way before it at constant speed. It does not run into a car that is slower by 8, 12 or 20 m/s, and stops
    from 30 m/s behind a standing car. On a ``RegulatedRoad``, as in intersection-v0, it yields only when the road tells
    it to.

    If all cars, the ego included, are humans, 0 of 20 episodes of merge-v0 have collisions (with highway-env's IDM 0),
    3 of roundabout-v0 (4), 2 of intersection-v0 (7), and 0 of 8 of highway-fast-v0 (0).

    It does not change lanes in dense traffic: in 20 s of highway-v0 among 150 cars, IDM cars change lanes 39 times,
    humans never. Longer horizons do not help: behind a car of 12 m/s beside an empty lane, it stays there with horizons
    of up to 3 s and the Newton solver. Plans are improved locally, and the way between lanes earns less at first; only
    plans that start in another lane would get there.

    Attributes:
        weights: by name, of the reward when it drives alone; by default, learned from demonstrations.
        solver: see `ms_highway.numerics.solvers`; weights divided by a temperature need
            ``newton``.
        planning: horizon, time step and gradient steps.
        enable_lane_change: accepted for stock environments, but ignored: only the reward decides where to go.
    """

    COLOR = (60, 130, 220)
    weights: ClassVar[Mapping[str, float]] = shipped("demonstrations").weights
    solver: ClassVar[SolverName] = "gradient"
    planning: ClassVar[PlanningSettings] = PAPER_PLANNING

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
        """Plan for the own reward, in the game given by `drive_with` or else on the present road."""
        if action or self.companions or self.road is None:
            super().act(action)
        elif not self.crashed:
            self._drive_alone(look(self))

    def _drive_alone(self, view: RoadView) -> None:
        """Plan as if the lane were straight, add its bend to the plan's control, and brake harder to keep clear."""
        limit = min(view.speed_limit, self.target_speed)
        game = driving_game(view.scene, limit, self.weights, solver=self.solver, planning=self.planning)
        if self.controller is None:
            self.drive_with(fixed(game))
        assert self.controller is not None
        self.controller.game = game
        if self.target_speed > 0:
            self.last_state = view.states
            self.last_step = self.controller.step(view.states)
            omega, acceleration = self.last_step.control
        else:
            omega, acceleration = braking_control(game, view.states[0])
        times = 1 if isinstance(self.road, RegulatedRoad) else len(WATCHED_TIMES)
        highest = view.clear_acceleration(times) + self.friction
        self.execute(np.array([omega + view.scene.bend, min(acceleration, highest)]))


class CommuterVehicle(IDMVehicle):
    """Drive like the drivers recorded on US-101, each car with traits of its own.

    The acceleration maximises a reward learned from where those drivers were seconds later, see
    `ms_highway.planning.learned_driving`. Desired speed, headway and patience are drawn for every car by the road's
    random numbers. As dense traffic tells little about stopping, commuters also brake as hard as they have to. They
    steer and change lanes like highway-env's drivers (MOBIL), of which this class replaces only `acceleration`.

    Commuters suit highways: if all cars, the ego included, are commuters, 0 of 20 episodes of merge-v1 have collisions,
    but 11 of roundabout-v1 (with highway-env's IDM 5), as they do not see crossing traffic; `HumanVehicle` does.
    """

    ACC_MAX = 8.0  # m/s^2, of braking; they accelerate by 4 at most

    @cached_property
    def traits(self) -> RewardTraits:
        """Traits of this car, with the desired speed as a share of the speed limit; drawn when it first acts."""
        return shipped_drivers().prior.draw(self.road.np_random, 1.0)

    def act(self, action: Any = None) -> None:
        """Decide what to do in the next step; never drive backwards."""
        super().act(action)
        self.action["acceleration"] = max(self.action["acceleration"], -STOPPING * self.speed)

    def acceleration(
        self, ego_vehicle: Vehicle | None, front_vehicle: RoadObject | None = None, rear_vehicle: Any = None
    ) -> float:
        """Return the acceleration of a vehicle behind another one, as if it had the traits of this car [m/s^2].

        Args:
            ego_vehicle: the vehicle; None and obstacles do not accelerate.
            front_vehicle: the vehicle or obstacle ahead of it.
            rear_vehicle: ignored.
        """
        if not isinstance(ego_vehicle, Vehicle):
            return 0.0
        speed, limit = ego_vehicle.speed, ego_vehicle.lane.speed_limit or LIMIT
        wanted = min(getattr(ego_vehicle, "target_speed", limit), limit)
        if wanted <= 0:  # the road makes the vehicle yield
            return -min(speed, YIELDING)
        gap, ahead = np.inf, speed
        if front_vehicle:
            lengths = ego_vehicle.LENGTH + front_vehicle.LENGTH
            gap = ego_vehicle.lane_distance_to(front_vehicle) - lengths / 2
            ahead = max(float(front_vehicle.velocity @ ego_vehicle.direction), 0.0)
        own = self.traits._replace(desired_speed=self.traits.desired_speed * wanted)
        leader = Leader(min(gap, FREE_GAP), ahead, front_vehicle is not None)
        wish = float(held_acceleration(shipped_drivers().weights, own, speed, leader))
        if gap < STOPPED / 2:
            return -self.ACC_MAX
        needed = max(speed**2 - ahead**2, 0.0) / (2 * max(gap - STOPPED, 0.1))
        return min(wish, -needed) if needed > CALM else wish
