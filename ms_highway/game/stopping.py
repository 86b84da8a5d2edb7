"""Keep room to stop: the cost of plans for seconds that, half-way, could no longer stop before an obstacle.

Horizons end before an obstacle matters. Without this cost, a car drives fast until the obstacle is within the horizon,
brakes as hard as tyres allow, and stops too close to the obstacle to steer around it.
"""

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.dynamics import Motion
from ms_highway.game.features import soft_positive
from ms_highway.game.scene import Scene
from ms_highway.runtime.arrays import Scalar, Times

STOPPING_MARGIN = 0.8  # car lengths (4 m) left to an obstacle after a stop: room to steer around it
LATERAL_MARGIN = 0.4  # car widths (1 m) between bodies, at which an obstacle is no longer in the way
SMOOTHING = 0.2  # beyond which the cost of being late or aligned is nearly linear


def stopping_cost(scene: Scene, braking: Scalar, own: Motion) -> Times:
    """Return the cost of stopping too late before obstacles that are ahead in the car's way, ``sum r^2`` with::

        r = soft(d) soft(1 - (dy / w)^2) s,  soft(z) = max(z, 0)^2 / (max(z, 0) + 0.2)
        d = (v^2 / (2 b) + l - dx) / car length + room

    The centres are (dx, dy) apart. Bodies touch at ``dx = l``, and pass each other with `LATERAL_MARGIN` between them
    at ``dy = w``. The factor s falls smoothly from 1 at ``dx = l`` to 0 at ``dx = -l``, where the obstacle is passed.

    Args:
        scene: obstacles and sizes of bodies.
        braking: deceleration b; if it is infinite, only the gap counts.
        own: motion of the car, arrays [steps].

    Returns:
        An array [steps], zero except in the step half-way.
    """
    return jnp.sum(lateness(scene, braking, own) ** 2, axis=0)


def lateness(scene: Scene, braking: Scalar, own: Motion) -> Float[jax.Array, "obstacles steps"]:
    """Return r of `stopping_cost` for every obstacle, zero except in the step half-way."""
    obstacle_x, obstacle_y = jnp.asarray(scene.obstacles).T[..., None]
    car_length, car_width = jnp.asarray(scene.car_size)
    length, width = (jnp.asarray(scene.car_size) + jnp.asarray(scene.obstacle_size)) / 2
    gap = obstacle_x - own.x
    late = soft_positive((own.speed**2 / (2 * braking) + length - gap) / car_length + STOPPING_MARGIN, SMOOTHING)
    aligned = soft_positive(1 - ((own.y - obstacle_y) / (width + LATERAL_MARGIN * car_width)) ** 2, SMOOTHING)
    ahead = jnp.clip((gap / length + 1) / 2, 0.0, 1.0)
    steps = own.x.shape[-1]
    half_way = np.arange(steps) == (steps - 1) // 2
    return half_way * late * aligned * ahead**2 * (3 - 2 * ahead)
