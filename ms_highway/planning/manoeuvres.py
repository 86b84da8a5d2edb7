"""Simple manoeuvres: to the middle of each lane, braking, keeping speed or speeding up."""

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.arrays import Car
from ms_highway.game.dynamics import keep_velocity, step, within_grip
from ms_highway.game.game import Game
from ms_highway.optimization.arrays import Control
from ms_highway.runtime.arrays import Scalar

ACCELERATIONS = np.array([-8.0, -4.0, 0.0, 4.0], np.float32)  # m/s^2, of the manoeuvres
FREQUENCY = 2.5  # rad/s, of the critically damped way to the middle of a lane
SIDEWAYS = 6.0  # m/s^2, of lateral acceleration at most
SLOWEST = 3.0  # m/s, below which curvatures are not computed by division by the speed


def manoeuvres(
    game: Game, car: Car, steps: int
) -> tuple[Float[jax.Array, "manoeuvres steps 2"], Float[jax.Array, "manoeuvres steps 4"]]:
    """Return scaled controls and states of a car that goes to the middle of each lane at each acceleration.

    It steers by ``-w^2 (y - y_lane) - 2 w v sin(heading)``, lateral acceleration, within the limits of plans.
    """
    lanes, accelerations = jnp.meshgrid(jnp.asarray(game.scene.lanes), jnp.asarray(ACCELERATIONS), indexing="ij")
    limit = jnp.asarray(game.planner.control_limit)

    def drive(car: Car, lane: Scalar, acceleration: Scalar) -> Control:
        _, y, heading, speed = car
        aside = -(FREQUENCY**2) * (y - lane) - 2 * FREQUENCY * speed * jnp.sin(heading)
        omega = jnp.clip(aside, -SIDEWAYS, SIDEWAYS) / jnp.maximum(speed, SLOWEST)
        omega = omega / jnp.maximum(speed, SLOWEST) if game.dynamics.steering == "curvature" else omega
        wanted = jnp.maximum(acceleration, -speed / game.dynamics.time_step)  # never backwards
        control = jnp.stack([omega, wanted + keep_velocity(game.dynamics, car)[1]])
        control = jnp.clip(control, -limit, limit)
        if game.planner.grip is not None:
            control = within_grip(game.dynamics, jnp.asarray(game.planner.grip), speed, control)
        return control

    def one(lane: Scalar, acceleration: Scalar) -> tuple[jax.Array, jax.Array]:
        def go(car: Car, _: None) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            control = drive(car, lane, acceleration)
            moved = step(game.dynamics, car, control)
            return moved, (control / game.planner.control_scale, moved)

        return jax.lax.scan(go, car, None, steps)[1]

    return jax.vmap(one)(lanes.ravel(), accelerations.ravel())
