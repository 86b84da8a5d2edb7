"""Move the robot within its grip.

Its rear axle moves along its heading, as in highway-env.
"""

from dataclasses import dataclass

from jax import numpy as jnp

from ms_highway.geometry.curve import Pose, interpolate
from ms_highway.perception.scene import RoadScene, States
from ms_highway.road.road_planning import RoadPlanning
from ms_highway.runtime.arrays import Car, Control, Numbers


@dataclass(frozen=True)
class GripUse:
    """Set how braking and steering share the grip."""

    lowest_speed: float = 1.0
    """Below this speed, curvature is limited as at this speed [m/s]."""
    largest_slip_sine: float = 0.9
    """Largest sine of the slip angle."""
    braking_share: float = 0.6
    """Share of the grip that braking may take before steering."""


GRIP_USE = GripUse()


def limited_control(
    planning: RoadPlanning,
    speed: Numbers,
    control: Control,
) -> Control:
    """Limit the control to what the car can do.

    The limits are the friction circle, the largest curvature, and speeds from 0.
    Braking has a share of the grip first, ``b = min(-a, share grip)``; then the
    curvature is limited, ``(v^2 k)^2 <= grip^2 - b^2``; then the acceleration, ``a^2 <=
    grip^2 - (v^2 k)^2``.
    """
    grip = planning.grip
    squared_speed = jnp.maximum(speed, GRIP_USE.lowest_speed) ** 2

    # Braking b has its share of the grip first.
    braking = jnp.clip(-control[..., 1], 0.0, GRIP_USE.braking_share * grip)

    # The curvature k: (v^2 k)^2 <= grip^2 - b^2.
    lateral_grip = jnp.sqrt(grip**2 - braking**2)
    sharpest = jnp.minimum(planning.curvature, lateral_grip / squared_speed)
    curvature = jnp.clip(control[..., 0], -sharpest, sharpest)

    # The acceleration a: a^2 <= grip^2 - (v^2 k)^2. The car does not drive backwards.
    squared_grip_left = grip**2 - (squared_speed * curvature) ** 2
    hardest = jnp.sqrt(jnp.maximum(squared_grip_left, 1e-6))
    acceleration = jnp.clip(control[..., 1], -hardest, hardest)
    acceleration = jnp.maximum(acceleration, -speed / planning.time_step)
    return jnp.stack([curvature, acceleration], axis=-1)


def advance(
    scene: RoadScene,
    planning: RoadPlanning,
    state: Car,
    desired: Control,
) -> tuple[Car, Control]:
    """Return the state one time step later, and the control within the grip.

    With the curvature k_r of the road in the middle of the step, and old values on the
    right-hand side::

        s += u cos(heading) dt / (1 - d k_r)
        d += u sin(heading - k_r s' frame / 2) dt
        heading += (v k - k_r s') dt
        v += a dt

    The speed v is that of the centre. Its slip angle is beta, ``sin(beta) = k length /
    2``, so the speed of the rear axle is ``u = v cos(beta)``.

    In each frame of the simulation, the car moves along its heading at the beginning of
    the frame. In a bend, the road turns meanwhile, so that the car is carried outwards
    by ``v^2 k_r frame / 2`` in a second unless it points inwards by as much.
    """
    control = limited_control(planning, state[3], desired)
    curvature = control[0]
    acceleration = control[1]
    s, d, heading, speed = state
    dt = planning.time_step
    middle_of_step = s + 0.5 * speed * dt
    bend = interpolate(scene.route.curvature, middle_of_step)

    # The speed u of the rear axle, and the speed s' along the road.
    slip_sine = curvature * scene.size[0] / 2
    slip_cosine = jnp.sqrt(jnp.maximum(1 - slip_sine**2, 0.1))
    rear_speed = speed * slip_cosine
    s_rate = rear_speed * jnp.cos(heading) / jnp.maximum(1 - d * bend, 0.2)

    # The direction of motion lags behind the heading, see `RoadPlanning.lag`.
    direction = heading - bend * s_rate * planning.lag
    d_rate = rear_speed * jnp.sin(direction)
    heading_rate = speed * curvature - bend * s_rate
    rates = jnp.stack([s_rate, d_rate, heading_rate, acceleration])
    return state + rates * dt, control


def bodies(scene: RoadScene, states: States) -> Pose:
    """Return x, y and heading of the robot's centre in world coordinates.

    The centre is half a length ahead of the rear axle.
    """
    x, y, route_heading = scene.route.place(states[..., 0], states[..., 1])
    heading = route_heading + states[..., 2]
    half_length = scene.size[0] / 2
    centre_x = x + half_length * jnp.cos(heading)
    centre_y = y + half_length * jnp.sin(heading)
    return centre_x, centre_y, heading
