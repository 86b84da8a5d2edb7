"""How a car moves: one step, a rollout of several, and the inverse of a step.

A car's state is ``(x, y, heading, speed)`` and its control ``(omega, acceleration)``. What a control does to the car
is told by two words:

* steering ``curvature``: omega is the curvature of the path [1/m], ``heading' = v omega`` (Sec. IV-A of the paper);
  ``yaw_rate``: omega is the yaw rate [rad/s], ``heading' = omega`` (the paper's released code).
* friction ``linear``: ``v' = a - drag v`` with drag in 1/s (Sec. IV-A); ``quadratic``: ``v' = a - drag v^2`` with drag
  in 1/m (the released code's world).

`step`, `keep_velocity` and `recover_control` take NumPy arrays as well as JAX arrays and answer in kind, so that
vehicles (float64, NumPy) and planners (float32, JAX) share the equations.
"""

from dataclasses import dataclass, field
from typing import Literal, TypeAlias, TypeVar

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

__all__ = ["Array", "Dynamics", "coast", "keep_velocity", "recover_control", "rollout", "step"]

Array: TypeAlias = jax.Array | np.ndarray
SameArray = TypeVar("SameArray", jax.Array, np.ndarray)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Dynamics:
    """A law of motion with its numbers.

    Attributes:
        steering: what omega is, ``curvature`` or ``yaw_rate`` (static).
        friction: how drag depends on speed, ``linear`` or ``quadratic`` (static).
        drag: coefficient of friction, in 1/s or 1/m.
        time_step: duration of one step [s].
    """

    steering: Literal["curvature", "yaw_rate"] = field(metadata={"static": True})
    friction: Literal["linear", "quadratic"] = field(metadata={"static": True})
    drag: float | Float[Array, ""]
    time_step: float | Float[Array, ""]


def _resistance(dynamics: Dynamics, speed: SameArray) -> SameArray:
    """Deceleration by friction [m/s^2]."""
    return (speed if dynamics.friction == "linear" else speed**2) * dynamics.drag


def step(
    dynamics: Dynamics, state: Float[SameArray, "*cars 4"], control: Float[SameArray, "*cars 2"]
) -> Float[SameArray, "*cars 4"]:
    """The state one time step later.

    With a' the acceleration less friction, ``d = v dt + a' dt^2 / 2``, and old values on the right-hand side::

        x += d cos(heading);  y += d sin(heading);  heading += yaw_rate dt;  v += a' dt
    """
    xp = state.__array_namespace__()
    heading, speed = state[..., 2], state[..., 3]
    yaw_rate = speed * control[..., 0] if dynamics.steering == "curvature" else control[..., 0]
    acceleration = control[..., 1] - _resistance(dynamics, speed)
    dt = dynamics.time_step
    distance = speed * dt + acceleration * dt**2 / 2
    return xp.stack(
        [
            state[..., 0] + distance * xp.cos(heading),
            state[..., 1] + distance * xp.sin(heading),
            heading + yaw_rate * dt,
            speed + acceleration * dt,
        ],
        axis=-1,
    )


def rollout(
    dynamics: Dynamics, state: Float[jax.Array, "*cars 4"], controls: Float[jax.Array, "steps *cars 2"]
) -> Float[jax.Array, "steps *cars 4"]:
    """The states after each of a sequence of controls (the initial state is left out).

    The same as as many calls of `step`, but all steps at once: with linear friction, speeds are a weighted sum of the
    accelerations, ``v_k = (1 - drag dt)^k v_0 + dt sum_j (1 - drag dt)^(k-1-j) a_j``, and headings and positions are
    cumulative sums. A few large array operations compile and run several times faster than many small ones.

    Raises:
        ValueError: for quadratic friction, which has no such form.
    """
    if dynamics.friction != "linear":
        raise ValueError("a rollout needs linear friction; with quadratic friction, repeat `step`")
    steps, dt = len(controls), dynamics.time_step
    age = np.arange(1, steps + 1)[:, None] - np.arange(steps + 1)  # steps from each term to each state, < 0: not yet
    plain = jnp.asarray(age >= 0, dtype=controls.dtype)
    fading = plain * (1 - dynamics.drag * dt) ** np.maximum(age, 0)

    def accumulate(weights: Float[jax.Array, "steps terms"], initial: jax.Array, changes: jax.Array) -> jax.Array:
        """Sums of an initial value and the changes so far; unlike a small matrix product, fused with what follows."""
        terms = jnp.concatenate([initial[None], changes])
        return jnp.sum(weights.reshape(*weights.shape, *[1] * initial.ndim) * terms, axis=1)

    def before(initial: jax.Array, after: jax.Array) -> jax.Array:
        return jnp.concatenate([initial[None], after[:-1]])

    x, y, heading, speed = jnp.moveaxis(state, -1, 0)
    omega, acceleration = jnp.moveaxis(controls, -1, 0)
    speeds = accumulate(fading, speed, acceleration * dt)
    old_speeds = before(speed, speeds)
    yaw_rates = old_speeds * omega if dynamics.steering == "curvature" else omega
    headings = accumulate(plain, heading, yaw_rates * dt)
    old_headings = before(heading, headings)
    distances = old_speeds * dt + (acceleration - _resistance(dynamics, old_speeds)) * dt**2 / 2
    xs = accumulate(plain, x, distances * jnp.cos(old_headings))
    ys = accumulate(plain, y, distances * jnp.sin(old_headings))
    return jnp.stack([xs, ys, headings, speeds], axis=-1)


def coast(dynamics: Dynamics, state: Float[jax.Array, "*cars 4"], steps: int) -> Float[jax.Array, "steps *cars 4"]:
    """The states after each of ``steps`` steps at constant velocity (the initial state is left out)."""
    x, y, heading, speed = jnp.moveaxis(state, -1, 0)
    times = (jnp.arange(1, steps + 1) * dynamics.time_step).reshape(-1, *[1] * x.ndim)
    distance = speed * times
    return jnp.stack(
        jnp.broadcast_arrays(x + distance * jnp.cos(heading), y + distance * jnp.sin(heading), heading, speed), axis=-1
    )


def keep_velocity(dynamics: Dynamics, state: Float[SameArray, "*cars 4"]) -> Float[SameArray, "*cars 2"]:
    """The control that keeps speed and heading: it only makes up for friction."""
    xp = state.__array_namespace__()
    speed = state[..., 3]
    return xp.stack([xp.zeros_like(speed), _resistance(dynamics, speed)], axis=-1)


def recover_control(
    dynamics: Dynamics, state: Float[SameArray, "*cars 4"], next_state: Float[SameArray, "*cars 4"]
) -> Float[SameArray, "*cars 2"]:
    """The control that led from one state to the next: the inverse of `step`.

    A standing car does not turn, so its curvature is unobservable at speed 0 and reported as 0.
    """
    xp = state.__array_namespace__()
    speed = state[..., 3]
    yaw_rate = (next_state[..., 2] - state[..., 2]) / dynamics.time_step
    acceleration = (next_state[..., 3] - speed) / dynamics.time_step + _resistance(dynamics, speed)
    if dynamics.steering == "yaw_rate":
        return xp.stack([yaw_rate, acceleration], axis=-1)
    moving = speed != 0
    omega = xp.where(moving, yaw_rate / xp.where(moving, speed, 1.0), 0.0)
    return xp.stack([omega, acceleration], axis=-1)
