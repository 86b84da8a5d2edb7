"""Simple manoeuvres, into lanes and into gaps between cars.

They are the fallback manoeuvres of `ms_highway.planning.way_out`, and candidates for
the start of plans whose horizon is several seconds long, see
`ms_highway.planning.plans.best_start`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.car_following import CAR_LIMITS
from ms_highway.game.dynamics import Motion, keep_velocity, step, within_grip
from ms_highway.game.game import Game
from ms_highway.geometry.bodies import nearest_ahead
from ms_highway.runtime.arrays import Car, Control, Scalar

Inputs = TypeVar("Inputs")


@dataclass(frozen=True)
class ManoeuvreSteering:
    """Set how a car steers to the middle of a lane, critically damped."""

    frequency: float = 2.5
    """Natural frequency of the approach [rad/s]."""
    max_lateral_acceleration: float = 6.0
    """Largest lateral acceleration [m/s^2]."""
    min_speed: float = 3.0
    """Speed by which accelerations are divided at least to get curvatures [m/s]."""


@dataclass(frozen=True)
class GapEntry:
    """Set how a car drives into a gap. Its parts along the road are in car lengths."""

    open_length: float = 6.0
    """Length of the gap behind the last car of a lane, or ahead of the first one [car
    lengths].
    """
    margin: float = 1.3
    """Distance to the centres of the cars around a gap that is wide enough [car
    lengths].
    """
    place_gain: float = 2.0
    """Acceleration per distance to the place in the gap [1/s^2]."""
    speed_gain: float = 3.0
    """Acceleration per difference to the speed of the gap [1/s]."""
    max_braking: float = 7.0
    """Hardest braking towards a gap [m/s^2]."""
    max_acceleration: float = CAR_LIMITS.acceleration
    """Hardest acceleration towards a gap [m/s^2]."""
    tolerance: float = 2.0
    """Distance to the place in the gap within which a car changes lanes [m]."""


MANOEUVRE_STEERING = ManoeuvreSteering()
GAP_ENTRY = GapEntry()


class Manoeuvres(NamedTuple):
    """Scaled controls of manoeuvres, and the states of the car after each of them."""

    controls: Float[jax.Array, "manoeuvres steps 2"]
    states: Float[jax.Array, "manoeuvres steps 4"]


def manoeuvres(
    game: Game,
    car: Car,
    steps: int,
    accelerations: Sequence[float],
) -> Manoeuvres:
    """Let a car go to the middle of each lane at each acceleration.

    Args:
        game: of the car.
        car: its state now.
        steps: number of steps.
        accelerations: to hold [m/s^2].
    """
    lanes = jnp.asarray(game.scene.lanes)
    single = np.asarray(accelerations, np.float32)
    held = jnp.asarray(single)
    lane_of, acceleration_of = jnp.meshgrid(lanes, held, indexing="ij")

    def go_to(lane: Scalar, acceleration: Scalar) -> Manoeuvres:
        def control_of(car: Car, _: None) -> Control:
            return _towards(game, car, lane, acceleration)

        return _drive(game, car, control_of, None, steps)

    return jax.vmap(go_to)(lane_of.ravel(), acceleration_of.ravel())


class _Gap(NamedTuple):
    """A gap between two cars at a step, or gaps [gaps] at all steps [gaps, steps].

    Attributes:
        lane: lateral position of the lane that it is in, at all steps [m].
        middle: position of its middle along the road [m].
        half: half of the distance between the centres of the cars around it [m].
        speed: of its middle [m/s].
    """

    lane: jax.Array
    middle: jax.Array
    half: jax.Array
    speed: jax.Array


def into_gaps(game: Game, car: Car, others: Motion) -> Manoeuvres:
    """Let a car go into each gap.

    There is a gap ahead of each of the others, and one behind the last car of each
    lane, in this order. A gap is in the lane that is nearest to its cars. The car takes
    the speed of the gap and a place in its middle, or any place that keeps the margin
    of `GapEntry` to both ends of a longer gap; it stays in its lane until it is there.
    In an empty lane, it keeps its speed.

    Args:
        game: of the car.
        car: its state now.
        others: motion of all others after each step, arrays [others, steps].
    """
    length = jnp.asarray(game.scene.car_size)[0]
    lanes = jnp.asarray(game.scene.lanes)
    own_lane = _nearest(lanes, car[1])

    def go_into(gap: _Gap) -> Manoeuvres:
        def control_of(
            car: Car,
            now: tuple[jax.Array, jax.Array, jax.Array],
        ) -> Control:
            gap_now = _Gap(gap.lane, *now)
            return _into_gap(game, car, length, own_lane, gap_now)

        gap_by_step = (gap.middle, gap.half, gap.speed)
        return _drive(game, car, control_of, gap_by_step, None)

    gaps = _gaps(game, car, length, others)
    return jax.vmap(go_into)(gaps)


def _gaps(game: Game, car: Car, length: Scalar, others: Motion) -> _Gap:
    """Find the gap ahead of each of the others, and that behind the last of each lane.

    See `into_gaps`; the length is that of a car.
    """
    lanes = jnp.asarray(game.scene.lanes)
    x = others.x
    speed = others.speed

    # Who leads each of the others in its lane now.
    nearest_lanes = jax.vmap(partial(_nearest, lanes))
    lane_of: jax.Array = nearest_lanes(others.y[:, 0])
    same_lane = lane_of == lane_of[:, None]  # [others, others]
    ahead_by = x[:, 0] - x[:, :1]  # [others, others]
    leader, leads = nearest_ahead(ahead_by, same_lane)
    leads = leads[:, None]

    # Who is the last of each lane.
    in_lane = lane_of == lanes[:, None]  # [lanes, others]
    x_in_lane = jnp.where(in_lane, x[:, 0], jnp.inf)
    last = jnp.argmin(x_in_lane, axis=-1)
    is_taken = in_lane.any(axis=1)[:, None]

    # In an empty lane, both ends of the gap are where the car keeps its speed.
    place, _, _, own_speed = car
    steps = jnp.arange(1, 1 + x.shape[1])
    steady = place + own_speed * game.dynamics.time_step * steps

    # The rear end of each gap: one of the others, or free road behind a last car.
    open_behind = x[last] - GAP_ENTRY.open_length * length
    behind_last = jnp.where(is_taken, open_behind, steady)
    back = jnp.concatenate([x, behind_last])

    # Its front end: the leader or free road, or the last car of a lane.
    open_ahead = x + GAP_ENTRY.open_length * length
    ahead = jnp.where(leads, x[leader], open_ahead)
    last_car = jnp.where(is_taken, x[last], steady)
    front = jnp.concatenate([ahead, last_car])

    # Its speed: the mean of both ends, or that of its only end.
    ahead_speed = jnp.where(leads, speed[leader], speed)
    last_speed = jnp.where(is_taken, speed[last], own_speed)
    mean_speed = (speed + ahead_speed) / 2
    gap_speed = jnp.concatenate([mean_speed, last_speed])

    gap_lane = jnp.concatenate([lane_of, lanes])
    middle = (back + front) / 2
    half = (front - back) / 2
    return _Gap(gap_lane, middle, half, gap_speed)


def _into_gap(
    game: Game,
    car: Car,
    length: Scalar,
    own_lane: Scalar,
    gap: _Gap,
) -> Control:
    """Return the control, not scaled, towards a gap, and into it once beside its place.

    Args:
        game: of the car.
        car: its state before the step.
        length: of a car [m].
        own_lane: lateral position of the lane from which it comes [m].
        gap: after the step.
    """
    # How far the car is from the middle after the step, and from the nearest place that
    # keeps the margin to both ends.
    offset = car[0] + car[3] * game.dynamics.time_step - gap.middle
    half_with_margin = gap.half - GAP_ENTRY.margin * length
    spare = jnp.maximum(half_with_margin, 0.0)
    nearest_place = jnp.clip(offset, -spare, spare)
    distance = nearest_place - offset

    # Accelerate to this place, and to its speed.
    speed_difference = gap.speed - car[3]
    to_place = GAP_ENTRY.place_gain * distance
    to_speed = GAP_ENTRY.speed_gain * speed_difference
    pull = to_place + to_speed

    # Change lanes once the car fits between both ends.
    half_without_body = jnp.maximum(gap.half - length, 0.0)
    room = half_without_body + GAP_ENTRY.tolerance
    enters = jnp.abs(offset) < room
    lane = jnp.where(enters, gap.lane, own_lane)
    acceleration = jnp.clip(pull, -GAP_ENTRY.max_braking, GAP_ENTRY.max_acceleration)
    return _towards(game, car, lane, acceleration)


def _nearest(lanes: Float[jax.Array, "lanes"], y: Scalar) -> jax.Array:
    """Return the lateral position of the lane that is nearest to another one."""
    distances = jnp.abs(lanes - y)
    return lanes[jnp.argmin(distances)]


def _towards(game: Game, car: Car, lane: Scalar, acceleration: Scalar) -> Control:
    """Return the control, not scaled, towards the middle of a lane.

    The car steers by a lateral acceleration of ``-w^2 (y - y_lane) - 2 w v
    sin(heading)``, keeps to the control limits and the grip of the planner, and does
    not reverse.
    """
    _, y, heading, speed = car
    limit = jnp.asarray(game.planner.control_limit)

    # The lateral acceleration of a critically damped approach.
    w = MANOEUVRE_STEERING.frequency
    to_middle = -(w**2) * (y - lane)
    damping = 2 * w * speed * jnp.sin(heading)
    wanted = to_middle - damping
    most = MANOEUVRE_STEERING.max_lateral_acceleration
    lateral = jnp.clip(wanted, -most, most)

    # As a yaw rate, a_lateral / v, or a curvature, a_lateral / v^2.
    omega = lateral / jnp.maximum(speed, MANOEUVRE_STEERING.min_speed)
    if game.dynamics.steering == "curvature":
        omega = omega / jnp.maximum(speed, MANOEUVRE_STEERING.min_speed)

    # Braking that ends at standstill.
    to_standstill = -speed / game.dynamics.time_step
    change = jnp.maximum(acceleration, to_standstill)
    along = change + keep_velocity(game.dynamics, car)[1]

    # The limits.
    control = jnp.stack([omega, along])
    control = jnp.clip(control, -limit, limit)
    if game.planner.grip is None:
        return control
    grip = jnp.asarray(game.planner.grip)
    return within_grip(game.dynamics, grip, speed, control)


def _drive(
    game: Game,
    car: Car,
    control_of: Callable[[Car, Inputs], Control],
    inputs: Inputs,
    steps: int | None,
) -> Manoeuvres:
    """Drive by a function of the state, step by step.

    Args:
        game: of the car.
        car: its state now.
        control_of: returns the control, not scaled, given the state of the car and the
            inputs of a step.
        inputs: arrays with a row per step; None without inputs.
        steps: number of steps; None for that of the inputs.
    """

    def go(car: jax.Array, now: Inputs) -> tuple[jax.Array, Manoeuvres]:
        control = jnp.asarray(control_of(car, now))
        after = step(game.dynamics, car, control)
        scaled = control / game.planner.control_scale
        return after, Manoeuvres(scaled, after)

    _, driven = jax.lax.scan(go, jnp.asarray(car), inputs, steps)
    return driven
