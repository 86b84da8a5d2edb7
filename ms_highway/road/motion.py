"""Move the robot in road coordinates: its rear axle goes where it heads, as in highway-env."""

import jax
from jax import numpy as jnp

from ms_highway.geometry.curve import SPACING, Knots, Pose, interpolate
from ms_highway.road.arrays import States, Steps, World
from ms_highway.road.constants import CORNERING, RoadPlanning
from ms_highway.road.scene import RoadScene
from ms_highway.runtime.arrays import Car, Control, Numbers, Scalar

SLOWEST = 1.0  # m/s, below which curvature is limited as at this speed
SLOWING = 2.5  # m/s^2, before bends
SLIP = 0.9  # sine of the slip angle at most
RESERVED = 0.6  # share of the grip that the braking of plans may take before their steering


def within_tyres(planning: RoadPlanning, speed: Numbers, control: Control, reserved: float = 0.0) -> Control:
    """Limit curvature and acceleration to the friction circle, to the sharpest curve, and to a stop, never backwards.

    Braking takes up to ``reserved``, a share of the grip, first: ``b = min(-a, reserved grip)``. Then the curve: ``(v^2
    k)^2 <= grip^2 - b^2``. Then all acceleration: ``a^2 <= grip^2 - (v^2 k)^2``.
    """
    squared = jnp.maximum(speed, SLOWEST) ** 2
    braking = jnp.clip(-control[..., 1], 0.0, reserved * planning.grip)
    sharpest = jnp.minimum(planning.curvature, jnp.sqrt(planning.grip**2 - braking**2) / squared)
    curvature = jnp.clip(control[..., 0], -sharpest, sharpest)
    left = jnp.sqrt(jnp.maximum(planning.grip**2 - (squared * curvature) ** 2, 1e-6))
    acceleration = jnp.maximum(jnp.clip(control[..., 1], -left, left), -speed / planning.time_step)
    return jnp.stack([curvature, acceleration], axis=-1)


def advance(scene: RoadScene, planning: RoadPlanning, state: Car, control: Control) -> Car:
    """Return the state one time step later; with old values on the right-hand side and the road's curvature k_r::

        s += u cos(heading) dt / (1 - d k_r);  d += u sin(heading) dt;  heading += (v k - k_r s') dt;  v += a dt

    The speed v is the centre's. With its slip angle beta, ``sin(beta) = k length / 2``, the rear axle moves with ``u =
    v cos(beta)``.
    """
    s, d, heading, speed = state
    bend = interpolate(scene.route.curvature, s)
    rear = speed * jnp.sqrt(jnp.maximum(1 - (control[0] * scene.size[0] / 2) ** 2, 0.1))
    onward = rear * jnp.cos(heading) / jnp.maximum(1 - d * bend, 0.2)
    changes = [onward, rear * jnp.sin(heading), speed * control[0] - bend * onward, control[1]]
    return state + jnp.stack(changes) * planning.time_step


def bodies(scene: RoadScene, states: States) -> Pose:
    """Return x, y and heading of the robot's centre in world coordinates, half a length ahead of its rear axle."""
    x, y, along = scene.route.place(states[..., 0], states[..., 1])
    heading, half = along + states[..., 2], scene.size[0] / 2
    return x + half * jnp.cos(heading), y + half * jnp.sin(heading), heading


def centres(scene: RoadScene, states: States) -> World:
    """Return the trajectories of the robot's centre."""
    return jnp.stack([*bodies(scene, states), states[..., 3]], axis=-2)


def earlier(first: Scalar, values: Steps) -> Steps:
    """Return values a step earlier, with a first one in front."""
    return jnp.concatenate([jnp.full_like(values[..., :1], first), values[..., :-1]], axis=-1)


def speed_caps(scene: RoadScene, planning: RoadPlanning) -> Knots:
    """Return the highest speed at each knot of the route from which gentle braking suffices for all bends ahead."""
    bends = jnp.maximum(jnp.abs(scene.route.curvature), 1e-4)
    allowed = jnp.minimum(CORNERING * planning.grip / bends, planning.desired_speed**2)
    ahead = 2 * SLOWING * SPACING * jnp.arange(len(bends))
    return jnp.sqrt(jnp.maximum(jax.lax.cummin(allowed + ahead, reverse=True) - ahead, 1.0))
