"""Drive simply, into lanes and gaps.

Manoeuvres are the ways out of `ms_highway.planning.way_out`, and possible starts of
plans for seconds.
"""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import Motion, keep_velocity, step, within_grip
from ms_highway.game.game import Game
from ms_highway.geometry.bodies import nearest_ahead
from ms_highway.runtime.arrays import Array, Car, Control, Scalar

STEERING_FREQUENCY = 2.5  # rad/s, of the critically damped way to the middle of a lane
MAX_LATERAL_ACCELERATION = 6.0  # m/s^2
MIN_SPEED = 3.0  # m/s, by which accelerations are divided at least to get curvatures
# car lengths, of the gap behind the last car of a lane or ahead of the first one
OPEN_GAP = 6.0
# car lengths that a car keeps to the centres of the cars around a gap that is wide
# enough
GAP_MARGIN = 1.3
POSITION_GAIN, SPEED_GAIN = (
    2.0,
    3.0,
)  # 1/s^2 and 1/s, by which a car corrects its place and speed to those of a gap
GAP_BRAKING, GAP_ACCELERATION = 7.0, 4.0  # m/s^2, towards a gap
ENTRY_TOLERANCE = 2.0  # m, from its place in a gap, within which a car changes lanes

Ways = tuple[
    Float[jax.Array, "manoeuvres steps 2"], Float[jax.Array, "manoeuvres steps 4"]
]
Around = TypeVar("Around")


def manoeuvres(game: Game, car: Car, steps: int, accelerations: Array) -> Ways:
    """Return the scaled controls and the states of a car that goes to the middle of
    each lane at each acceleration.
    """
    lanes, held = jnp.meshgrid(
        jnp.asarray(game.scene.lanes), jnp.asarray(accelerations), indexing="ij"
    )

    def one(lane: Scalar, acceleration: Scalar) -> tuple[jax.Array, jax.Array]:
        return _drive(
            game,
            car,
            lambda car, _: _towards(game, car, lane, acceleration),
            None,
            steps,
        )

    return jax.vmap(one)(lanes.ravel(), held.ravel())


def into_gaps(game: Game, car: Car, others: Motion) -> Ways:
    """Return the scaled controls and the states of a car that goes into each gap.

    There is a gap ahead of each of the others, and one behind the last car of each
    lane, in this order. A gap is in the lane that is nearest to its cars. The car takes
    the speed of the gap and a place in its middle, or any place `GAP_MARGIN` away from
    both ends of a longer gap; it stays in its lane until it is there. In an empty lane,
    it keeps its speed.

    Args:
        game: of the car.
        car: its state now.
        others: motion of all others after each step, arrays [others, steps].
    """
    lanes = jnp.asarray(game.scene.lanes)
    length = jnp.asarray(game.scene.car_size)[0]
    present = _nearest(lanes, car[1])
    places = jnp.asarray(jax.vmap(partial(_nearest, lanes))(others.y[:, 0]))
    x = others.x
    speed = others.speed
    leader, leads = nearest_ahead(x[:, 0] - x[:, :1], places == places[:, None])
    leads = leads[:, None]
    of_lane = places == lanes[:, None]
    last = jnp.argmin(jnp.where(of_lane, x[:, 0], jnp.inf), axis=-1)
    taken = of_lane.any(axis=1)[:, None]
    kept = car[0] + car[3] * game.dynamics.time_step * jnp.arange(1, 1 + x.shape[1])
    behind = jnp.concatenate([x, jnp.where(taken, x[last] - OPEN_GAP * length, kept)])
    before = jnp.concatenate(
        [
            jnp.where(leads, x[leader], x + OPEN_GAP * length),
            jnp.where(taken, x[last], kept),
        ]
    )
    pace = jnp.concatenate(
        [
            (speed + jnp.where(leads, speed[leader], speed)) / 2,
            jnp.where(taken, speed[last], car[3]),
        ]
    )
    middle = (behind + before) / 2
    half = (before - behind) / 2

    def one(
        lane: Scalar, *gap: Float[jax.Array, "steps"]
    ) -> tuple[jax.Array, jax.Array]:
        def follow(car: Car, now: tuple[Scalar, ...]) -> Control:
            middle, half, pace = now
            off = car[0] + car[3] * game.dynamics.time_step - middle
            spare = jnp.maximum(half - GAP_MARGIN * length, 0.0)
            pull = POSITION_GAIN * (jnp.clip(off, -spare, spare) - off) + SPEED_GAIN * (
                pace - car[3]
            )
            enters = jnp.abs(off) < jnp.maximum(half - length, 0.0) + ENTRY_TOLERANCE
            return _towards(
                game,
                car,
                jnp.where(enters, lane, present),
                jnp.clip(pull, -GAP_BRAKING, GAP_ACCELERATION),
            )

        return _drive(game, car, follow, gap, None)

    return jax.vmap(one)(jnp.concatenate([places, lanes]), middle, half, pace)


def _nearest(lanes: Float[jax.Array, "lanes"], y: Scalar) -> Scalar:
    return lanes[jnp.argmin(jnp.abs(lanes - y))]


def _towards(game: Game, car: Car, lane: Scalar, acceleration: Scalar) -> Control:
    """Return the control, not scaled, towards the middle of a lane, within the limits
    of plans.

    The car steers by a lateral acceleration of ``-w^2 (y - y_lane) - 2 w v
    sin(heading)``, and does not reverse.
    """
    _, y, heading, speed = car
    limit = jnp.asarray(game.planner.control_limit)
    aside = -(STEERING_FREQUENCY**2) * (
        y - lane
    ) - 2 * STEERING_FREQUENCY * speed * jnp.sin(heading)
    omega = jnp.clip(
        aside, -MAX_LATERAL_ACCELERATION, MAX_LATERAL_ACCELERATION
    ) / jnp.maximum(speed, MIN_SPEED)
    omega = (
        omega / jnp.maximum(speed, MIN_SPEED)
        if game.dynamics.steering == "curvature"
        else omega
    )
    wanted = jnp.maximum(acceleration, -speed / game.dynamics.time_step)
    control = jnp.clip(
        jnp.stack([omega, wanted + keep_velocity(game.dynamics, car)[1]]), -limit, limit
    )
    if game.planner.grip is not None:
        control = within_grip(
            game.dynamics, jnp.asarray(game.planner.grip), speed, control
        )
    return control


def _drive(
    game: Game,
    car: Car,
    driver: Callable[[Car, Around], Control],
    around: Around,
    steps: int | None,
) -> tuple[jax.Array, jax.Array]:
    """Return the scaled controls of a driver, and the states after them."""

    def go(
        car: jax.Array, now: Around
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        control = jnp.asarray(driver(car, now))
        moved = step(game.dynamics, car, control)
        return moved, (control / game.planner.control_scale, moved)

    return jax.lax.scan(go, jnp.asarray(car), around, steps)[1]
