"""Compute how much speed the robot loses to traffic in the seconds after a plan.

The time after the plan is simple: all others keep their lane and their speed. In each
second the robot may go on at another speed and may change to the next lane. The best
way to drive is found by dynamic programming, backwards from the last second, on a grid
of lanes, places and speeds. The table of values is the same for all plans of a step;
each plan looks up the place and the speed at which it ends.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
from jax import numpy as jnp
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Bool, Float

from ms_highway.game.car_following import FREE_GAP
from ms_highway.geometry.curve import interpolate
from ms_highway.perception.scene import EachCar, EachFlag, PlanLanes, Plans
from ms_highway.road.simulation import SimulatedPlans
from ms_highway.road.stopping_room import STOPPING_ROOM
from ms_highway.road.traffic import COSINES, STANDING_SPEED, Situation, lane_of
from ms_highway.runtime.arrays import Array, Scalar

Table = Float[jax.Array, "lanes places speeds"]
TableInTime = Float[jax.Array, "seconds lanes places speeds"]


@dataclass(frozen=True)
class ValueGrid:
    """Set the grid of the dynamic programming, and what its steps cost.

    Speeds are counted in steps: the desired speed is ``speeds - 1`` steps. Places are
    as far apart as one step of speed leads in a second, so that a robot moves from
    place to place.
    """

    lanes_beside: int = 2
    """Number of lanes on each side of the robot's lane."""
    places: int = 144
    """Number of places: the way of twelve seconds at the desired speed, four of the
    plan and eight after it.
    """
    speeds: int = 13
    """Number of speeds, from 0 to the desired speed."""
    seconds: int = 8
    """Number of seconds after a plan in which the loss of speed counts."""
    slowing: int = 2
    """Largest decrease of speed in a second [steps]."""
    speeding: int = 1
    """Largest increase of speed in a second [steps]."""
    lane_change: float = 0.3
    """Cost of a lane change [steps of speed for a second]."""
    blocked: float = 30.0
    """Cost of a second in the way of others; it exceeds the loss of all speed [steps of
    speed].
    """
    no_lane: float = -1e3
    """Value of lanes beyond the outermost, which nobody chooses [steps of speed]."""

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
    """Upper bound of the gap behind as a time gap at the desired speed: in jams, others
    follow more closely [s].
    """
    braking: float = 2.5
    """Comfortable deceleration behind others [m/s^2]."""
    oncoming_time: float = 1.0
    """Time before an oncoming car arrives by which the robot has left its lane [s]."""
    lane_tolerance: float = 0.5
    """Distance beyond the lines of a lane up to which a car's centre is in it [m]."""
    unlimited_speed: float = 1e3
    """Speed of the next car, and allowed speed, where there is no car [m/s]."""


LATER_GAPS = LaterGaps()


@dataclass(frozen=True)
class CloseUp:
    """Set which of the others limits the robot's speed first.

    It is the one that allows least speed if the robot closes up to it.
    """

    seconds: float = 3.0
    """Time within which the robot closes up to the car ahead [s]."""
    gap: float = 5.0
    """Gap to which it closes up [m]."""


CLOSE_UP = CloseUp()


class LostSpeed(NamedTuple):
    """The loss of speed after plans.

    Attributes:
        speed: mean loss after each plan [m/s].
        is_limiting: which of the others limits the speed first.
    """

    speed: Plans
    is_limiting: EachFlag


class LaterTraffic(NamedTuple):
    """Others after a plan, who keep their lanes and speeds.

    Attributes:
        s: positions along the route when the plan ends [m].
        speed: along the route, negative for oncoming cars [m/s].
        in_lane: which of them are in each lane, [plans, lanes, traffic]; as a median
            over plans, a number from 0 to 1.
    """

    s: EachCar
    speed: EachCar
    in_lane: EachFlag | EachCar


class NextCar(NamedTuple):
    """The nearest car ahead of, or just behind, each place of the grid.

    Attributes:
        gap: to it, negative behind [m], [seconds, lanes, places, 1].
        speed: of it [m/s], in the same shape.
    """

    gap: TableInTime
    speed: TableInTime


def speed_lost(
    situation: Situation,
    simulated: SimulatedPlans,
    lanes: PlanLanes,
) -> LostSpeed:
    """Return the mean loss of speed after each plan, and who limits the speed first.

    Args:
        situation: what all plans share.
        simulated: the plans.
        lanes: in which the plans end, 0 to 2.
    """
    scene = situation.scene
    fastest = jnp.asarray(situation.planning.desired_speed, float)
    speed_step = fastest / (VALUE_GRID.speeds - 1)
    middle = simulated.states[:, -1, 0] + scene.size[0] / 2
    speed = simulated.states[:, -1, 3]

    # Look up the place, the speed and the lane of each plan, between the places and
    # speeds of the grid. Lane 1 of a plan, the robot's, is in the middle of the grid.
    values = _values(situation, simulated, speed_step)
    lane = lanes + VALUE_GRID.lanes_beside - 1
    place = jnp.clip(middle / speed_step, 0.0, VALUE_GRID.places - 1.01)
    pace = jnp.clip(speed / speed_step, 0.0, VALUE_GRID.speeds - 1.01)
    lost_steps = -map_coordinates(values, [lane, place, pace], order=1)
    lost = lost_steps * speed_step / VALUE_GRID.seconds

    # The speed that each car ahead in the lane allows to a robot that closes up to it.
    lane_centre = lane_of(scene.lanes, lanes, middle)[:, None]
    traffic = _traffic_after(situation, simulated, lane_centre)
    distance = traffic.s - middle[:, None]
    closable = jnp.maximum(distance - scene.contact[:, 0] - CLOSE_UP.gap, 0.0)
    allowed = jnp.where(
        traffic.in_lane[:, 0] & (distance > 0),
        traffic.speed + closable / CLOSE_UP.seconds,
        LATER_GAPS.unlimited_speed,
    )
    is_first = allowed == allowed.min(axis=-1, keepdims=True)
    return LostSpeed(lost, is_first & (allowed < fastest))


def _values(
    situation: Situation,
    simulated: SimulatedPlans,
    speed_step: Scalar,
) -> Table:
    """Return the value of each lane, place and speed at the end of a plan.

    It is minus the loss of speed still to come [steps of speed]. In each second, the
    robot first may change its lane l, then changes its speed v, then drives on from
    place p. The value V of second t follows from that of the next second::

        Q_t(l, p, v) = max over v' from v - slowing to v + speeding of
            V_(t+1)(l, p + v', v') - blocked_(t+1)(l, p + v', v') - loss(p + v', v')
        V_t(l, p, v) = the highest of Q_t(l, p, v) and, in the lanes l' beside it,
            Q_t(l', p, v) - blocked_t(l', p, v) - lane_change
    """
    places = speed_step * jnp.arange(VALUE_GRID.places)  # [m]

    # The loss in each second at each place and speed, and the cost of being in the way
    # of others there.
    loss = _speed_loss(situation, places, speed_step)
    blocked = _blocked_cost(situation, simulated, places, speed_step)

    def second_earlier(value: Table, costs: tuple[Table, Table]) -> tuple[Table, None]:
        """Return the values a second earlier.

        Args:
            value: of each lane, place and speed a second later.
            costs: of being in the way of others now and a second later.
        """
        blocked_now, blocked_later = costs
        at_new_speed = _after_driving(value - blocked_later - loss)
        in_lane = _after_best_speed_change(at_new_speed)
        return _after_best_lane_change(in_lane, in_lane - blocked_now), None

    # Go backwards from the last second, after which nothing counts.
    at_end = jnp.zeros(blocked.shape[1:])
    now_and_later = (blocked[:-1], blocked[1:])
    return jax.lax.scan(second_earlier, at_end, now_and_later, reverse=True)[0]


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
    for change in range(1, VALUE_GRID.slowing + VALUE_GRID.speeding + 1):
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
    to_the_left = arriving[:-2]
    to_the_right = arriving[2:]
    return jnp.maximum(staying, jnp.maximum(to_the_left, to_the_right))


def _speed_loss(
    situation: Situation,
    places: Float[Array, "places"],
    speed_step: Scalar,
) -> Float[jax.Array, "places speeds"]:
    """Return how far each speed is below the highest at each place [steps of speed]."""
    fastest = situation.planning.desired_speed
    highest = jnp.minimum(interpolate(situation.speed_caps, places), fastest)
    loss = highest[:, None] / speed_step - jnp.arange(VALUE_GRID.speeds)
    return jnp.maximum(loss, 0.0)


def _blocked_cost(
    situation: Situation,
    simulated: SimulatedPlans,
    places: Float[Array, "places"],
    speed_step: Scalar,
) -> TableInTime:
    """Return the cost of being in the way of others, or where there is no lane.

    It is the cost in each second after the plan [steps of speed].
    """
    lane_width = situation.planning.lane_width
    from_own_lane = jnp.arange(-VALUE_GRID.lanes_beside, VALUE_GRID.lanes_beside + 1.0)
    centres = lane_width * from_own_lane
    lanes_exist = _lanes_exist(situation, centres, places)
    car = _next_car(situation, simulated, centres, places)

    # The gap that a robot of speed v needs behind a car of speed u:
    #     ahead + reaction_time v + max(v - u, 0)^2 / (2 braking);
    # an oncoming car, u < 0, counts as standing, and adds oncoming_time |u|.
    speeds = speed_step * jnp.arange(VALUE_GRID.speeds)
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
    """Return the nearest car in each lane, from each place and in each second.

    One table serves all plans, so others are where they are in most of the plans.
    """
    scene = situation.scene
    contact = scene.contact[:, 0]

    # Others at the end of a plan, as a median over plans: [traffic] and
    # [lanes, traffic].
    lane_of_plans = jnp.tile(centres, (len(simulated.states), 1))
    of_plans = _traffic_after(situation, simulated, lane_of_plans)
    traffic = LaterTraffic(*(jnp.median(field, axis=0) for field in of_plans))
    in_lane = traffic.in_lane > 0.5

    # Distance from each place to each car, [seconds, 1, places, traffic].
    seconds = jnp.arange(VALUE_GRID.seconds + 1)
    position = traffic.s + traffic.speed * seconds[:, None]
    distance = position[:, None, None] - places[:, None]

    # Cars count that are in the lane and ahead, or so little behind that the robot
    # would be in their way.
    behind = jnp.minimum(
        LATER_GAPS.behind, LATER_GAPS.headway_behind * situation.planning.desired_speed
    )
    counts = in_lane[:, None] & (distance > -contact - behind)
    gaps = jnp.where(counts, distance - contact, FREE_GAP)
    nearest_gap = gaps.min(axis=-1, keepdims=True)
    is_nearest = gaps == nearest_gap
    speeds = jnp.where(is_nearest, traffic.speed, LATER_GAPS.unlimited_speed)
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
