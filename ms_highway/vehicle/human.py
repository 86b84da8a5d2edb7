"""Drive like humans: plan for a reward learned from demonstrations or from recorded traffic."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Self

import numpy as np
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road
from highway_env.vehicle.kinematics import Vehicle

from ms_highway.game.game import Game
from ms_highway.game.learned_drivers import RewardTraits
from ms_highway.game.learned_reward import commuter_weights, shipped, shipped_drivers
from ms_highway.game.planning_settings import PAPER_PLANNING, PlanningSettings
from ms_highway.game.scenario import driving_game
from ms_highway.loop.controller import Controller
from ms_highway.loop.driver import fixed
from ms_highway.numerics.solvers import Solver
from ms_highway.vehicle.planning import PlanningVehicle
from ms_highway.vehicle.road_view import WATCHED, RoadView, look


class HumanVehicle(PlanningVehicle):
    """Plan for a reward of its own, predicting that all others keep their velocity.

    In this package's scenarios, `drive_with` gives it its game. On any other highway-env road it drives by itself, for
    ``weights`` among its neighbours, and can be the ``other_vehicles_type`` of a stock environment.

    By itself it sees the road as the robot of stock environments does (`ms_highway.perception`) and keeps clear of
    others: the Intelligent Driver Model bounds its acceleration, behind whoever is ahead on its way or will cross it
    first at constant speed. It does not run into a car that is slower by 8, 12 or 20 m/s, and stops from 30 m/s behind
    a standing one. On a ``RegulatedRoad``, such as that of intersection-v0, it yields only when the road tells it to.

    Where all cars, the ego too, are humans, 0 of 20 episodes of merge-v0 have collisions (with highway-env's IDM 0), 3
    of roundabout-v0 (4), 2 of intersection-v0 (7), and 0 of 8 of highway-fast-v0 (0).

    It does not change lanes in dense traffic: in 20 s of highway-v0 among 150 cars, IDM cars change lanes 39 times,
    humans never. Longer horizons do not help: behind a car of 12 m/s beside an empty lane, it stays there with
    horizons of up to 3 s and the Newton solver, as plans are improved locally and the way between lanes earns less at
    first. That takes plans that start in another lane.

    Attributes:
        weights: by name, of the reward when it drives by itself: those learned from demonstrations.
        solver: see `ms_highway.numerics.solvers.optimize_controls`; weights divided by a temperature need
            ``newton``.
        planning: horizon, time step and gradient steps.
        enable_lane_change: taken from stock environments and ignored; only its reward decides where to go.
    """

    COLOR = (60, 130, 220)
    weights: ClassVar[Mapping[str, float]] = shipped("demonstrations").weights
    solver: ClassVar[Solver] = "gradient"
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
        """Plan for the own reward: in the game given by `drive_with`, or else on the present road."""
        if not action and self.controller is None and self.road is not None:
            self.drive_with(fixed(self._own_game(look(self))))
        super().act(action)

    def _drive_on_road(self, controller: Controller) -> RoadView:
        """Plan, and brake more than planned where that is needed to keep clear of others."""
        view = super()._drive_on_road(controller)
        omega, acceleration = self.control
        times = 1 if isinstance(self.road, RegulatedRoad) else len(WATCHED)
        highest = view.clear_acceleration(times) + self.friction
        self.execute(np.array([omega, min(acceleration, highest)]))
        return view

    def _own_game(self, view: RoadView) -> Game:
        """Return the game that it plays when it drives by itself."""
        return driving_game(view.scene, view.speed_limit, self.weights, solver=self.solver, planning=self.planning)


class CommuterVehicle(HumanVehicle):
    """Drive with the traffic, like the drivers recorded on US-101, each in its own way.

    The weights of speed, distances and comfort are learned from them, and so is how they differ: desired speed, headway
    and patience are drawn for every car, by the road's random numbers. Dense traffic on a straight highway tells little
    about leaving a lane that ends and avoiding collisions; these weights are the paper's: with the learned weights
    alone, humans hit standing cars and obstacles at the end of a ramp. The speed limit attracts it weakly: on an empty
    road it takes minutes to reach it.

    Attributes:
        traits: its own, the desired speed as a share of the speed limit.
    """

    COLOR = (150, 90, 200)
    weights = commuter_weights()
    solver = "newton"

    def __init__(self, *place: Any, traits: RewardTraits | None = None, **options: Any) -> None:
        super().__init__(*place, **options)
        prior = shipped_drivers().prior
        if traits is None:
            traits = prior.draw(self.road.np_random, 1.0) if self.road else prior.traits(np.zeros(3), 1.0)
        self.traits = traits

    @classmethod
    def create_from(cls, vehicle: Vehicle, **options: Any) -> Self:
        """Replace another vehicle, see `PlanningVehicle.create_from`; one of its own kind passes on its traits."""
        return super().create_from(vehicle, traits=getattr(vehicle, "traits", None), **options)

    def desired_speed(self, view: RoadView) -> float:
        """Return its own desired speed [m/s]: a share of what the road and `target_speed` allow, perhaps above 1."""
        return super().desired_speed(view) * float(self.traits.desired_speed)

    def _own_game(self, view: RoadView) -> Game:
        game = super()._own_game(view)
        comfort = np.asarray(game.robot.comfort) * [1.0, self.traits.patience]
        own = replace(game.robot, headway=self.traits.headway, comfort=comfort.astype(np.float32))
        return replace(game, robot=own, humans=replace(own, weights=game.humans.weights))
