"""Move the robot in road coordinates: its rear axle goes where it heads, as in highway-env."""

import jax
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.game.road import RoadScene, interpolate, place
from ms_highway.planning.road.settings import RoadPlanning

__all__ = ["advance", "bodies", "drive", "within_limits"]

SLOWEST = 1.0  # m/s, below which curvature is limited as at this speed


def within_limits(
    planning: RoadPlanning, speed: Float[jax.Array, "*shape"], control: Float[jax.Array, "*shape 2"]
) -> Float[jax.Array, "*shape 2"]:
    """Limit curvature and acceleration to the friction circle, to the sharpest curve, and to a stop, never backwards.

    The acceleration gives way to the curve: ``|v^2 k| <= grip`` first, then ``a^2 <= grip^2 - (v^2 k)^2``.
    """
    squared = jnp.maximum(speed, SLOWEST) ** 2
    sharpest = jnp.minimum(planning.curvature, planning.grip / squared)
    curvature = jnp.clip(control[..., 0], -sharpest, sharpest)
    left = jnp.sqrt(jnp.maximum(planning.grip**2 - (squared * curvature) ** 2, 1e-6))
    acceleration = jnp.maximum(jnp.clip(control[..., 1], -left, left), -speed / planning.time_step)
    return jnp.stack([curvature, acceleration], axis=-1)


def advance(
    scene: RoadScene, planning: RoadPlanning, state: Float[jax.Array, "4"], control: Float[jax.Array, "2"]
) -> Float[jax.Array, "4"]:
    """Return the state one time step later; with old values on the right-hand side and the road's curvature k_r::

        s += u cos(heading) dt / (1 - d k_r);  d += u sin(heading) dt;  heading += (v k - k_r s') dt;  v += a dt

    The speed v is the centre's. With its slip angle beta, ``sin(beta) = k length / 2``, the rear axle moves with ``u =
    v cos(beta)``.
    """
    s, d, heading, speed = state
    bend = interpolate(scene.route.curvature, s)
    rear = speed * jnp.sqrt(jnp.maximum(1 - (control[0] * scene.size[0] / 2) ** 2, 0.1))
    onward = rear * jnp.cos(heading) / jnp.maximum(1 - d * bend, 0.2)
    dt = planning.time_step
    return jnp.stack(
        [
            s + onward * dt,
            d + rear * jnp.sin(heading) * dt,
            heading + (speed * control[0] - bend * onward) * dt,
            speed + control[1] * dt,
        ]
    )


def drive(
    scene: RoadScene, planning: RoadPlanning, controls: Float[jax.Array, "steps 2"]
) -> tuple[Float[jax.Array, "steps 4"], Float[jax.Array, "steps 2"]]:
    """Return the robot's states after each control, and the controls within limits that it executed."""

    def go(state: Float[jax.Array, "4"], control: Float[jax.Array, "2"]) -> tuple[jax.Array, tuple]:
        held = within_limits(planning, state[3], control)
        moved = advance(scene, planning, state, held)
        return moved, (moved, held)

    return jax.lax.scan(go, jnp.asarray(scene.robot), controls)[1]


def bodies(
    scene: RoadScene, states: Float[jax.Array, "*shape 4"]
) -> tuple[Float[jax.Array, "*shape"], Float[jax.Array, "*shape"], Float[jax.Array, "*shape"]]:
    """Return x, y and heading of the robot's centre in world coordinates, half a length ahead of its rear axle."""
    x, y, along = place(scene.route, states[..., 0], states[..., 1])
    heading, half = along + states[..., 2], scene.size[0] / 2
    return x + half * jnp.cos(heading), y + half * jnp.sin(heading), heading
