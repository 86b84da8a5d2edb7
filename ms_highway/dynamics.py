"""How a car moves: one step, a rollout of several, and the inverse of a step.

A car's state is ``(x, y, heading, speed)`` and its control ``(omega, acceleration)``. Both laws share one integrator
and differ only in what a control does to the car:

* ``bicycle``, Sec. IV-A of the paper: omega is the curvature of the path [1/m] and friction is linear,
  ``heading' = v omega`` and ``v' = a - drag v`` with drag in 1/s.
* ``released``, the paper's released code: omega is the yaw rate [rad/s] and drag is quadratic,
  ``heading' = omega`` and ``v' = a - drag v^2`` with drag in 1/m.

`step`, `keep_velocity` and `recover_control` take NumPy arrays as well as JAX arrays and answer in kind, so that
vehicles (float64, NumPy) and planners (float32, JAX) share the equations.
"""

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import jax
import numpy as np
from jax import numpy as jnp
from jaxtyping import Float

__all__ = ["Dynamics", "Law", "Array", "keep_velocity", "recover_control", "rollout", "coast", "step"]

Law: TypeAlias = Literal["bicycle", "released"]
Array: TypeAlias = jax.Array | np.ndarray


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Dynamics:
    """A law of motion with its numbers.

    Attributes:
        law: what a control does to the car (static: it selects the code that is compiled).
        drag: friction, in 1/s for ``bicycle`` and in 1/m for ``released``.
        time_step: duration of one step [s].
    """

    law: Law = field(metadata={"static": True})
    drag: float | Float[Array, ""]
    time_step: float | Float[Array, ""]


def _friction(dynamics: Dynamics, speed: Array) -> Array:
    """Deceleration by friction [m/s^2]."""
    return dynamics.drag * (speed if dynamics.law == "bicycle" else speed**2)


def step(dynamics: Dynamics, state: Float[Array, "*cars 4"], control: Float[Array, "*cars 2"]) -> Float[Array, "*cars 4"]:
    """The state one time step later.

    With a' the acceleration less friction, ``d = v dt + a' dt^2 / 2``, and old values on the right-hand side::

        x += d cos(heading);  y += d sin(heading);  heading += yaw_rate dt;  v += a' dt
    """
    xp = state.__array_namespace__()
    heading, speed = state[..., 2], state[..., 3]
    yaw_rate = speed * control[..., 0] if dynamics.law == "bicycle" else control[..., 0]
    acceleration = control[..., 1] - _friction(dynamics, speed)
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
    """The states after each of a sequence of controls (the initial state is left out)."""
    states = []
    for control in controls:  # unrolled: horizons are short, and a loop would hide the steps from the compiler
        state = step(dynamics, state, control)
        states.append(state)
    return jnp.stack(states)


def coast(dynamics: Dynamics, state: Float[jax.Array, "*cars 4"], steps: int) -> Float[jax.Array, "steps *cars 4"]:
    """The states after each of ``steps`` steps at constant velocity (the initial state is left out)."""
    x, y, heading, speed = jnp.moveaxis(state, -1, 0)
    times = (jnp.arange(1, steps + 1) * dynamics.time_step).reshape(-1, *[1] * x.ndim)
    distance = speed * times
    return jnp.stack(
        jnp.broadcast_arrays(x + distance * jnp.cos(heading), y + distance * jnp.sin(heading), heading, speed), axis=-1
    )


def keep_velocity(dynamics: Dynamics, state: Float[Array, "*cars 4"]) -> Float[Array, "*cars 2"]:
    """The control that keeps speed and heading: it only makes up for friction."""
    xp = state.__array_namespace__()
    speed = state[..., 3]
    return xp.stack([xp.zeros_like(speed), _friction(dynamics, speed)], axis=-1)


def recover_control(
    dynamics: Dynamics, state: Float[Array, "*cars 4"], next_state: Float[Array, "*cars 4"]
) -> Float[Array, "*cars 2"]:
    """The control that led from one state to the next: the inverse of `step`.

    A standing ``bicycle`` cannot turn, so its curvature is unobservable at speed 0 and reported as 0.
    """
    xp = state.__array_namespace__()
    speed = state[..., 3]
    yaw_rate = (next_state[..., 2] - state[..., 2]) / dynamics.time_step
    acceleration = (next_state[..., 3] - speed) / dynamics.time_step + _friction(dynamics, speed)
    if dynamics.law == "released":
        return xp.stack([yaw_rate, acceleration], axis=-1)
    moving = speed != 0
    omega = xp.where(moving, yaw_rate / xp.where(moving, speed, 1.0), 0.0)
    return xp.stack([omega, acceleration], axis=-1)
