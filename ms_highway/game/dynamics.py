"""Move cars: one step, a rollout of several, and the inverse of a step.

A car's state is ``(x, y, heading, speed)`` and its control ``(omega, acceleration)``.
Two options define the dynamics:

* steering ``curvature``: omega is the curvature of the path [1/m], ``heading' = v
  omega`` (Sec. IV-A of the paper); ``yaw_rate``: omega is the yaw rate [rad/s],
  ``heading' = omega`` (the paper's released code).
* friction ``linear``: ``v' = a - drag v`` with drag in 1/s (Sec. IV-A); ``quadratic``:
  ``v' = a - drag v^2`` with drag in 1/m (the released code's world).

`step`, `keep_velocity` and `recover_control` take and return either NumPy or JAX
arrays, so that vehicles (float64, NumPy) and planners (float32, JAX) share the
equations.
"""

from dataclasses import dataclass, field
from math import pi
from typing import Literal, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

from ms_highway.runtime.arrays import (
    Array,
    Numbers,
    SameArray,
    Scalar,
)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Dynamics:
    """Parameters of the dynamics.

    Attributes:
        steering: meaning of omega, ``curvature`` or ``yaw_rate`` (static).
        friction: dependence of drag on speed, ``linear`` or ``quadratic`` (static).
        drag: coefficient of friction, in 1/s or 1/m.
        time_step: duration of one step [s].
    """

    steering: Literal["curvature", "yaw_rate"] = field(metadata={"static": True})
    friction: Literal["linear", "quadratic"] = field(metadata={"static": True})
    drag: Scalar
    time_step: Scalar


class Motion(NamedTuple):
    """Positions, directions and speeds of cars, arrays [*cars, *times].

    Rewards are computed from them.

    Attributes:
        x, y: position [m].
        cosine, sine: of the heading.
        speed: [m/s].
    """

    x: jax.Array
    y: jax.Array
    cosine: jax.Array
    sine: jax.Array
    speed: jax.Array


def observe(states: Float[Array, "*shape 4"]) -> Motion:
    """Convert states to a motion, arrays [*shape]."""
    x, y, heading, speed = jnp.moveaxis(jnp.asarray(states), -1, 0)
    return Motion(x, y, jnp.cos(heading), jnp.sin(heading), speed)


def without_turns(angle: Float[SameArray, "*shape"]) -> Float[SameArray, "*shape"]:
    """Return an angle without whole turns, in [-pi, pi].

    Unlike `ms_highway.geometry.curve.wrapped`, it keeps all digits of an angle in that
    range.
    """
    turns = (angle / (2 * pi)).round()
    return angle - 2 * pi * turns


def facing(states: Float[Array, "*shape 4"]) -> Float[np.ndarray, "*shape 4"]:
    """Return states whose headings have no whole turns, see `without_turns`.

    A car that has turned once faces as before. Single precision would lose digits of
    its heading.
    """
    faced = np.array(states, dtype=float)
    faced[..., 2] = without_turns(faced[..., 2])
    return faced


def _resistance(dynamics: Dynamics, speed: Numbers) -> Numbers:
    """Return the deceleration by friction [m/s^2]."""
    power = speed if dynamics.friction == "linear" else speed**2
    return power * dynamics.drag


def step(
    dynamics: Dynamics,
    state: Float[SameArray, "*cars 4"],
    control: Float[SameArray, "*cars 2"],
) -> Float[SameArray, "*cars 4"]:
    """Return the state one time step later.

    With a' the acceleration less friction, ``d = v dt + a' dt^2 / 2``, and old values
    on the right-hand side::

        x += d cos(heading);  y += d sin(heading);  heading += yaw_rate dt;  v += a' dt
    """
    xp = state.__array_namespace__()
    heading = state[..., 2]
    speed = state[..., 3]
    yaw_rate = control[..., 0]
    if dynamics.steering == "curvature":
        yaw_rate = speed * yaw_rate
    acceleration = control[..., 1] - _resistance(dynamics, speed)
    dt = dynamics.time_step
    distance = speed * dt + acceleration * dt**2 / 2
    x = state[..., 0] + distance * xp.cos(heading)
    y = state[..., 1] + distance * xp.sin(heading)
    next_heading = heading + yaw_rate * dt
    next_speed = speed + acceleration * dt
    return xp.stack([x, y, next_heading, next_speed], axis=-1)


@jax.jit  # traced once for all cars of a plan
def rollout(
    dynamics: Dynamics,
    state: Float[jax.Array, "*cars 4"],
    controls: Float[jax.Array, "*cars steps 2"],
) -> Motion:
    """Return the motion after each of a sequence of controls, arrays [*cars, steps].

    It is without the initial state. It equals repeated calls of `step`, but all steps
    are computed at once: with linear friction, speeds are weighted sums of
    accelerations, ``v_k = (1 - drag dt)^k v_0 + dt sum_j (1 - drag dt)^(k-1-j) a_j``,
    and headings and positions are cumulative sums. A few operations on arrays compile
    and run many times faster than a chain of small ones.

    Raises:
        ValueError: for quadratic friction, which has no such closed form.
    """
    if dynamics.friction != "linear":
        raise ValueError(
            "a rollout needs linear friction; with quadratic friction, repeat `step`"
        )
    dt = dynamics.time_step
    omega, acceleration = jnp.moveaxis(controls, -1, 0)

    # Speeds and headings at the start and after each step [*cars, 1 + steps].
    speed = speeds(dynamics, state[..., 3], acceleration)
    before = speed[..., :-1]
    start_heading = state[..., 2]
    yaw_rate = before * omega if dynamics.steering == "curvature" else omega
    heading = _accumulate(start_heading, yaw_rate * dt)
    cosine = jnp.cos(heading)
    sine = jnp.sin(heading)

    # d = v dt + a' dt^2 / 2, along the heading before each step.
    after_friction = acceleration - dynamics.drag * before
    distance = before * dt + after_friction * (dt**2 / 2)
    x = _accumulate(state[..., 0], distance * cosine[..., :-1])
    y = _accumulate(state[..., 1], distance * sine[..., :-1])
    return Motion(*(field[..., 1:] for field in (x, y, cosine, sine, speed)))


@jax.jit
def rollout_jacobian(
    dynamics: Dynamics,
    car: Float[jax.Array, "4"],
    controls: Float[jax.Array, "steps 2"],
) -> Float[jax.Array, "fields steps controls"]:
    """Return the derivative of a `rollout` of one car in the ravelled controls.

    The fields of the rollout are stacked. The derivative is in closed form; JAX would
    push a direction for every control through the rollout. With ``V_kj = dv_k / da_j``
    and the distances d of `step`::

        dv_k = sum_j V_kj da_j
        dheading_k = dt sum_{l<k} (v_l domega_l + omega_l dv_l)
        dx_k = sum_{l<k} (cos_l dd_l - d_l sin_l dheading_l)
        dy_k = sum_{l<k} (sin_l dd_l + d_l cos_l dheading_l)

    With yaw rates, ``dheading_k = dt sum_{l<k} domega_l``. Friction is linear, as in a
    `rollout`.
    """
    dt = dynamics.time_step
    steps = len(controls)
    curved = dynamics.steering == "curvature"
    omega, acceleration = controls.T

    # Derivatives domega_l and da_l in the ravelled controls [steps, controls].
    own_controls = np.eye(2 * steps, dtype=np.float32).reshape(steps, 2, 2 * steps)
    of_omega = own_controls[:, 0]
    of_acceleration = own_controls[:, 1]
    earlier = _step_weights(steps)[:, 1:]  # [states, steps], 1 for steps before a state

    # dv_k: accelerations alone change speeds [states, controls].
    left = 1 - dynamics.drag * dt  # share of a speed that friction leaves after a step
    speed = speeds(dynamics, car[3], acceleration)
    per_acceleration = _step_weights(steps, left)[:, 1:] * dt  # V_kj
    per_omega = jnp.zeros_like(per_acceleration)
    faster = jnp.stack([per_omega, per_acceleration], axis=-1)
    faster = faster.reshape(1 + steps, -1)
    before = speed[:-1]
    faster_before = faster[:-1]

    # dheading_k [states, controls].
    yaw_rate = before * omega if curved else omega
    heading = _accumulate(car[2], yaw_rate * dt)
    if curved:
        yaw = before[:, None] * of_omega + omega[:, None] * faster_before
    else:
        yaw = jnp.asarray(of_omega)
    turned = earlier @ yaw * dt

    # dd_l [steps, controls].
    after_friction = acceleration - dynamics.drag * before
    distance = before * dt + after_friction * (dt**2 / 2)
    coasting = faster_before * dt
    harder = of_acceleration - dynamics.drag * faster_before
    farther = coasting + harder * (dt**2 / 2)

    # dx_k and dy_k, then the derivatives of cosine and sine.
    cosine = jnp.cos(heading)[:, None]
    sine = jnp.sin(heading)[:, None]
    turning = distance[:, None] * turned[:-1]
    cosine_before = cosine[:-1]
    sine_before = sine[:-1]
    x = earlier @ (cosine_before * farther - sine_before * turning)
    y = earlier @ (sine_before * farther + cosine_before * turning)
    fields = jnp.stack([x, y, -sine * turned, cosine * turned, faster])
    return fields[:, 1:]  # without the initial state


def speeds(
    dynamics: Dynamics,
    speed: Float[jax.Array, "*cars"],
    accelerations: Float[jax.Array, "*cars steps"],
) -> Float[jax.Array, "*cars states"]:
    """Return the speeds now and after each acceleration, under linear friction.

    See `rollout` for the equation.
    """
    # The share of a speed that friction leaves after a step.
    left = 1 - dynamics.drag * dynamics.time_step
    changes = accelerations * dynamics.time_step
    return _accumulate(speed, changes, left)


def _accumulate(
    initial: jax.Array,
    changes: jax.Array,
    left: Scalar | None = None,
) -> jax.Array:
    """Add the changes of all steps to an initial value.

    Each step multiplies the sum by ``left``, if given. Unlike a small matrix product,
    XLA fuses this.
    """
    steps = changes.shape[-1]
    weights = _step_weights(steps, left)  # [states, terms]
    terms = jnp.concatenate([initial[..., None], changes], axis=-1)
    weighed = weights * terms[..., None, :]
    return jnp.sum(weighed, axis=-1)


def _step_weights(
    steps: int,
    left: Scalar | None = None,
) -> Float[Array, "states terms"]:
    """Return, for each state, the weights of the initial value and of each change."""
    terms = np.arange(1 + steps)
    age = terms[:, None] - terms  # negative for changes after the state
    counts = (age >= 0).astype(float)
    if left is None:
        return counts
    return counts * left ** np.maximum(age, 0.0)


def within_grip(
    dynamics: Dynamics,
    grip: float | Float[SameArray, ""],
    speed: Float[SameArray, "*cars"],
    control: Float[SameArray, "*cars 2"],
    bend: float | Float[SameArray, ""] = 0.0,
) -> Float[SameArray, "*cars 2"]:
    """Scale a control down to the friction circle, and brake at most to a stop.

    Tyres hold ``(v^2 k)^2 + v'^2 <= grip^2``, the friction circle, with the curvature k
    of the path, which includes the road's, and the acceleration v' less friction. The
    lateral and the longitudinal one are scaled by the same factor.

    Args:
        dynamics: dynamics and duration of the step.
        grip: total acceleration that the tyres hold [m/s^2].
        speed: before the step; a car that rolls backwards stops.
        control: in the coordinates of the road.
        bend: curvature of the road [1/m]; the coordinates straighten it.
    """
    xp = control.__array_namespace__()

    # The omega of the road's bend, and the lateral acceleration per omega.
    turn = bend if dynamics.steering == "curvature" else bend * speed
    per_omega = speed**2 if dynamics.steering == "curvature" else speed
    friction = _resistance(dynamics, speed)
    omega = control[..., 0] + turn
    to_a_stop = -speed / dynamics.time_step
    acceleration = xp.maximum(control[..., 1] - friction, to_a_stop)

    # How much of both the tyres hold.
    total = xp.hypot(per_omega * omega, acceleration)
    share = xp.minimum(grip / xp.maximum(total, 1e-6), 1.0)
    limited_omega = share * omega - turn
    limited_acceleration = share * acceleration + friction
    return xp.stack([limited_omega, limited_acceleration], axis=-1)


def coast(dynamics: Dynamics, state: Float[Array, "*cars 4"], steps: int) -> Motion:
    """Return the motion at constant velocity, arrays [*cars, steps].

    It is without the initial state.
    """
    now = Motion(*(field[..., None] for field in observe(state)))
    distance = now.speed * jnp.arange(1, steps + 1) * dynamics.time_step
    x = now.x + distance * now.cosine
    y = now.y + distance * now.sine
    moved = now._replace(x=x, y=y)
    return Motion(*jnp.broadcast_arrays(*moved))


def keep_velocity(
    dynamics: Dynamics,
    state: Float[SameArray, "*cars 4"],
) -> Float[SameArray, "*cars 2"]:
    """Return the control that keeps speed and heading; it only compensates friction."""
    xp = state.__array_namespace__()
    speed = state[..., 3]
    omega = xp.zeros_like(speed)
    acceleration = _resistance(dynamics, speed)
    return xp.stack([omega, acceleration], axis=-1)


def recover_control(
    dynamics: Dynamics,
    state: Float[SameArray, "*cars 4"],
    next_state: Float[SameArray, "*cars 4"],
) -> Float[SameArray, "*cars 2"]:
    """Recover the control between two states: the inverse of `step`.

    A standing car shows no curvature; 0 is returned. A car turns by less than half a
    turn within a step: whole turns between both headings do not count.
    """
    xp = state.__array_namespace__()
    speed = state[..., 3]
    turned = without_turns(next_state[..., 2] - state[..., 2])
    yaw_rate = turned / dynamics.time_step
    gained = (next_state[..., 3] - speed) / dynamics.time_step
    acceleration = gained + _resistance(dynamics, speed)
    if dynamics.steering == "yaw_rate":
        return xp.stack([yaw_rate, acceleration], axis=-1)
    moving = speed != 0
    divisor = xp.where(moving, speed, 1.0)
    omega = xp.where(moving, yaw_rate / divisor, 0.0)
    return xp.stack([omega, acceleration], axis=-1)
