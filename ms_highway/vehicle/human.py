"""Human drivers: cars that plan for a reward of their own, learned from demonstrations or from recorded traffic."""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from highway_env.road.road import Road

from ms_highway.control.fixed import FixedModel
from ms_highway.game.learned_reward import shipped
from ms_highway.game.scenario import COMMON_WEIGHTS, driving_game
from ms_highway.optimization.ascent import Solver
from ms_highway.optimization.gradient_steps import PAPER_ASCENT, Ascent
from ms_highway.planning.human_models import Naive
from ms_highway.vehicle.planning import PlanningVehicle
from ms_highway.vehicle.road_view import look

__all__ = ["CommuterVehicle", "HumanVehicle"]


class HumanVehicle(PlanningVehicle):
    """A human driver: plans for its own reward and believes that all others keep their velocity.

    In the scenarios of this package it is told its game by `drive_with`. On any other highway-env road it drives by
    itself, for ``weights`` among its neighbours, so that it can be the ``other_vehicles_type`` of a stock environment.

    It knows no right of way where a road does not enforce it, and sees cars from other roads only once they are in its
    lane or beside it: it is not meant for roundabouts among cars that brake for nobody. In 20 episodes of
    roundabout-v0, humans collide with the idle ego in all (highway-env's IDM cars in 5), and with each other in 2; with
    a car of their own kind in the ego's place, there are collisions in 9 (among IDM cars in 12).

    It looks half a second ahead and keeps no distance for its own sake: within what tyres hold, it runs into a car
    ahead that is slower by 8 m/s or more. With an `ms_highway.optimization.gradient_steps.Ascent` of 10 steps it does
    not at 8 m/s, for three to four times the computing, but still does at 12; `CommuterVehicle`, which keeps its
    distance, stops behind a standing car.

    It does not change lanes in dense traffic: in 20 s of highway-v0 among 150 cars, IDM cars change lanes 39 times,
    humans never. Looking further does not help: behind a car of 12 m/s beside an empty lane, it stays there with
    horizons of up to 3 s and the Newton solver, since a plan climbs from where the car is, and between lanes it would
    earn less first. That takes plans that start in another lane.

    Attributes:
        weights: of the reward that it drives for by itself, by name: those learned from demonstrations.
        solver: how it plans for them, see `ms_highway.optimization.ascent.climb`; weights over a temperature need
            ``newton``.
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
    learned = shipped("us101")
    kept = {name: float(COMMON_WEIGHTS[name]) for name in ("lane_alignment", "collision_risk", "off_road")}
    return {name: weight / learned.temperature for name, weight in (learned.weights | kept).items()}


class CommuterVehicle(HumanVehicle):
    """A human driver that goes with the traffic, like those who were recorded on US-101.

    Speed, distances to others and comfort weigh what was learned from them. What dense traffic on a straight highway
    tells little about, how to leave a lane that ends and not to hit anything, weighs what it does in the paper: with
    the learned weights alone, humans run into standing cars, and into what stands at the end of a ramp. It is hardly
    drawn to the speed limit: on an empty road it takes minutes to get there.
    """

    COLOR = (150, 90, 200)
    weights = _commuting()
    solver = "newton"
