"""Compute the cost-to-go of plans: the speed that traffic costs in the seconds after.

In these seconds, all others keep their lane and their speed. In each second, the robot
may go on at another speed and may change to the next lane. Dynamic programming finds
the best way to drive, backwards from the last second, on a grid of lanes, places and
speeds.

One table serves all plans of a step. Each plan looks up the lane, the place and the
speed at which it ends. The grid's lanes are equally wide and centred on the robot's
route; the caps of speed are those of the route, in all lanes.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Bool, Float

from ms_highway.game.car_following import FREE_GAP
from ms_highway.geometry.curve import interpolate
from ms_highway.perception.scene import (
    SHAPE,
    FlagPerPath,
    PerPath,
    PerPlan,
    PlanLanes,
)
from ms_highway.road.simulation import SimulatedPlans
from ms_highway.road.stopping_room import STOPPING_ROOM
from ms_highway.road.traffic import COSINES, STANDING_SPEED, Situation, lane_of
from ms_highway.runtime.arrays import Array, Scalar

Table = Float[jax.Array, "lanes places speeds"]
TableInTime = Float[jax.Array, "seconds lanes places speeds"]


@dataclass(frozen=True)
class ValueGrid:
    """Set the grid of the dynamic programming, and the costs on it.

    Speeds are counted in bins; the desired speed is ``speeds - 1`` bins. Places are one
    bin times 1 s apart, so that every speed moves the robot by a whole number of
    places in a second. Costs are in bins: one bin of speed less for a second costs 1.
    """

    lanes_beside: int = 2
    """Number of lanes on each side of the robot's lane."""
    places: int = 144
    """Number of places: the distance covered in twelve seconds at the desired speed,
    four of the plan and eight after it. Where it is longer than the scene's route, the
    last speed cap and the last edges of the route continue.
    """
    speeds: int = 13
    """Number of speeds, from 0 to the desired speed."""
    seconds: int = 8
    """Number of seconds after a plan in which the loss of speed counts."""
    slowing: int = 2
    """Largest decrease of speed in a second [bins]."""
    speeding: int = 1
    """Largest increase of speed in a second [bins]."""
    lane_change: float = 0.3
    """Cost of a lane change [bins]."""
    blocked: float = 30.0
    """Cost of a second in the way of others, above the loss of all speed [bins]."""
    no_lane: float = -1e3
    """Value of lanes beyond the outermost, which nobody chooses [bins]."""

    @property
    def lanes(self) -> int:
        """Number of lanes."""
        return 2 * self.lanes_beside + 1


VALUE_GRID = ValueGrid()


@dataclass(frozen=True)
class LaterGaps:
    """Set the gaps that the robot keeps to others after a plan."""

    ahead: float = 1.0
    """Gap to the car ahead [m]."""
    behind: float = 3.0
    """Gap to the car behind [m]."""
    headway_behind: float = 0.3
    """Upper bound of the gap behind as a time gap at the robot's desired speed. It
    binds where the desired speed is below 10 m/s, as traffic is closer there [s].
    """
    braking: float = 2.5
    """Comfortable deceleration behind others [m/s^2]."""
    oncoming_time: float = 1.0
    """Time before an oncoming car arrives by which the robot has left its lane [s]."""
    lane_tolerance: float = 0.5
    """Distance beyond the lines of a lane up to which a car's centre is in it [m]."""
    unlimited_speed: float = 1e3
    """Stands for the speeds of cars that do not count, so that they drop out of a
    minimum [m/s].
    """


LATER_GAPS = LaterGaps()


@dataclass(frozen=True)
class CloseUp:
    """Set which car ahead limits the robot's speed.

    It is the one that allows the lowest mean speed, if the robot closes up to it within
    a given time.
    """

    seconds: float = 3.0
    """Time within which the robot closes up to the car ahead [s]."""
    gap: float = 5.0
    """Gap to which it closes up [m]."""


CLOSE_UP = CloseUp()


class CostToGo(NamedTuple):
    """The cost-to-go of plans.

    Attributes:
        speed_cost: cost-to-go per second: lost speed, lane changes, and being in the
            way of others. It may exceed the desired speed [m/s].
        is_limiting: which path's car limits the speed. The whole cost is charged to it,
            although bends, ends of lanes and other cars contribute. Paths of one car
            that coincide are tied.
    """

    speed_cost: PerPlan
    is_limiting: FlagPerPath


class LaterTraffic(NamedTuple):
    """Others after a plan, who keep their lanes and speeds.

    Attributes:
        s: positions along the route when the plan ends [m].
        speed: along the route, negative for oncoming cars [m/s].
        in_lane: which of them are in each lane.
    """

    s: PerPath
    speed: PerPath
    in_lane: Bool[jax.Array, "plans lanes traffic"]


class NextCar(NamedTuple):
    """The car to which the gap is smallest, from each place of the grid.

    A car just behind a place has a negative gap. It hides the car ahead, as the place
    is blocked in any case.

    Attributes:
        gap: to it, negative behind [m], [seconds, lanes, places, 1].
        speed: of it [m/s], in the same shape.
    """

    gap: TableInTime
    speed: TableInTime


def cost_to_go(
    situation: Situation,
    simulated: SimulatedPlans,
    lanes: PlanLanes,
) -> CostToGo:
    """Return the cost-to-go of each plan, and which car limits its speed.

    Args:
        situation: what all plans share.
        simulated: the plans.
        lanes: in which the plans end, see `SHAPE.own_lane`.
    """
    scene = situation.scene
    fastest = jnp.asarray(situation.planning.desired_speed, float)
    speed_bin = fastest / (VALUE_GRID.speeds - 1)  # [m/s]
    middle = simulated.states[:, -1, 0] + scene.size[0] / 2
    speed = simulated.states[:, -1, 3]

    # Look up the value at each plan's end, in its lane and between the grid's places
    # and speeds. The robot's lane is in the middle of the grid. Coordinates are
    # strictly inside the grid, as `map_coordinates` returns 0 beyond it.
    values = _values(situation, simulated, speed_bin)
    lane = lanes + VALUE_GRID.lanes_beside - SHAPE.own_lane
    place = jnp.clip(middle / speed_bin, 0.0, VALUE_GRID.places - 1.01)
    pace = jnp.clip(speed / speed_bin, 0.0, VALUE_GRID.speeds - 1.01)
    cost_in_bins = -map_coordinates(values, [lane, place, pace], order=1)
    speed_cost = cost_in_bins * speed_bin / VALUE_GRID.seconds

    # The mean speed that each car ahead in the lane allows a robot that closes up.
    lane_centre = lane_of(scene.lanes, lanes, middle)[:, None]
    traffic = _traffic_after(situation, simulated, lane_centre)
    distance = traffic.s - middle[:, None]
    contact_length = situation.contact[:, 0]
    closable = jnp.maximum(distance - contact_length - CLOSE_UP.gap, 0.0)
    allowed = jnp.where(
        traffic.in_lane[:, 0] & (distance > 0),
        traffic.speed + closable / CLOSE_UP.seconds,
        LATER_GAPS.unlimited_speed,
    )
    limits_most = allowed == allowed.min(axis=-1, keepdims=True)
    return CostToGo(speed_cost, limits_most & (allowed < fastest))


def _values(
    situation: Situation,
    simulated: SimulatedPlans,
    speed_bin: Scalar,
) -> Table:
    """Return the value of each lane, place and speed at the end of a plan [bins].

    The value V is minus the cost-to-go. In each second, the robot first may change its
    lane l, then changes its speed v, then drives on from place p. By the Bellman
    recursion, V of second t follows from that of the next second, without discount::

        Q_t(l, p, v) = max over v' from v - slowing to v + speeding of
            V_(t+1)(l, p + v', v') - blocked_(t+1)(l, p + v', v') - loss(p + v', v')
        V_t(l, p, v) = the highest of Q_t(l, p, v) and, in the lanes l' beside it,
            Q_t(l', p, v) - blocked_t(l', p, v) - lane_change

    A robot that stays in its lane does not pay blocked_t there: the previous second
    charged it already. At t = 0, nothing did, so that the end of the plan is free.
    """
    places = speed_bin * jnp.arange(VALUE_GRID.places)  # [m]

    # The loss in each second at each place and speed, and the cost of being in the way
    # of others there.
    loss = _speed_loss(situation, places, speed_bin)
    blocked = _blocked_cost(situation, simulated, places, speed_bin)

    def second_earlier(later: Table, costs: tuple[Table, Table]) -> tuple[Table, None]:
        """Return the values V a second earlier.

        Args:
            later: values V of each lane, place and speed a second later.
            costs: of being in the way of others now and a second later.
        """
        blocked_now, blocked_later = costs
        q_driving = _after_driving(later - blocked_later - loss)
        q_staying = _after_best_speed_change(q_driving)
        q_arriving = q_staying - blocked_now
        return _after_best_lane_change(q_staying, q_arriving), None

    # Go backwards from the last second, after which nothing counts.
    at_end = jnp.zeros(blocked.shape[1:])
    now_and_later = (blocked[:-1], blocked[1:])
    first_values, _ = jax.lax.scan(second_earlier, at_end, now_and_later, reverse=True)
    return first_values


def _after_driving(value: Table) -> Table:
    """Return the value of driving on for a second.

    From place p at speed v, the robot reaches place p + v.
    """
    beyond = ((0, 0), (0, VALUE_GRID.speeds), (0, 0))
    value = jnp.pad(value, beyond, mode="edge")
    at_speed = [
        value[:, speed : speed + VALUE_GRID.places, speed]
        for speed in range(VALUE_GRID.speeds)
    ]
    return jnp.stack(at_speed, axis=-1)


def _after_best_speed_change(value: Table) -> Table:
    """Return the value of each speed after the best change of speed."""
    beyond = ((0, 0), (0, 0), (VALUE_GRID.slowing, VALUE_GRID.speeding))
    value = jnp.pad(value, beyond, constant_values=-jnp.inf)
    best = value[..., : VALUE_GRID.speeds]  # slows down as much as possible
    largest_change = VALUE_GRID.slowing + VALUE_GRID.speeding
    for change in range(1, largest_change + 1):
        best = jnp.maximum(best, value[..., change : change + VALUE_GRID.speeds])
    return best


def _after_best_lane_change(staying: Table, arriving: Table) -> Table:
    """Return the value of each lane after the best change of lane, or none.

    Args:
        staying: value of each lane for a robot that is there.
        arriving: the same less the cost of being in the way of others there.
    """
    arriving = arriving - VALUE_GRID.lane_change
    beyond = ((1, 1), (0, 0), (0, 0))
    arriving = jnp.pad(arriving, beyond, constant_values=VALUE_GRID.no_lane)

    # Lanes are ordered from left to right.
    to_the_left = arriving[:-2]
    to_the_right = arriving[2:]
    return jnp.maximum(staying, jnp.maximum(to_the_left, to_the_right))


def _speed_loss(
    situation: Situation,
    places: Float[Array, "places"],
    speed_bin: Scalar,
) -> Float[jax.Array, "places speeds"]:
    """Return how far each speed is below the highest at each place [bins]."""
    fastest = situation.planning.desired_speed
    highest = jnp.minimum(interpolate(situation.speed_caps, places), fastest)
    highest_in_bins = highest[:, None] / speed_bin
    loss = highest_in_bins - jnp.arange(VALUE_GRID.speeds)
    return jnp.maximum(loss, 0.0)


def _blocked_cost(
    situation: Situation,
    simulated: SimulatedPlans,
    places: Float[Array, "places"],
    speed_bin: Scalar,
) -> TableInTime:
    """Return the cost of being in the way of others, or where there is no lane.

    It is the cost in each second after the plan [bins].
    """
    lane_width = situation.planning.lane_width
    from_own_lane = jnp.arange(-VALUE_GRID.lanes_beside, VALUE_GRID.lanes_beside + 1.0)
    centres = lane_width * from_own_lane
    lanes_exist = _lanes_exist(situation, centres, places)
    car = _next_car(situation, simulated, centres, places)

    # The gap that a robot of speed v needs behind a car of speed u:
    #     ahead + reaction_time v + max(v - u, 0)^2 / (2 braking);
    # an oncoming car, u < 0, counts as standing, and adds oncoming_time |u|.
    speeds = speed_bin * jnp.arange(VALUE_GRID.speeds)
    closing_speed = jnp.maximum(speeds - jnp.maximum(car.speed, 0.0), 0.0)
    oncoming = LATER_GAPS.oncoming_time * jnp.maximum(-car.speed, 0.0)
    needed = (
        LATER_GAPS.ahead
        + STOPPING_ROOM.reaction_time * speeds
        + oncoming
        + closing_speed**2 / (2 * LATER_GAPS.braking)
    )
    is_free = (car.gap > needed) & lanes_exist[..., None]
    return jnp.where(is_free, 0.0, VALUE_GRID.blocked)


def _lanes_exist(
    situation: Situation,
    centres: Float[jax.Array, "lanes"],
    places: Float[Array, "places"],
) -> Bool[jax.Array, "lanes places"]:
    """Return where each lane is within the edges of the road.

    The robot's own lane always is.
    """
    left_edge, right_edge = interpolate(situation.scene.edges, places)
    margin = situation.planning.lane_width / 4
    exists = (centres[:, None] > left_edge + margin) & (
        centres[:, None] < right_edge - margin
    )
    return exists.at[VALUE_GRID.lanes_beside].set(True)


def _next_car(
    situation: Situation,
    simulated: SimulatedPlans,
    centres: Float[jax.Array, "lanes"],
    places: Float[Array, "places"],
) -> NextCar:
    """Return the car with the smallest gap in each lane, place and second.

    One table serves all plans. So others are at their median position over plans, and
    in the lanes in which they are in most plans.
    """
    contact_length = situation.contact[:, 0]

    # Others at the end of a plan, [traffic] and [lanes, traffic].
    centres_per_plan = jnp.tile(centres, (len(simulated.states), 1))
    of_plans = _traffic_after(situation, simulated, centres_per_plan)
    s = jnp.median(of_plans.s, axis=0)
    speed = jnp.median(of_plans.speed, axis=0)
    median_in_lane = jnp.median(of_plans.in_lane, axis=0)  # 1 in most plans, or 0
    in_lane = median_in_lane > 0.5

    # Distance from each place to each car, [seconds, 1, places, traffic].
    seconds = jnp.arange(VALUE_GRID.seconds + 1)
    position = s + speed * seconds[:, None]
    distance = position[:, None, None] - places[:, None]

    # Cars count that are in the lane and ahead, or so little behind that the robot
    # would be in their way.
    time_gap_behind = LATER_GAPS.headway_behind * situation.planning.desired_speed
    gap_behind = jnp.minimum(LATER_GAPS.behind, time_gap_behind)
    counts = in_lane[:, None] & (distance > -contact_length - gap_behind)
    gaps = jnp.where(counts, distance - contact_length, FREE_GAP)
    nearest_gap = gaps.min(axis=-1, keepdims=True)

    # Where no car counts, all gaps are `FREE_GAP`, and the speed does not matter.
    is_nearest = gaps == nearest_gap
    speeds = jnp.where(is_nearest, speed, LATER_GAPS.unlimited_speed)
    return NextCar(nearest_gap, speeds.min(axis=-1, keepdims=True))


def _traffic_after(
    situation: Situation,
    simulated: SimulatedPlans,
    centres: Float[Array, "plans lanes"],
) -> LaterTraffic:
    """Return where others are after each plan, and in which lanes.

    Cars that cross the route are in no lane unless they stand there.

    Args:
        situation: what all plans share.
        simulated: the plans.
        centres: lateral positions of lanes [m].
    """
    end = simulated.traffic.last
    is_along = jnp.abs(end.cosine) > COSINES.not_crossing
    stays = (is_along | (end.speed < STANDING_SPEED)) & situation.scene.present
    distance = jnp.abs(end.d[:, None] - centres[..., None])
    half_width = situation.planning.lane_width / 2 + LATER_GAPS.lane_tolerance
    in_lane = (distance < half_width) & stays[:, None]
    return LaterTraffic(end.s, end.forward_speed, in_lane)
